"""HEIC photographs are read in a process of their own: upright, with what EXIF says of the lens alone, or told of by name."""

import base64
import sys

import numpy as np
import pytest
from PIL import Image

from warpgs.errors import DataError, UsageError
from warpgs.poses import photographs
from warpgs.poses.photographs import is_heic, prepare, to_jpeg
from warpgs.process import ProcessFailed

HEIC = base64.b64decode(
    "AAAAHGZ0eXBoZWljAAAAAG1pZjFoZWljbWlhZgAAAaFtZXRhAAAAAAAAACFoZGxyAAAAAAAAAABwaWN0AAAAAAAAAAAAAAAAAAAAADRpbG9jAAAAAERA"
    "AAIAAQAAAAABxQABAAAAAAAAAGgAAgAAAAACLQABAAAAAAAAAGYAAAA4aWluZgAAAAAAAgAAABVpbmZlAgAAAAABAABodmMxAAAAABVpbmZlAgAAAQAC"
    "AABFeGlmAAAAAA5waXRtAAAAAAABAAAA4GlwcnAAAADAaXBjbwAAAHhodmNDAQNwAAAAkAAAAAAAHvAA/P34+AAADwNgAAEAGEABDAH//wNwAAADAJAA"
    "AAMAAAMAHroCQGEAAQArQgEBA3AAAAMAkAAAAwAAAwAeoDCBBZbqSSmubgIaDAgAAAMAyAAAAwAIQGIAAQAHRAHBcrAiQAAAABNjb2xybmNseAABAA0A"
    "BoAAAAAUaXNwZQAAAAAAAABgAAAAQAAAABBwaXhpAAAAAAMICAgAAAAJaXJvdAMAAAAYaXBtYQAAAAAAAAABAAEFgQIDBIUAAAAaaXJlZgAAAAAAAAAO"
    "Y2RzYwACAAEAAQAAANZtZGF0AAAAZCgBrxOAeNZTVEf//cTBv/aF6f/BoyWCqf/YKz7y4m/8Rn83KXHxLxOBO6siyPbpoxDKxMncPtUCmC6JtI/8R2K7"
    "S5uv/4BtEeUR7/x33sB8T9VzX8Q8fCskcuQ12Ue10SR7nIcAAAAGRXhpZgAATU0AKgAAAAgABAEPAAIAAAAGAAAAPgEQAAIAAAAGAAAARAESAAMAAAAB"
    "AAYAAIdpAAQAAAABAAAASgAAAABNYWtlcgBQaG9uZQAAAaQFAAMAAAABABoAAAAAAAA="
)
"""96 x 64 px, to be turned by a quarter: gray, the upper left quarter red; with maker, model, 26 mm. Written by pillow-heif."""


def convert(folder, data: bytes, max_pixels: int = 10**6):
    source = folder / "in" / "sub" / "a.heic"
    source.parent.mkdir(parents=True)
    source.write_bytes(data)
    return to_jpeg([source], folder / "in", folder / "out", max_pixels)[source]


def test_copies_are_upright_and_tell_the_lens(tmp_path):
    pytest.importorskip("pi_heif")
    copy = convert(tmp_path, HEIC)
    assert copy == tmp_path / "out" / "sub" / "a.heic.jpg" and is_heic(tmp_path / "in" / "sub" / "a.heic") and not is_heic(copy)
    photograph = prepare(copy, tmp_path / "out", tmp_path / "small.png")
    assert (photograph.name, photograph.width, photograph.height) == ("sub/a.heic.jpg", 64, 96)
    assert photograph.device == "Maker Phone 26 mm" and photograph.orientation == 1
    np.testing.assert_allclose(photograph.focal, 26 / np.hypot(36, 24) * np.hypot(64, 96) / 96)
    pixels = np.asarray(Image.open(copy))
    np.testing.assert_allclose(pixels[24, 48], [230, 40, 40], atol=10)
    np.testing.assert_allclose(pixels[24, 16], 60, atol=10)


@pytest.mark.parametrize(
    ("data", "max_pixels", "why"),
    [
        (HEIC[:-9], 10**6, "end of file"),
        (HEIC[:100], 10**6, "meta"),
        (HEIC, 100, r"64 x 96 px are more than the limit of 100 pixels \(--max-pixels\)"),
    ],
)
def test_a_file_that_cannot_be_read_is_named(tmp_path, data, max_pixels, why):
    pytest.importorskip("pi_heif")
    with pytest.raises(DataError, match=rf"a\.heic: the image cannot be decoded: .*{why}.*\. Restore it"):
        convert(tmp_path, data, max_pixels)


def test_a_file_that_ends_its_reader_is_named(tmp_path, monkeypatch):
    """Some that were changed at random do."""

    def lines(*arguments, **options):
        yield '{"file": 0}'
        raise ProcessFailed(-11, "")

    pytest.importorskip("pi_heif")
    monkeypatch.setattr(photographs, "python_lines", lines)
    with pytest.raises(DataError, match=r"a\.heic: the image cannot be decoded: the decoder ended with code -11\. Restore it"):
        convert(tmp_path, HEIC)


def test_what_reads_it_is_named_where_it_is_missing(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    with pytest.raises(
        UsageError,
        match=r"a\.heic: is a HEIC photograph, .*`pip install '\.\[poses\]'` .*, or convert",
    ):
        convert(tmp_path, HEIC)
