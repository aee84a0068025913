"""Images of every format and kind, and masks, for the fuzzer."""

from __future__ import annotations

import io
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from tests.faults.mutations import Change, damage, number, png_bomb, rarely
from tests.faults.scene_targets import nonsense as scene_nonsense, read_scene, write_masked
from tests.faults.targets import Target, not_finite, register, writing
from tests.io import scenes
from warpgs.io import folder as folders, image_files, images, load

MAX_PIXELS = 20_000
Pixels = tuple[np.ndarray, np.ndarray | None]


def read(folder: Path, path: Path) -> Pixels:
    pixels = image_files.decode(path, MAX_PIXELS)
    assert image_files.read_exif(path.read_bytes())[0] in range(1, 9)
    assert abs((image_files.read_gps(path.read_bytes()) or (0,))[0]) <= 90
    return pixels


def nonsense(pixels: Pixels) -> str:
    color, alpha = pixels
    if bad := not_finite(color=color, alpha=alpha):
        return bad
    in_range = all(a is None or (a.size and a.min() >= 0 and a.max() <= 1) for a in pixels)
    return "" if in_range and color.shape[0] * color.shape[1] <= MAX_PIXELS else "colours out of range, or too many pixels"


def same(before: bytes, after: bytes, good: Pixels, found: Pixels) -> str:
    """Say where pixels differ although a checksum guards them."""
    equal = good[0].shape == found[0].shape and (good[0] == found[0]).all()
    equal &= (good[1] is None) == (found[1] is None) and (good[1] is None or (good[1] == found[1]).all())
    return "" if equal else "pixels differ though a checksum guards them"


def near(before: bytes, after: bytes, good: Pixels, found: Pixels) -> str:
    """Say where more pixels differ than bytes were changed, in formats that store pixels as they are."""
    if len(before) != len(after) or before[:1200] != after[:1200] or good[0].shape != found[0].shape:
        return ""  # the header or the palette says something else now
    changed = int((np.frombuffer(before, np.uint8) != np.frombuffer(after, np.uint8)).sum())
    differ = int((good[0] != found[0]).any(-1).sum())
    return "" if differ <= 8 * changed else f"{changed} bytes were changed, and {differ} pixels differ"


def photo(mode: str, seed: int = 0, size: tuple[int, int] = (41, 29)) -> Image.Image:
    rng = np.random.default_rng(seed)
    rgb = np.clip(scenes.image(3, *size) + rng.normal(0, 5, (size[1], size[0], 3)), 0, 255).astype(np.uint8)
    gray = rgb[..., 0]
    if mode == "I;16":
        return Image.fromarray(gray.astype(np.uint16) * 257)
    if mode == "F":
        return Image.fromarray(gray.astype(np.float32) / 255)
    if mode in ("RGBA", "LA"):
        image = Image.fromarray(rgb).convert(mode)
        image.putalpha(Image.fromarray(gray))
        return image
    return Image.fromarray(rgb).quantize(32) if mode == "P" else Image.fromarray(rgb).convert(mode)


def encoded(kind: str, mode: str, **options) -> bytes:
    out = io.BytesIO()
    photo(mode).save(out, kind, **options)
    return out.getvalue()


def by_opencv(suffix: str, array: np.ndarray, *options: int) -> bytes:
    ok, data = cv2.imencode(suffix, array, list(options))
    assert ok
    return data.tobytes()


def add(name: str, samples: dict[str, bytes], parser: tuple, changes: tuple[Change, ...] = (), **more) -> None:
    files = writing({f"{key}.img": data for key, data in sorted(samples.items())})
    register(Target(name, files, read, parser, changes, nonsense=nonsense, **more))


# ---- PNG -------------------------------------------------------------------------------------------------------------


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def chunks_of(data: bytes) -> list[tuple[bytes, bytes]]:
    at, found = 8, []
    while at + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, at)
        found.append((kind, data[at + 8 : at + 8 + length]))
        at += 12 + length
    return found


def joined(chunks: list[tuple[bytes, bytes]]) -> bytes:
    return image_files.PNG_START + b"".join(chunk(*c) for c in chunks)


def png_checksums(data: bytes) -> bytes:
    return joined(chunks_of(data))


def png_rows(data: bytes, rng: np.random.Generator) -> bytes:
    """Change the unpacked rows or one other chunk, and pack again."""
    chunks = chunks_of(data)
    try:
        rows = zlib.decompress(b"".join(body for kind, body in chunks if kind == b"IDAT"))
    except zlib.error:
        return data
    others = [c for c in chunks if c[0] != b"IDAT"]
    at = int(rng.integers(len(others) + 2))
    if at < len(others):
        kind, body = others[at]
        others[at : at + 1] = [[(kind, damage(body, rng))], [(kind, number(body, rng))], [], [(kind, body)] * 2][
            int(rng.integers(4))
        ]
    else:
        rows = bytearray(rows)
        for _ in range(int(rng.integers(1, 9)) if rows else 0):  # a change before may have left none
            rows[int(rng.integers(len(rows)))] = int(rng.integers(256))
        rows = bytes(rows) if rng.random() < 0.8 else damage(bytes(rows), rng)
    packed, end = zlib.compress(rows), min(len(others), max(1, len(others) - 1))
    split = int(rng.integers(len(packed) + 1))
    return joined([*others[:end], (b"IDAT", packed[:split]), (b"IDAT", packed[split:]), *others[end:]])


PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
"""First column, first row and steps of the passes of an interlaced image."""


def gray_png(width: int, height: int, rows: bytes, interlaced: int = 0) -> bytes:
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, interlaced)
    return joined([(b"IHDR", header), (b"IDAT", zlib.compress(rows)), (b"IEND", b"")])


def interlaced(gray: np.ndarray, rows: int | None = None) -> bytes:
    """Return an interlaced PNG of a gray image, or of its first rows in the order of the file."""
    found = [b"\0" + r.tobytes() for x, y, dx, dy in PASSES for r in gray[y::dy, x::dx] if r.size]
    return gray_png(*gray.shape[::-1], b"".join(found[:rows]), 1)


PNG_MODES = ("RGB", "RGBA", "L", "LA", "P", "1", "I;16")
add(
    "png", {m.replace(";", ""): encoded("PNG", m) for m in PNG_MODES} | {"interlaced": interlaced(np.asarray(photo("L")))},
    (image_files._opened, image_files._loaded),
    (png_rows, rarely(png_bomb, png_rows)), repair=png_checksums, unexplained=same,
)  # fmt: skip

# ---- JPEG ------------------------------------------------------------------------------------------------------------


def jpeg_segments(data: bytes, rng: np.random.Generator) -> bytes:
    """Remove, repeat or change a segment before the coded data; its length stays right."""
    parts, at = [], 2
    while at + 4 <= len(data) and data[at] == 0xFF and data[at + 1] != 0xDA:
        (length,) = struct.unpack_from(">H", data, at + 2)
        parts.append((data[at : at + 2], data[at + 4 : at + 2 + length]))
        at += 2 + length
    if not parts:
        return data
    i, kind = int(rng.integers(len(parts))), int(rng.integers(5))
    marker, body = parts[i]
    if kind == 0:
        parts.insert(int(rng.integers(len(parts))), (b"\xff" + bytes([int(rng.integers(0xC0, 0xFF))]), body))
    elif kind == 1:
        parts[i : i + 1] = [parts[i]] * int(rng.integers(3))
    elif kind == 2:
        parts.insert(i, (b"\xff\xfe", rng.bytes(int(rng.integers(40)))))  # a comment harms nobody
    else:
        parts[i] = (marker, (damage if kind == 3 else number)(body, rng)[:65000])
    head = b"".join(m + struct.pack(">H", len(b) + 2) + b for m, b in parts)
    return data[:2] + head + data[at:]


JPEG_PARSER = (image_files.jpeg_segments, image_files._check_scans, image_files._decoded_jpeg)
JPEGS = {
    f"{sub[0]}{sub[1]}{sub[2]}{p}": encoded("JPEG", "RGB", subsampling=":".join(sub), progressive=bool(p))
    for sub in ("444", "420") for p in (0, 1)
}  # fmt: skip
JPEGS |= {m: encoded("JPEG", m) for m in ("L", "CMYK")} | {"restart": encoded("JPEG", "RGB", restart_marker_blocks=2)}
add("jpeg", JPEGS, JPEG_PARSER, (jpeg_segments, jpeg_segments))

# ---- BMP, TIFF, WebP -------------------------------------------------------------------------------------------------


def header(data: bytes, rng: np.random.Generator) -> bytes:
    return number(data[:64], rng) + data[64:]


def tiff_tag(data: bytes, rng: np.random.Generator) -> bytes:
    """Change the value, length or type of a tag of the first directory."""
    order = "<" if data[:2] == b"II" else ">"
    try:
        (at,) = struct.unpack_from(order + "I", data, 4)
        (count,) = struct.unpack_from(order + "H", data, at)
        place = at + 2 + 12 * int(rng.integers(max(count, 1)))
        tag, kind, length, value = struct.unpack_from(order + "HHII", data, place)
    except struct.error:
        return data
    values = (0, 1, 2, 3, 4, 5, 6, 7, 8, 16, 29, 30, 41, 64, 255, 65535, 2**31, 2**32 - 1, value, value + 1, max(value - 1, 0))
    which, new = int(rng.integers(4)), values[int(rng.integers(len(values)))]
    changed = (
        (tag, kind, length, new),
        (tag, kind, new, value),
        (tag, new % 20, length, value),
        (new % 400, kind, length, value),
    )
    return data[:place] + struct.pack(order + "HHII", *(v % 2**32 for v in changed[which])) + data[place + 12 :]


def webp_chunk(data: bytes, rng: np.random.Generator) -> bytes:
    """Add a chunk that nobody knows, with the length of the file put right, or change the header."""
    if rng.random() < 0.5:
        return header(data, rng)
    extra = b"ABCD" + struct.pack("<I", 6) + rng.bytes(6)
    return data[:4] + struct.pack("<I", len(data) + len(extra) - 8) + data[8:] + extra


BMP_MODES = ("RGB", "RGBA", "L", "P", "1")
OLD = b"BM" + struct.pack("<IHHI", 26 + 4 * 32, 0, 0, 26) + struct.pack("<IHHHH", 12, 10, 4, 1, 24) + bytes(range(128))
BMPS = {m: encoded("BMP", m) for m in BMP_MODES} | {"old": OLD}
add("bmp", BMPS, (image_files._opened, image_files._loaded), (header,), unexplained=near)

COLORS = np.asarray(photo("RGB"))
DEEP = COLORS.astype(np.uint16) * 257
PACKED = ("tiff_lzw", "tiff_adobe_deflate", "packbits", "jpeg")
TIFFS = {f"raw{m.replace(';', '')}": encoded("TIFF", m) for m in ("RGB", "RGBA", "L", "P", "1", "I;16", "F")}
TIFFS |= {c: encoded("TIFF", "RGB", compression=c) for c in PACKED} | {"group4": encoded("TIFF", "1", compression="group4")}
TIFFS |= {f"deep{c}": by_opencv(".tif", DEEP, cv2.IMWRITE_TIFF_COMPRESSION, c) for c in (1, 5, 8)}


def big_tiled(gray: np.ndarray, order: str = "<") -> bytes:
    """Return a big TIFF of a gray image of 16 bits, in two tiles of 16 x 16 px."""
    tags = [(256, 3, 32), (257, 3, 16), (258, 3, 16), (259, 3, 1), (262, 3, 1), (277, 3, 1), (322, 3, 16), (323, 3, 16)]
    start = 16 + 8 + 20 * 10 + 8
    entries = b"".join(struct.pack(order + "HHQ", t, k, 1) + struct.pack(order + "H6x", v) for t, k, v in tags)
    entries += struct.pack(order + "HHQQ", 324, 16, 2, start) + struct.pack(order + "HHQQ", 325, 16, 2, start + 16)
    head = {"<": b"II+\0", ">": b"MM\0+"}[order] + struct.pack(order + "HHQQ", 8, 0, 16, 10)
    places = struct.pack(order + "4Q", start + 32, start + 544, 512, 512)
    return head + entries + bytes(8) + places + b"".join(gray[:, i : i + 16].astype(order + "u2").tobytes() for i in (0, 16))


TIFF_PARSER = (
    image_files._Directory, image_files._tiff_tags, image_files._tiff_size, image_files._check_tiff, image_files.unpacked_size,
)  # fmt: skip
add("tiff", TIFFS | {"big": big_tiled(np.arange(512).reshape(16, 32))}, TIFF_PARSER, (tiff_tag, tiff_tag))

WEBPS = {
    "lossy": encoded("WEBP", "RGB"), "lossless": encoded("WEBP", "RGB", lossless=True),
    "alpha": encoded("WEBP", "RGBA"), "alpha lossless": encoded("WEBP", "RGBA", lossless=True),
}  # fmt: skip
add("webp", WEBPS, (image_files._webp_chunks, image_files._webp_size), (webp_chunk, header))

ANY = {"png": encoded("PNG", "LA"), "float": encoded("TIFF", "F"), "double": by_opencv(".tif", COLORS[..., 0] / 255.0)}
ANY |= {"jpeg": JPEGS["4440"], "gif": encoded("GIF", "P"), "avif": encoded("AVIF", "RGBA"), "webp": WEBPS["alpha"]}
ANY |= {"bmp": encoded("BMP", "L"), "heic": struct.pack(">I8s", 12, b"ftypheic")}
RLE, NO_PIXELS = struct.pack("<I", 1), b"WEBPVP8X" + struct.pack("<IIHI", 10, 0, 4, 0)
ANY |= {"packed": ANY["bmp"][:30] + RLE + ANY["bmp"][34:], "no pixels": b"RIFF" + struct.pack("<I", 22) + NO_PIXELS}
ANY_PARSER = (image_files.format_of, image_files._raster, image_files.decode, image_files.header_size, image_files._decoded)
add("any image", ANY, ANY_PARSER, (header,))


def other_size(data: bytes, rng: np.random.Generator) -> bytes:
    """Return a gray PNG of some size, mostly with the aspect of the images."""
    scale = int(rng.integers(1, 4))
    width, height = (16 * scale, 12 * scale) if rng.random() < 0.7 else (int(v) for v in rng.integers(1, 40, 2))
    rows = (b"\0" + bytes(width // 2) + b"\xff" * (width - width // 2)) * height
    return gray_png(width, height, rows)


MASKS = (
    folders.SceneFolder.mask_of, folders.SceneFolder.mask, images._fit_mask, load._fit,
)  # fmt: skip
register(Target("masks", write_masked, read_scene, MASKS, (png_rows, png_rows, other_size), png_checksums, scene_nonsense))
