"""What the program prints: text that no terminal obeys, in letters that the terminal has."""

import ast
import io
import sys
from pathlib import Path

import pytest

from warpgs.app.cli import main
from warpgs.process import printable, say
from warpgs.synthetic.demo import write_demo

ROOT = Path(__file__).parent.parent.parent
NASTY = "\x1b]0;owned\x07\x1b[2Ja\rb\nc\x9b31m\u202ed\u2066e\x7f\u2028f\ud800"


def test_what_a_terminal_would_obey_is_printed_as_codes():
    """ESC, BEL, CR, line ends, C1, DEL, changes of direction, halves of characters; letters of all scripts stay."""
    assert printable(NASTY) == r"\x1b]0;owned\x07\x1b[2Ja\rb\nc\x9b31m\u202ed\u2066e\x7f\u2028f\ud800"
    for text in ("Straße, 写真 № 1", "می‌خواهم", "👩‍👩‍👧", "e\u0301 \u2013 \u201cx\u201d"):
        assert printable(text) == text


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "utf-8"])
def test_letters_that_a_terminal_does_not_have(monkeypatch, encoding):
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding)
    monkeypatch.setattr(sys, "stdout", stream)
    say(f"写真{NASTY}")
    wanted = "写真" if encoding == "utf-8" else r"\u5199\u771f"
    assert raw.getvalue().decode(encoding).startswith(wanted) and b"\x1b" not in raw.getvalue()


def test_one_place_prints():
    """Only one file calls `print` or writes to stdout or stderr; a table of the doctor goes through rich, cell by cell."""
    for path in (ROOT / "warpgs").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and path.name != "process.py":
                name = ast.unparse(node.func) if isinstance(node.func, (ast.Name, ast.Attribute)) else ""
                assert name != "print" and not name.startswith(("sys.stdout.w", "sys.stderr.w")), path


def streams(monkeypatch, encoding):
    """Put streams of a terminal with these letters in place; return what was written so far."""
    made = [io.TextIOWrapper(io.BytesIO(), encoding, write_through=True) for _ in range(2)]
    for name, stream in zip(("stdout", "stderr"), made):
        monkeypatch.setattr(sys, name, stream)
    return lambda: b"".join(stream.buffer.getvalue() for stream in made).decode(encoding)


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no such file names")
@pytest.mark.parametrize("encoding", ["ascii", "utf-8"])
def test_paths_and_image_names_of_others(monkeypatch, tmp_path, encoding):
    """A scene whose folder and images are called like commands to a terminal is read, named and fitted."""
    folder = tmp_path / "\x1b[2Jä\u202e写"
    write_demo(folder, views=8, width=32, height=32)
    for old in sorted((folder / "images").glob("*.png")):
        new = f"\x1b]0;é{old.stem}\x07.png"
        old.rename(folder / "images" / new)
        for file in (folder / "sparse" / "0").glob("images.txt"):
            file.write_text(file.read_text("utf-8").replace(old.name, new), "utf-8")
    written = streams(monkeypatch, encoding)
    flags = ["--steps", "1", "--device", "cpu", "--preset", "3dgs", "--init.source", "random", "--init.random-count", "50"]
    assert main(["fit", str(folder), "--out", str(tmp_path / "\x1b[31mrün"), *flags]) == 0
    assert main(["eval", str(tmp_path / "\x1b[31mrün"), "--device", "cpu"]) == 0
    assert main(["fit", str(folder), "--out", str(tmp_path / "a"), *flags, "--split", "train=\x1b[1mnone"]) == 3
    assert main(["export", "run", "--\x1b[1mnöne", "\x9b"]) == 2
    text = written()
    assert "[2J" in text and "none" in text and "[1m" in text
    assert not set(text) & set("\x1b\x07\x9b\r\u202e"), text
    assert ("写" in text) == (encoding == "utf-8")
