"""Images are taken whole or not at all: damage that a checksum, a decoder or the sizes in the file show is refused."""

import io
import struct
import zlib

import cv2
import numpy as np
import pytest
from PIL import Image

from tests.io import scenes
from warpgs.errors import DataError, ResourceError
from warpgs.io.image_files import decode
from warpgs.io.load import load_scene


def photo(width=96, height=64) -> Image.Image:
    """Return a smooth image with some noise, as a photograph has it."""
    rng = np.random.default_rng(0)
    values = scenes.image(3, width, height).astype(float) + rng.normal(0, 6, (height, width, 3))
    return Image.fromarray(np.clip(values, 0, 255).astype(np.uint8))


def encoded(kind: str, image: Image.Image | None = None, **options) -> bytes:
    out = io.BytesIO()
    (image or photo()).save(out, kind, **options)
    return out.getvalue()


def zeroed(data: bytes, start: float, end: float) -> bytes:
    """Return the data with a part of it, in fractions of its length, set to zero."""
    a, b = int(start * len(data)), int(end * len(data))
    return data[:a] + bytes(b - a) + data[b:]


def refused(tmp_path, data: bytes, reason: str, **options) -> None:
    path = tmp_path / "photo.img"
    path.write_bytes(data)
    with pytest.raises(DataError, match=f"photo.img: the image .*{reason}"):
        decode(path, **options)


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png(width: int, height: int, rows: bytes, interlaced: int = 0) -> bytes:
    """Return a gray PNG of 8 bits from its rows with their filter bytes."""
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, interlaced)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(rows)) + chunk(b"IEND", b"")


def tiff(width: int, height: int, strips: list[tuple[int, int]], pixels: bytes, compression: int = 1, rows: int = 0) -> bytes:
    """Return a gray TIFF of 8 bits whose strips, pairs (offset into the pixels, length), are of ``rows`` rows each."""
    count = len(strips)
    tags = [(256, width), (257, height), (258, 8), (259, compression), (262, 1), (277, 1), (278, rows or height)]
    place = 8 + 2 + 12 * (len(tags) + 2) + 4
    body = place + 8 * count
    offsets, lengths = [body + o for o, _ in strips], [n for _, n in strips]
    entries = [struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags[:5]]
    for tag, values, where in ((273, offsets, place), (279, lengths, place + 4 * count)):
        entries.append(struct.pack("<HHII", tag, 4, count, values[0] if count == 1 else where))
    entries[6:6] = [struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags[5:]]
    directory = struct.pack("<H", len(entries)) + b"".join(entries) + bytes(4)
    return b"II*\0" + struct.pack("<I", 8) + directory + struct.pack(f"<{2 * count}I", *offsets, *lengths) + pixels


# ---- undamaged files keep their pixels -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "mode,options",
    [
        *(("RGB", {"subsampling": s, "progressive": p}) for s in ("4:4:4", "4:2:2", "4:2:0", "4:1:1") for p in (False, True)),
        ("RGB", {"quality": 20, "restart_marker_blocks": 3, "optimize": True}), ("RGB", {"keep_rgb": True}),
        ("L", {}), ("L", {"progressive": True}), ("CMYK", {}), ("CMYK", {"progressive": True}),
    ],
)  # fmt: skip
def test_pixels_of_a_jpeg_are_those_of_opencv(mode, options, tmp_path):
    path = tmp_path / "a.jpg"
    path.write_bytes(encoded("JPEG", photo(97, 63).convert(mode), **options) + b"a film follows some photographs")
    raster = np.atleast_3d(cv2.imread(str(path), cv2.IMREAD_UNCHANGED))
    expected = raster[..., ::-1].astype(np.float32) / 255
    assert (decode(path)[0] == expected).all()


def test_an_interlaced_png_is_read(tmp_path):
    gray = np.arange(11 * 9, dtype=np.uint8).reshape(9, 11)
    parts = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
    rows = [b"\0" + row.tobytes() for x, y, dx, dy in parts for row in gray[y::dy, x::dx] if row.size]
    path = tmp_path / "a.png"
    path.write_bytes(png(11, 9, b"".join(rows), interlaced=1))
    assert (decode(path)[0][..., 0] == gray / np.float32(255)).all()
    refused(tmp_path, png(11, 9, b"".join(rows[:-1]), interlaced=1), "decoded")


@pytest.mark.parametrize("order", ["<", ">"])
def test_big_tiff_and_tiles_are_read(order, tmp_path):
    gray = (99 * np.arange(32 * 16).reshape(16, 32)).astype(order + "u2")
    tags = [(256, 3, 32), (257, 3, 16), (258, 3, 16), (259, 3, 1), (262, 3, 1), (277, 3, 1), (322, 3, 16), (323, 3, 16)]
    start = 16 + 8 + 20 * 10 + 8
    offsets, lengths = struct.pack(order + "2Q", start + 32, start + 32 + 512), struct.pack(order + "2Q", 512, 512)
    entries = b"".join(struct.pack(order + "HHQ", t, k, 1) + struct.pack(order + "H6x", v) for t, k, v in tags)
    entries += struct.pack(order + "HHQQ", 324, 16, 2, start) + struct.pack(order + "HHQQ", 325, 16, 2, start + 16)
    magic = {"<": b"II+\0", ">": b"MM\0+"}[order]
    data = magic + struct.pack(order + "HHQQ", 8, 0, 16, 10) + entries + bytes(8) + offsets + lengths
    path = tmp_path / "a.tif"
    path.write_bytes(data + gray[:, :16].tobytes() + gray[:, 16:].tobytes())
    assert (decode(path)[0][..., 0] == gray / np.float32(65535)).all()
    refused(tmp_path, path.read_bytes()[:-1], "lie outside of the file")


# ---- JPEG ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("options", [{}, {"progressive": True}, {"restart_marker_blocks": 8}])
@pytest.mark.parametrize("part", [(0.4, 0.6), (0.5, 0.99)])
def test_a_jpeg_whose_coded_data_is_zeroed(options, part, tmp_path):
    data = encoded("JPEG", **options)
    refused(tmp_path, zeroed(data[:-2], *part) + data[-2:], "decoded")


@pytest.mark.parametrize("kept", [0.5, 0.9, 0.99])
@pytest.mark.parametrize("options", [{}, {"progressive": True}])
def test_a_jpeg_that_lacks_coded_data_behind_a_kept_end_marker(options, kept, tmp_path):
    data = encoded("JPEG", **options)
    refused(tmp_path, data[: int(kept * len(data))] + data[-2:], "decoded")


def test_a_progressive_jpeg_that_lacks_scans(tmp_path):
    data = encoded("JPEG", progressive=True)
    scans = [i for i in range(len(data)) if data[i : i + 2] == b"\xff\xda"]
    assert len(scans) > 3
    for at in scans[1:]:
        refused(tmp_path, data[:at] + b"\xff\xd9", "some of its scans are missing")


@pytest.mark.parametrize("height,width", [(72, 96), (48, 96), (64, 128), (64, 80)])
@pytest.mark.parametrize("options", [{}, {"progressive": True}])
def test_a_jpeg_of_another_size_than_its_header_says(height, width, options, tmp_path):
    data = bytearray(encoded("JPEG", **options))
    at = data.index(b"\xff\xc2" if options else b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">HH", height, width)
    refused(tmp_path, bytes(data), "decoded")


# ---- PNG, BMP, WebP --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("at", [0.1, 0.3, 0.5, 0.7, 0.9])
def test_a_png_with_one_wrong_bit(at, tmp_path):
    data = bytearray(encoded("PNG"))
    data[int(at * len(data))] ^= 4
    refused(tmp_path, bytes(data), "checksum of its part IDAT does not match")


def test_a_png_that_lacks_a_part_or_whose_pixels_have_another_checksum(tmp_path):
    rows = bytes(13) * 8
    good = png(12, 8, rows)
    (tmp_path / "a.png").write_bytes(good)
    assert decode(tmp_path / "a.png")[0].shape == (8, 12, 3)
    packed = zlib.compress(rows)
    whole = chunk(b"IDAT", packed)
    refused(tmp_path, good.replace(whole, b""), "pixels are damaged")
    refused(tmp_path, good.replace(whole, chunk(b"IDAT", packed[:-5])), "decoded")
    refused(tmp_path, good.replace(whole, chunk(b"IDAT", packed[:-1] + b"\x77")), "decoded")
    refused(tmp_path, png(12, 9, rows), "decoded")
    refused(tmp_path, good[:-12], "it ends early")


def test_a_bmp_or_webp_that_is_shorter_than_its_header_says(tmp_path):
    refused(tmp_path, encoded("BMP")[:-9], "truncated")
    refused(tmp_path, encoded("WEBP")[:-9], "it ends early")
    refused(tmp_path, b"RIFF" + struct.pack("<I", 4) + b"WEBP" + bytes(8), "its header is broken")
    data = bytearray(encoded("BMP"))
    data[22:26] = struct.pack("<i", 80)
    refused(tmp_path, bytes(data), "truncated")
    data[22:26], data[30:34] = struct.pack("<i", 64), struct.pack("<I", 1)
    refused(tmp_path, bytes(data), "compressed, so damage would not be detected")


# ---- TIFF ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("compression", ["tiff_lzw", "tiff_adobe_deflate", "tiff_deflate"])
def test_a_compressed_tiff_with_a_zeroed_middle(compression, tmp_path):
    refused(tmp_path, zeroed(encoded("TIFF", compression=compression), 0.4, 0.6), "damaged")


def test_a_compressed_tiff_of_16_bits_with_a_zeroed_middle(tmp_path):
    ok, data = cv2.imencode(".tif", np.asarray(photo()).astype(np.uint16) * 257, [cv2.IMWRITE_TIFF_COMPRESSION, 5])
    assert ok
    refused(tmp_path, zeroed(data.tobytes(), 0.4, 0.6), "decoded")


def test_strips_that_hold_too_little(tmp_path):
    pixels = bytes(range(64)) * 2
    (tmp_path / "a.tif").write_bytes(tiff(16, 8, [(0, 64), (64, 64)], pixels, rows=4))
    assert decode(tmp_path / "a.tif")[0].shape == (8, 16, 3)
    refused(tmp_path, tiff(2000, 2000, [(0, 100)], bytes(100)), "truncated")  # 222 bytes
    refused(tmp_path, tiff(16, 8, [(0, 64), (64, 65)], pixels, rows=4), "lie outside of the file")
    refused(tmp_path, tiff(16, 8, [(0, 64)], pixels, rows=4), "decoded")
    packed = zlib.compress(pixels)
    (tmp_path / "a.tif").write_bytes(tiff(16, 8, [(0, len(packed))], packed, 8))
    assert decode(tmp_path / "a.tif")[0].shape == (8, 16, 3)
    refused(tmp_path, tiff(16, 9, [(0, len(packed))], packed, 8), "decoded")
    refused(tmp_path, tiff(16, 8, [(0, len(packed))], packed[:-1] + b"\x77", 8), "incorrect data check")


# ---- files that announce much ----------------------------------------------------------------------------------------


def announcing(kind: str, width: int, height: int) -> bytes:
    """Return a small file whose header announces an image of another size."""
    if kind == "PNG":
        return png(width, height, bytes(100))
    if kind == "TIFF":
        return tiff(width, height, [(0, 100)], bytes(100))
    data = bytearray(encoded(kind))
    if kind == "JPEG":
        at = data.index(b"\xff\xc0") + 5
        data[at : at + 4] = struct.pack(">HH", height, width)
    elif kind == "BMP":
        data[18:26] = struct.pack("<ii", width, height)
    else:
        data[26:30] = struct.pack("<HH", width & 0x3FFF, height & 0x3FFF)
    return bytes(data)


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "TIFF", "BMP", "WEBP"])
def test_the_header_alone_decides_what_is_too_large(kind, tmp_path):
    width, height = (30000, 30000) if kind != "WEBP" else (16000, 16000)
    refused(
        tmp_path,
        announcing(kind, width, height),
        rf"is {width} x {height} px, more than the limit of 100,000,000 .*--max-pixels {width * height} .decoding",
    )
    refused(tmp_path, announcing(kind, 0, 64), "decoded")


def test_the_limit_holds_for_images_masks_and_score_masks(tmp_path):
    scenes.write_colmap(tmp_path)
    size = scenes.WIDTH * scenes.HEIGHT
    assert len(load_scene(tmp_path, max_pixels=size).views) == scenes.VIEWS
    with pytest.raises(DataError, match=r"photo0.png: the image is 16 x 12 px, more than the limit of 191 pixels"):
        load_scene(tmp_path, max_pixels=size - 1)
    for folder, names in (("idrmasks", [f"{i}.png" for i in range(scenes.VIEWS)]), ("masks", ["photo0.png"])):
        for name in names:
            scenes.save(tmp_path / folder / name, np.full((24, 32), 255, np.uint8))
        assert len(load_scene(tmp_path, max_pixels=4 * size).views) == scenes.VIEWS
        with pytest.raises(DataError, match=rf"{folder}.*: the image is 32 x 24 px, more than the limit of 192 pixels"):
            load_scene(tmp_path, max_pixels=size)


def test_no_memory_for_an_image_is_no_damage(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    path.write_bytes(encoded("PNG"))

    def full(*_):
        error = cv2.error("Failed to allocate 4 bytes")
        error.code = cv2.Error.StsNoMem
        raise error

    monkeypatch.setattr(cv2, "imdecode", full)
    with pytest.raises(ResourceError, match=r"a.png: decoding the image needs 0.0 GiB of free memory; shrink the image"):
        decode(path)


@pytest.mark.parametrize("data", [b"", b"P5 2 2 255 abcd", b"GIF89a" + bytes(20)])
def test_other_files_are_no_images(data, tmp_path):
    refused(tmp_path, data, "it is (empty|not a JPEG, PNG, BMP, TIFF, WebP or AVIF file)")
