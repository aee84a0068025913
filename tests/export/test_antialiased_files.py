"""Files that say how they are rendered: antialiased or not, in our words and in those of other programs."""

import warnings

import pytest

from tests.gaussians import cloud
from warpgs.errors import DataError
from warpgs.export import spz
from warpgs.export.base import format_of, read_gaussians, read_with_antialiasing, suffixes, write_gaussians
from warpgs.export.ply import read_ply
from warpgs.pipeline.run.export import convert

SUFFIXES = suffixes()


def model():
    return cloud(300, degree=3)


@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply"])
def test_other_ways_of_rendering_are_refused(suffix, tmp_path):
    path = tmp_path / f"a{suffix}"
    write_gaussians(path, model(), units="file")
    data = path.read_bytes()
    assert b"comment SplatRenderMode: default\ncomment antialiased 0\n" in data
    path.write_bytes(data.replace(b"comment antialiased 0", b"comment SplatRenderMode: 2dgs"))
    with pytest.raises(DataError, match="'2dgs'"):
        read_gaussians(path)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_files_say_that_they_are_antialiased(suffix, tmp_path):
    """Those that can; reading them warns, once, and only then."""
    for antialiased in (True, False):
        path = tmp_path / f"{antialiased}{suffix}"
        write_gaussians(path, model(), units="file", antialiased=antialiased)
        expected = antialiased and format_of(path).declares
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            read_gaussians(path)
            if suffix == ".ply":
                read_ply(path)
        assert [("antialiased=True" in str(w.message), w.filename) for w in caught] == [(True, __file__)] * len(caught)
        assert len(caught) == expected * (1 + (suffix == ".ply"))
        again = tmp_path / f"{antialiased}-again.spz"
        convert(path, again)
        assert read_with_antialiasing(again, None, "file")[1] is expected
    declaring = {".ply", ".compressed.ply", ".spz", ".sog"}
    assert format_of(path).declares == (suffix in declaring)


@pytest.mark.parametrize("line,expected", [("SplatRenderMode: mip", True), ("antialiased 1", True), ("antialiased 0", False)])
def test_comments_of_other_programs(line, expected, tmp_path):
    """The last of them decides."""
    path = tmp_path / "a.ply"
    write_gaussians(path, model(), units="file")
    before = b"comment antialiased 0"
    path.write_bytes(path.read_bytes().replace(before, b"comment SplatRenderMode: mip\ncomment " + line.encode()))
    assert read_with_antialiasing(path, None, "file")[1] is expected


def test_spz_of_version_4_says_it_too(tmp_path):
    pytest.importorskip("zstandard")
    path = tmp_path / "a.spz"
    write_gaussians(path, model(), units="file", format=spz.SPZ(spz.SPZConfig(version=4)), antialiased=True)
    assert read_with_antialiasing(path, None, "file")[1]
