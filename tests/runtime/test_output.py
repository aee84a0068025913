"""Output: what a terminal would obey is printed as codes, and what cannot be written is said once."""

import ast
import errno
import io
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import warpgs
from tests.faults.tiny_runs import words_of
from warpgs import process
from warpgs.app import doctor
from warpgs.app.cli import main
from warpgs.export.ply import read_ply
from warpgs.pipeline.run.folder import load_checkpoint
from warpgs.report.progress import EventLog
from warpgs.synthetic.demo import split_spec, write_demo

with_sh = pytest.mark.skipif(sys.platform == "win32", reason="the shell of these tests is sh")
GOES_ON = "; the command continues without it\n"
LOST = {
    "| true": "Broken pipe", "> /dev/full": "No space left on device", ">&-": "Bad file descriptor",
    "2>&-": "", "2> /dev/full": "", "<&- >&- 2>&-": "", "> /dev/full 2>&1": "",
}  # fmt: skip
"""Outputs that cannot be written, and why stdout cannot, where that can be said."""
HELP = ["--version"], ["fit", "--help"], ["export", "--help"]


def shell(words: list[str], output: str, work: Path) -> tuple[int, str]:
    """Run a command as sh does, with its output led somewhere; return its exit code and what is on stderr."""
    errors, code = work / "errors", work / "code"
    for file in (errors, code):
        file.unlink(missing_ok=True)
    to = output if "2>" in output else f"2> {errors} {output}"
    # the exit code is that of the command, not that of the reader of a pipe
    line = f'{{ "$@" {to.split("|")[0]}; echo $? > {code}; }}' + (f" |{output.split('|')[1]}" if "|" in output else "")
    program = [sys.executable, "-P", "-m", "warpgs", *words]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "PYTHONPATH": str(Path(__file__).parents[2])}
    subprocess.run(["sh", "-c", line, "sh", *program], stdout=subprocess.DEVNULL, env=environment, check=False, timeout=300)
    return int(code.read_text()), errors.read_text() if errors.exists() else ""


@with_sh
@pytest.mark.parametrize("output", LOST)
def test_words_that_cannot_be_written(tmp_path, output):
    """Where they are all that was asked for, that is a failure; a reader who has seen enough is none."""
    for words in HELP if output == "> /dev/full" else HELP[:1]:
        code, said = shell(words, output, tmp_path)
        lost = "1" if output == "| true" or output.startswith("2>") else ""
        assert code == (0 if lost else 4), said
        if LOST[output] and not lost:
            assert said.startswith(f"warpgs: stdout cannot be written ({LOST[output]}); ") and said.count("\n") == 1
        else:
            assert not said


def fit_words(demo, out, steps=3):
    flags = ["--device", "cpu", "--preset", "3dgs", "--init.source", "random", "--init.random-count", "50"]
    return ["fit", str(demo), "--split", split_spec(8), "--out", str(out), "--steps", str(steps), *flags]


class Broken(io.StringIO):
    """A stream that takes some lines and then fails."""

    def __init__(self, lines, number):
        super().__init__()
        self.left, self.number = lines, number

    def write(self, text):
        if self.left <= 0:
            raise OSError(self.number, os.strerror(self.number))
        self.left -= text.count("\n")
        return super().write(text)


@pytest.mark.parametrize(("lines", "number"), [(0, errno.ENOSPC), (4, errno.EIO)])
def test_a_fit_goes_on_without_its_output(demo, tmp_path, monkeypatch, lines, number):
    errors = io.StringIO()
    monkeypatch.setattr(sys, "stdout", Broken(lines, number))
    monkeypatch.setattr(sys, "stderr", errors)
    assert main(fit_words(demo, tmp_path / "run")) == 0
    assert errors.getvalue() == f"warpgs: stdout cannot be written ({os.strerror(number)}){GOES_ON}"
    assert len(read_ply(tmp_path / "run" / "point_cloud.ply")) and (tmp_path / "run" / "report.html").is_file()


def test_neither_stdout_nor_stderr(demo, tmp_path, monkeypatch):
    """As under pythonw, or after `>&- 2>&-`: Python has no streams at all."""
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    assert main(fit_words(demo, tmp_path / "run")) == 0 and (tmp_path / "run" / "report.html").is_file()
    assert main(["export", str(tmp_path / "nothing"), "--to", "a.ply"]) == 3
    assert main(["doctor", "--device", "cpu"]) == 2
    assert main(["--help"]) == 4
    with pytest.raises(SystemExit) as e:
        main(["export", "--help"])
    assert e.value.code == 4
    assert main(["export", "--nonsense"]) == 2


def test_the_same_without_the_command_line(demo, tmp_path, monkeypatch, capfd):
    """`warpgs.fit` in a program whose reader has gone; the program's own streams stay as they are."""
    stream = Broken(1, errno.EPIPE)
    monkeypatch.setattr(sys, "stdout", stream)
    monkeypatch.setattr(process, "_is_lost", False)
    assert warpgs.fit(demo, warpgs.FitConfig(steps=2), out=tmp_path / "run", device="cpu").metrics["steps"] == 2
    assert sys.stdout is stream
    assert capfd.readouterr().err.count(GOES_ON) == 1


def test_tables_answers_and_errors_of_the_program_itself(monkeypatch, capsys):
    """Code 4 for a full disk, none for a closed pipe; an answer to another process fails; other errors are raised."""
    monkeypatch.setattr(doctor, "diagnose", lambda *_: [])
    for number, code in ((errno.ENOSPC, 4), (errno.EPIPE, 0)):
        monkeypatch.setattr(sys, "stdout", Broken(1, number))
        assert main(["doctor"]) == code
        assert capsys.readouterr().err.count("stdout cannot be written") == (code == 4)
    monkeypatch.setattr(sys, "stdout", Broken(0, errno.EPIPE))
    monkeypatch.setattr(process, "_is_lost", False)
    process.say("a line")
    process.say("a line")
    assert capsys.readouterr().err.count("\n") == 1
    with pytest.raises(BrokenPipeError):
        process.answer("a line")
    monkeypatch.undo()
    with process.careful_output(False), pytest.raises(TypeError):
        sys.stdout.write(b"bytes")
    stream = io.TextIOWrapper(io.BytesIO(), "ascii")
    with pytest.raises(UnicodeEncodeError):
        process.CarefulStream(stream).write("é")
    stream.close()
    careful = process.CarefulStream(stream)
    careful.write("a")
    careful.flush()
    assert isinstance(careful.failure, ValueError) and "closed file" in capsys.readouterr().err


CLOSED = """
import os, sys
for number in {closed}:
    os.close(number)
from warpgs.process import open_missing_descriptors
open_missing_descriptors()
file = os.open({path!r}, os.O_RDWR | os.O_CREAT)
os.write(1, b"out"); os.write(2, b"error")
sys.exit(0 if file > 2 and os.get_inheritable(1) and not os.fstat(file).st_size else 1)
"""


@with_sh
@pytest.mark.parametrize("closed", [(1,), (2,), (0, 1, 2), (0, 2)])
def test_no_file_becomes_stdout_or_stderr(tmp_path, closed):
    code = CLOSED.format(closed=closed, path=str(tmp_path / "file"))
    assert subprocess.run([sys.executable, "-c", code], check=False, capture_output=True).returncode == 0
    process.open_missing_descriptors()  # nothing to do


def test_native_output_without_streams(monkeypatch, tmp_path):
    """Hiding and redirecting output work where Python has no streams, and where a stream cannot be flushed."""
    for stream in (None, Broken(0, errno.ENOSPC)):
        monkeypatch.setattr(sys, "stdout", stream)
        monkeypatch.setattr(sys, "stderr", stream)
        with (tmp_path / "log").open("ab") as file, process.hidden_stderr(), process.output_to(file.fileno()):
            os.write(1, b"native\n")
    assert (tmp_path / "log").read_text() == 2 * "native\n"


@with_sh
@pytest.mark.skipif(not hasattr(signal, "SIGHUP"), reason="this system has no SIGHUP")
def test_a_terminal_that_hangs_up(demo, tmp_path, monkeypatch):
    """SIGHUP comes and both streams fail: the step in progress is saved, and --resume continues from it."""
    write, streams = EventLog.write, [Broken(1000, errno.EIO), Broken(1000, errno.EIO)]

    def hang_up(log, **values):
        write(log, **values)
        for stream in streams:
            stream.left = 0
        signal.raise_signal(signal.SIGHUP)

    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        monkeypatch.setattr(EventLog, "write", hang_up)
        for name, stream in zip(("stdout", "stderr"), streams, strict=True):
            monkeypatch.setattr(sys, name, stream)
        assert main(fit_words(demo, tmp_path / "run")) == 130
    finally:
        signal.signal(signal.SIGHUP, before)
    monkeypatch.undo()
    assert load_checkpoint(tmp_path / "run")[1]["step"] == 1
    assert main(["fit", "--out", str(tmp_path / "run"), "--resume"]) == 0


@with_sh
@pytest.mark.slow
@pytest.mark.parametrize("output", LOST)
def test_a_fit_from_a_shell(demo, tmp_path, output):
    """In a process as a shell starts it: code 0, and all files, whatever became of its words."""
    code, said = shell(fit_words(demo, tmp_path / "run"), output, tmp_path)
    assert code == 0 and (tmp_path / "run" / "report.html").is_file(), said
    assert said == (f"warpgs: stdout cannot be written ({LOST[output]}){GOES_ON}" if LOST[output] else "")


@with_sh
@pytest.mark.slow
def test_every_command_goes_on(demo, tmp_path, monkeypatch):
    """What is written to files is there, and stderr holds one line on the output; a table is a product, and is not."""
    shutil.copytree(demo, demo.parent / "scenes" / "s0")
    names = "demo fit resume eval render plot export convert prune mesh priors farm compare".split()
    commands = [*(words_of(name, demo, tmp_path) for name in names), ["doctor", "--warm"]]
    for words in commands:
        errors = io.StringIO()
        monkeypatch.setattr(sys, "stdout", Broken(0, errno.ENOSPC))
        monkeypatch.setattr(sys, "stderr", errors)
        assert main(words) == (4 if words[0] == "compare" else 0), errors.getvalue()
        said = errors.getvalue()
        assert said.count("\n") == 1 and "stdout cannot be written" in said, (words, said)
    there = "b.spz m.glb results/index.html study/table.md run/plot.png run/eval.json run-pruned/config.json"
    assert all((tmp_path / name).is_file() for name in there.split())


# What the program prints: text that no terminal obeys, in letters that the terminal has.

ROOT = Path(__file__).parent.parent.parent
NASTY = "\x1b]0;owned\x07\x1b[2Ja\rb\nc\x9b31m\u202ed\u2066e\x7f\u2028f\ud800"


def test_what_a_terminal_would_obey_is_printed_as_codes():
    """ESC, BEL, CR, line ends, C1, DEL, changes of direction, halves of characters; letters of all scripts stay."""
    assert process.printable(NASTY) == r"\x1b]0;owned\x07\x1b[2Ja\rb\nc\x9b31m\u202ed\u2066e\x7f\u2028f\ud800"
    for text in ("Straße, 写真 № 1", "می‌خواهم", "👩‍👩‍👧", "e\u0301 \u2013 \u201cx\u201d"):
        assert process.printable(text) == text
    # one file alone calls `print` or writes to stdout or stderr; a table of the doctor goes through rich, cell by cell
    for path in (ROOT / "warpgs").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.Call) and path.name != "process.py":
                name = ast.unparse(node.func) if isinstance(node.func, (ast.Name, ast.Attribute)) else ""
                assert name != "print" and not name.startswith(("sys.stdout.w", "sys.stderr.w")), path


@pytest.mark.parametrize("encoding", ["ascii", "cp1252", "utf-8"])
def test_letters_that_a_terminal_does_not_have(monkeypatch, encoding):
    raw = io.BytesIO()
    stream = io.TextIOWrapper(raw, encoding)
    monkeypatch.setattr(sys, "stdout", stream)
    process.say(f"写真{NASTY}")
    wanted = "写真" if encoding == "utf-8" else r"\u5199\u771f"
    assert raw.getvalue().decode(encoding).startswith(wanted) and b"\x1b" not in raw.getvalue()


def streams(monkeypatch, encoding):
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
