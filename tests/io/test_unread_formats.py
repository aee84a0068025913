"""Photographs in formats that are known and cannot be read here: one sentence with the format and the remedy."""

import pytest

from tests.io import scenes
from warpgs.errors import DataError
from warpgs.io.image_files import decode
from warpgs.io.load import load_scene

FTYP = b"\0\0\0\x1cftyp"


@pytest.mark.parametrize(
    "name,data,words",
    [
        (
            "a.heic",
            FTYP + b"heic\0\0\0\0mif1heic" + bytes(40),
            "a HEIC photograph, which is supported only for finding poses.*JPEG",
        ),
        ("a.jpg", FTYP + b"mif1", "a HEIC photograph"),  # truncated, under another name
        ("a.DNG", b"II*\0" + bytes(60), "a RAW file.*convert"),
        ("a.cr3", FTYP + b"crx ", "a RAW file"),
    ],
)
def test_the_format_and_its_remedy_are_named(name, data, words, tmp_path):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(DataError, match=rf"{name}: is {words}"):
        decode(tmp_path / name)


def test_a_folder_of_raw_files_is_told_from_an_empty_one(tmp_path):
    scenes.WRITERS["llff"](tmp_path)
    for file in (tmp_path / "images").iterdir():
        file.rename(file.with_suffix(".NEF"))
    with pytest.raises(DataError, match=r"images: .*\.NEF is a RAW file, which is not supported; convert"):
        load_scene(tmp_path)
