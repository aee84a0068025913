"""A file format of one's own: one class in one file, written and read by the commands and from Python."""

import gzip
import sys

import numpy as np
import pytest
import torch

from tests.gaussians import cloud
from warpgs.app.cli import main
from warpgs.errors import UsageError
from warpgs.export.base import FORMATS, Format, format_of, read_gaussians, suffixes, write_gaussians
from warpgs.pipeline.run.export import convert

OWN = '''
import io
from dataclasses import dataclass

import numpy as np

from warpgs.export.base import Format


@dataclass(frozen=True)
class Options:
    packed: bool = False
    """Make the archive smaller,
    in more time."""


class Archive(Format):
    """Arrays of numpy."""

    suffix = ".mine"
    Config = Options

    def encode(self, arrays):
        out = io.BytesIO()
        (np.savez_compressed if self.config.packed else np.savez)(out, **arrays)
        return [out.getvalue()]

    def decode(self, path, data):
        with np.load(io.BytesIO(data), allow_pickle=False) as found:
            return dict(found)


class Nameless(Format):
    pass


class Written(Format):
    suffix = ".txt"

    def encode(self, arrays):
        return [b"%d" % len(arrays["means"])]
'''


@pytest.fixture
def own(tmp_path, monkeypatch):
    """The file, which is forgotten after the test."""
    FORMATS.names()
    monkeypatch.setattr(FORMATS, "_classes", dict(FORMATS._classes))
    path = tmp_path / "mine.py"
    path.write_text(OWN)
    write_gaussians(tmp_path / "a.ply", cloud(40), units="file")
    yield path
    for name in [n for n, m in sys.modules.items() if getattr(m, "__file__", None) == str(path)]:
        del sys.modules[name]


def test_one_file_adds_a_format(own, tmp_path, capsys):
    """To convert to it and back, with options of its own; the bits are those that were stored."""
    spec, flags = f"{own}:Archive", ["--no-clean"]
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.mine"), "--format", spec, *flags]) == 0
    small = ["--archive.packed", *flags]
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "c.mine"), "--format", spec, *small]) == 0
    assert (tmp_path / "c.mine").stat().st_size < (tmp_path / "b.mine").stat().st_size
    assert main(["convert", str(tmp_path / "c.mine"), str(tmp_path / "d.ply"), "--format", spec]) == 0
    assert (tmp_path / "d.ply").read_bytes() == (tmp_path / "a.ply").read_bytes()
    with pytest.raises(SystemExit):
        main(["convert", "--format", spec, "--help"])
    said = " ".join(capsys.readouterr().out.replace("│", "").split())
    assert "--archive.packed" in said and "Make the archive smaller, in more time" in said


def test_python_takes_a_class_an_object_or_its_place(own, tmp_path):
    cls = FORMATS.load(f"{own}:Archive")
    for i, choice in enumerate((cls, cls(), cls(cls.Config(packed=True)), f"{own}:Archive")):
        write_gaussians(tmp_path / f"{i}.mine", cloud(40), units="file", format=choice)
        back = read_gaussians(tmp_path / f"{i}.mine", format=choice)
        assert torch.equal(back.means, cloud(40).means)
    assert (tmp_path / "2.mine").stat().st_size < (tmp_path / "1.mine").stat().st_size
    lines = convert(tmp_path / "0.mine", tmp_path / "o.spz", formats=[cls])
    assert any("the format rounds positions" in line for line in lines)


def test_a_registered_format_is_found_by_its_suffix(own, tmp_path, capsys):
    """Without a word about it, in the help too; those of ours keep their files."""

    @FORMATS.register("rows")
    class Rows(Format):
        """Rows of numbers. More."""

        suffix = ".rows"

    @FORMATS.register("taken")
    class Taken(Format):
        suffix = ".ply"

    assert ".rows" in suffixes() and type(format_of("a.rows")) is Rows and format_of("a.ply").name == "ply"
    assert type(format_of("a.ply", Taken)) is Taken and FORMATS.described()["rows"] == "Rows of numbers"
    for command in ("export", "convert"):
        with pytest.raises(SystemExit):
            main([command, "--help"])
        assert ".rows" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["b.other", "--format", "{own}:Archive"], "expected a name that ends in .mine"),
        (["b.mine"], "format .mine is not supported"),
        (["b.mine", "--format", "{own}:Nameless"], "has the suffix ''"),
        (["b.mine", "--format", "{own}:np"], "must be a class that derives from warpgs.Format"),
        (["b.mine", "--format", "best"], "unknown format 'best'; choose one of"),
        (["b.mine", "--format", "{own}:Archive", "--spz.version", "2"], "--spz.* are not options of the format"),
        (["b.spz", "--spz.version", "9"], "SPZ version 9"),
        (["cameras.json", "--format", "{own}:Archive"], "--format does not apply to cameras"),
    ],
)
def test_mistakes_are_one_sentence(own, tmp_path, capsys, flags, said):
    name, *more = (word.format(own=own) for word in flags)
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / name), *more]) == 2
    text = capsys.readouterr().err
    assert said in text and len(text.splitlines()) == 1 and not (tmp_path / name).exists()


def test_a_format_may_write_alone(own, tmp_path):
    """What it cannot read is not read back to tell what was rounded."""
    spec = f"{own}:Written"
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "n.txt"), "--format", spec, "--no-clean"]) == 0
    assert (tmp_path / "n.txt").read_text() == "40"
    with pytest.raises(UsageError, match="can be written but not read"):
        read_gaussians(tmp_path / "n.txt", format=spec)


def test_an_option_of_ours_is_a_flag(tmp_path):
    write_gaussians(tmp_path / "a.ply", cloud(9), units="file")
    assert main(["convert", str(tmp_path / "a.ply"), str(tmp_path / "b.spz"), "--spz.version", "2", "--no-clean"]) == 0
    assert np.frombuffer(gzip.decompress((tmp_path / "b.spz").read_bytes())[4:8], "<u4") == 2


def test_no_file_names_code(own, tmp_path):
    """A name with a colon is looked up where something stored names it, and never imported."""
    before = set(sys.modules)
    with pytest.raises(UsageError, match="does not load your code"):
        FORMATS.find(f"{own}:Archive")
    with pytest.raises(UsageError, match="is not supported"):
        format_of(tmp_path / f"{own.name}:Archive")
    assert not any("mine" in n for n in set(sys.modules) - before)
