"""Photographs and videos: HEIC in a process of its own, links, sizes before decoding, EXIF with bounds."""

import base64
import io
import json
import os
import struct
import sys
import tracemalloc

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.io.scenes import link
from tests.poses.conftest import film, with_exif
from tests.test_files import special
from warpgs.errors import DataError, UsageError
from warpgs.io.image_files import NO_EXIF, parse_exif, read_exif
from warpgs.io.load import load_scene
from warpgs.pipeline.run.fit import with_poses
from warpgs.pipeline.run.request import SceneRequest
from warpgs.poses import find, photographs
from warpgs.poses.find import find_poses, source_digest
from warpgs.poses.photographs import is_heic, prepare, to_jpeg, write_frames
from warpgs.process import ProcessFailed

BOMB = bytes.fromhex("524946461a0000005745425056503 84c0e0000002ffebfff0f071011fd0f4444ff03".replace(" ", ""))
"""A lossless WebP file of 34 bytes that unpacks to 16,383 x 16,383 px of one colour."""


@pytest.fixture
def folder(tmp_path):
    """Photographs beside a private one."""
    for name in ("scene/a.png", "scene/b.png", "scene/c.png", "private/d.png"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / name), np.full((40, 60, 3), ord(name[-5]), np.uint8))
    return tmp_path / "scene"


class Searched(Exception):
    """The search for poses begins."""


@pytest.fixture(autouse=True)
def no_search(monkeypatch):
    def found(*arguments):
        raise Searched

    monkeypatch.setattr(find, "check_installed", lambda: None)
    monkeypatch.setattr(find, "find_model", found)


def commands(folder, **options):
    """The two ways to poses: `warpgs poses` and `warpgs fit` of photographs."""
    yield lambda: find_poses(folder, folder.parent / "out", **options)
    yield lambda: with_poses(SceneRequest(str(folder), None, **options), folder.parent / "run", lambda line: None)


@pytest.mark.parametrize("what", ["d.png", "x/y.png", "images"])
def test_links_lead_out_only_where_that_is_allowed(folder, what):
    private = folder.parent / "private"
    (folder / "x").mkdir()
    link(folder / what, private if what == "images" else private / "d.png")
    for command in commands(folder):
        with pytest.raises(DataError, match=r"a link points outside the folder of photographs; .*--allow-outside"):
            command()
    assert not (folder.parent / "out").exists() and not (folder.parent / "run" / "scene").exists()
    with pytest.raises(DataError, match="points outside"):
        source_digest(folder)
    if what != "images":  # one photograph is too few
        for command in commands(folder, allow_outside=True):
            with pytest.raises(Searched):
                command()
    assert source_digest(folder, allow_outside=True)


def test_links_inside_are_followed_and_a_pipe_is_no_photograph(folder):
    (folder / "originals").mkdir()
    (folder / "a.png").rename(folder / "originals" / "a.jpg")
    link(folder / "a.png", folder / "originals" / "a.jpg")
    if os.name != "nt":
        special("pipe", folder / "x.png")
    with pytest.raises(Searched):
        find_poses(folder, folder.parent / "out")


def test_a_video_among_photographs_is_named_with_the_command_that_takes_its_frames(folder, tmp_path):
    """As a note beside photographs, and as the error in a folder without."""
    (folder / "clip.MP4").touch()
    named = f"clip.MP4 is a video; `warpgs fit {folder / 'clip.MP4'}` takes its frames"
    (tmp_path / "work" / "small").mkdir(parents=True)
    assert f"left out: {named}" in find._prepared(folder, tmp_path / "work", 60, 10**6, lambda line: None)[2]
    (tmp_path / "videos").mkdir()
    (folder / "clip.MP4").rename(tmp_path / "videos" / "clip.MP4")
    for command in (load_scene, lambda path: find_poses(path, tmp_path / "out")):
        with pytest.raises(DataError) as e:
            command(tmp_path / "videos")
        assert str(e.value) == f"{tmp_path / 'videos'}: {named.replace(str(folder), str(tmp_path / 'videos'))}"


def test_two_photographs_of_one_name_in_the_scene_are_refused(folder):
    cv2.imwrite(str(folder / "a.bmp"), np.zeros((40, 60, 3), np.uint8))
    (folder / "a.png").rename(folder / "a.bmp.png")
    with pytest.raises(DataError, match=r"a\.bmp and a\.bmp\.png would both be 'a\.bmp\.png' in the scene"):
        find_poses(folder, folder.parent / "out")


def test_a_size_beyond_the_limit_is_refused_before_exif(folder):
    """Pillow allots the canvas of a WebP file, a gigabyte here, as soon as it looks at EXIF."""
    (folder / "b.webp").write_bytes(BOMB)
    with pytest.raises(DataError, match=r"b\.webp: the image is 16383 x 16383 px, more than the limit of 100,000,000 pixels"):
        find_poses(folder, folder.parent / "out")
    tracemalloc.start()
    assert read_exif(BOMB) == NO_EXIF
    assert tracemalloc.get_traced_memory()[1] < 2**16
    tracemalloc.stop()


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP", "TIFF", "AVIF"])
def test_exif_of_every_format(kind):
    exif, out = Image.Exif(), io.BytesIO()
    exif[0x010F], exif[0x0110], exif[0x0112] = "Maker", "Phone", 6
    exif.get_ifd(0x8769)[0xA405] = 26
    Image.new("RGB", (40, 30)).save(out, kind, exif=exif)
    expected = 6, "Maker", "Phone", None if kind == "TIFF" else 26.0  # Pillow writes no exposure data into TIFF
    assert read_exif(out.getvalue()) == expected


@pytest.mark.parametrize("order", ["<", ">"])
def test_exif_is_read_with_bounds(order, tmp_path):
    """Entries that overlap, lie outside, or are of another kind than they must be."""
    head = (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "I", 8)

    def block(*entries, after=b""):
        rows = b"".join(struct.pack(order + "HHI", *e[:3]) + e[3] for e in entries)
        return head + struct.pack(order + "H", len(entries)) + rows + b"\0\0\0\0" + after

    def long(n):
        return struct.pack(order + "I", n)

    def short(n):
        return struct.pack(order + "Hxx", n)

    assert parse_exif(block((0x0112, 3, 1, short(8))))[0] == 8
    for entry in ((0x0112, 3, 1, short(9)), (0x0112, 3, 2, short(8)), (0x0112, 2, 1, b"6\0\0\0"), (0x0112, 5, 1, long(0))):
        assert parse_exif(block(entry)) == NO_EXIF
    assert parse_exif(block((0x010F, 2, 2**32 - 1, long(22)), after=b"x" * 500))[1].count("x") > 90
    assert parse_exif(block((0x010F, 2, 9, long(2**32 - 1)))) == NO_EXIF
    assert parse_exif(block((0x8769, 4, 1, long(8))))[3] is None  # the block of exposure data is the directory itself
    assert parse_exif(block((0x8769, 4, 1, long(2**31)))) == NO_EXIF
    assert parse_exif(head + struct.pack(order + "H", 65535) + b"\0" * 65535 * 12) == NO_EXIF
    whole = block((0x0112, 3, 1, short(8)), (0x010F, 2, 9, long(38)), after=b"some text")
    for end in range(len(whole)):
        assert len(parse_exif(whole[:end])) == 4
    data = with_exif(np.zeros((40, 60, 3), np.uint8), 6)
    at = data.index(b"Exif\0\0") + 6
    (tmp_path / "a.jpg").write_bytes(data[:at] + b"\xff" * 40 + data[at + 40 :])
    p = prepare(tmp_path / "a.jpg", tmp_path, tmp_path / "small.png")
    assert (p.width, p.height, p.orientation, p.device, p.focal) == (60, 40, 1, "", None)


def test_tags_of_a_tiff_may_not_overlap(tmp_path):
    """4,000 tags that all stand for the whole file: Pillow and libtiff would copy it 4,000 times."""
    out, count = io.BytesIO(), 4000
    Image.new("L", (40, 30)).save(out, "TIFF")
    tail = 2**20
    rows = [(256, 3, 1, 40), (257, 3, 1, 30), *((1000 + i, 1, tail, 8 + 2 + 12 * (count + 2) + 4) for i in range(count))]
    data = b"II*\0" + struct.pack("<IH", 8, len(rows)) + b"".join(struct.pack("<HHII", *r) for r in rows) + b"\0" * (4 + tail)
    (tmp_path / "a.tif").write_bytes(data)
    tracemalloc.start()
    with pytest.raises(DataError, match=r"a\.tif: .*its tags overlap, or lie outside of the file"):
        prepare(tmp_path / "a.tif", tmp_path, tmp_path / "small.png")
    assert tracemalloc.get_traced_memory()[1] < 4 * 2**20
    tracemalloc.stop()


@pytest.mark.parametrize("name, most, why", [
    ("MAX_FRAME_PIXELS", 96 * 64 - 1, "its frames have 6,144 pixels"),
    ("MAX_TOTAL_PIXELS", 96 * 64 * 5, "pixels in all frames"),
    ("MAX_FRAMES", 5, "has more than 5 frames"),
])  # fmt: skip
def test_videos_are_bounded(name, most, why, tmp_path, monkeypatch):
    film(tmp_path / "a.avi", 12)
    monkeypatch.setattr(f"warpgs.poses.photographs.{name}", most)
    with pytest.raises(DataError, match=rf"a\.avi: .*{why}"):
        write_frames(tmp_path / "a.avi", tmp_path, 3, lambda line: None)


@pytest.mark.parametrize("text", ["#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{}\n", "ffconcat version 1.0\nfile {}\n"])
def test_a_playlist_is_no_video(text, tmp_path):
    """FFmpeg would open the files that a playlist names; an AVI header claims four thousand million frames, not twelve."""
    film(tmp_path / "private.avi", 12)
    (tmp_path / "a.mp4").write_text(text.format("private.avi"))
    with pytest.raises(DataError, match="cannot read it as a video"):
        write_frames(tmp_path / "a.mp4", tmp_path, 3, lambda line: None)
    data = bytearray((tmp_path / "private.avi").read_bytes())
    struct.pack_into("<I", data, data.index(b"avih") + 24, 2**32 - 1)
    (tmp_path / "a.avi").write_bytes(data)
    assert write_frames(tmp_path / "a.avi", tmp_path, 3, lambda line: None) == 12


# HEIC photographs are read in a process of their own: upright, with what EXIF says of the lens alone, or told of by
# name.

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
    source.parent.mkdir(parents=True, exist_ok=True)
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


def test_a_file_that_cannot_be_read_is_named(tmp_path, monkeypatch, capsys):
    """Also where the file ends its reader, as some do that were changed at random, or where there is no reader."""
    pytest.importorskip("pi_heif")
    limit = r"64 x 96 px are more than the limit of 100 pixels \(--max-pixels\)"
    for data, max_pixels, why in ((HEIC[:-9], 10**6, "end of file"), (HEIC[:100], 10**6, "meta"), (HEIC, 100, limit)):
        with pytest.raises(DataError, match=rf"a\.heic: the image cannot be decoded: .*{why}.*\. Restore it"):
            convert(tmp_path, data, max_pixels)

    def bomb(source, max_pixels):
        raise Image.DecompressionBombError("too large")

    monkeypatch.setattr(photographs, "_coded_again", bomb)
    (tmp_path / "job.json").write_text(json.dumps({"max_pixels": 1, "files": [["a.heic", "b.jpg"]]}))
    photographs.main(str(tmp_path / "job.json"))
    assert [json.loads(line) for line in capsys.readouterr().out.splitlines()] == [{"file": 0}, {"error": "too large"}]

    def lines(*arguments, **options):
        yield '{"file": 0}'
        raise ProcessFailed(-11, "")

    monkeypatch.setattr(photographs, "python_lines", lines)
    with pytest.raises(DataError, match=r"a\.heic: the image cannot be decoded: the decoder ended with code -11\. Restore it"):
        convert(tmp_path, HEIC)
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    with pytest.raises(UsageError, match=r"a\.heic: HEIC, .*`pip install '.*(pi-heif|poses).*`.*, or convert"):
        convert(tmp_path, HEIC)
