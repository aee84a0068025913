"""Files of photographs: their format, size, damage and pixels, and the EXIF of their lens.

OpenCV decodes damaged files as far as it can, and at most prints a warning, so files are checked first. JPEG, and lossy WebP
and AVIF, have no checksum: damage that leaves a valid code of the same length is not detected
(docs/decisions/012-files-from-anyone.md).
"""

from __future__ import annotations

import contextlib
import io
import itertools
import math
import re
import shlex
import struct
import threading
import warnings
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from warpgs.errors import DataError, ResourceError, expect, explained
from warpgs.files import read_input, read_start

if TYPE_CHECKING:
    from PIL import ImageFile

PNG_START = b"\x89PNG\r\n\x1a\n"
STARTS = {
    b"\xff\xd8\xff": "JPEG", PNG_START: "PNG", b"BM": "BMP", b"RIFF": "WEBP",
    b"II*\0": "TIFF", b"MM\0*": "TIFF", b"II+\0": "TIFF", b"MM\0+": "TIFF",
}  # fmt: skip
"""Formats that are read, by first bytes; AVIF is known by its brand."""
READ = "JPEG, PNG, BMP, TIFF, WebP or AVIF"
"""The formats that are read, for messages."""
BRANDS = {
    b"heic": "HEIC", b"heix": "HEIC", b"heim": "HEIC", b"heis": "HEIC", b"hevc": "HEIC", b"hevx": "HEIC", b"mif1": "HEIC",
    b"msf1": "HEIC", b"avif": "AVIF", b"avis": "AVIF", b"crx ": "RAW",
}  # fmt: skip
"""Major brands of ISO base media files (ISO/IEC 14496-12; 23008-12 for HEIC), and the formats that they stand for."""
BRANDS_END = 32
"""End of the bytes that are searched for compatible brands."""


def brand(data: bytes) -> str | None:
    """Return HEIC, AVIF or RAW by the first bytes of an ISO base media file, or None for any other file."""
    found = BRANDS.get(data[8:12]) if data[4:8] == b"ftyp" else None
    # mif1 is any still image; the compatible brands name the codec
    return "AVIF" if found == "HEIC" and b"avif" in data[12:BRANDS_END] else found


def format_of(data: bytes) -> str:
    """Return the format of an image file by its first bytes; ValueError for one that is not supported."""
    found = next((name for start, name in STARTS.items() if data.startswith(start)), brand(data))
    expect(found not in (None, "HEIC", "RAW"), f"it is not a {READ} file" if data else "it is empty")
    return str(found)


# Unsupported formats of photographs, and remedies.
#
# HEIC is supported only for finding poses (`warpgs.poses.photographs`). RAW is left to a converter, in which the user
# chooses the same colour and exposure for all photographs.

RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".nrw", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw")
"""Suffixes of RAW files of cameras; many begin like a TIFF, and their first image is a small preview."""
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
"""Suffixes of video files, whose frames `warpgs.poses.photographs` takes."""
HEIC = "a HEIC photograph, which is supported only for finding poses (warpgs poses); convert all HEIC files to JPEG"
RAW = "a RAW file, which is not supported; convert all to JPEG or 16-bit PNG, with the same settings and white balance"


def unread_note(folder: Path) -> str:
    """Return a sentence on the RAW files and videos of a folder, known by their suffix; empty for none."""
    files = sorted(p for p in folder.glob("[!.]*") if p.is_file())
    raw, videos = ([p for p in files if p.suffix.lower() in known] for known in (RAW_SUFFIXES, VIDEO_SUFFIXES))
    kinds = (raw, RAW), (videos, f"a video; `warpgs fit {shlex.quote(str(videos[0]))}` takes its frames" if videos else "")
    return "; ".join(f"{f[0].name} is {what}{f' ({len(f)} such files)' * (len(f) > 1)}" for f, what in kinds if f)


MAX_PIXELS = 100_000_000
"""Default limit on the pixels of an image; decoded, an image of this size takes 1.2 GB."""
FILE_BYTES_PER_PIXEL, EXTRA_FILE_BYTES = 16, 2**26
"""Bytes that a pixel may take in a file (four channels as float32), and bytes for everything else in the file."""
BYTES_PER_PIXEL = 32
"""Most memory that decoding takes per pixel [bytes]: four channels as float32, and the colours and alpha made of them."""


def read_image_file(path: Path, max_pixels: int = MAX_PIXELS, start: int | None = None) -> bytes:
    """Return the bytes of an image file, or its first ``start``; files too large for ``max_pixels`` pixels are rejected."""
    with explained(f"{path}: the image cannot be read", "restore it, or remove its camera"):
        if start is not None:
            return read_start(path, start)
        return read_input(path, FILE_BYTES_PER_PIXEL * max_pixels + EXTRA_FILE_BYTES)


# Size and damage. Functions take the bytes of a file, and raise a ValueError with the reason as part of a sentence.


@contextlib.contextmanager
def _decoder(words: str) -> Iterator[None]:
    """Run a decoder without its warnings; its errors become a ValueError with ``words``, but not a lack of memory."""
    # filters belong to the process: of two threads, the later could restore the other's
    alone = threading.current_thread() is threading.main_thread()
    try:
        with warnings.catch_warnings(action="ignore") if alone else contextlib.nullcontext():
            yield
    except MemoryError:
        raise
    except Exception as e:  # Pillow raises a dozen types on malformed files
        raise ValueError(words.format(e)) from e


def _opened(name: str, data: bytes) -> ImageFile.ImageFile:
    """Return an image of Pillow of which only the header is read."""
    from PIL import AvifImagePlugin, BmpImagePlugin, PngImagePlugin, TiffImagePlugin

    types = {
        "AVIF": AvifImagePlugin.AvifImageFile, "BMP": BmpImagePlugin.BmpImageFile, "PNG": PngImagePlugin.PngImageFile,
        "TIFF": TiffImagePlugin.TiffImageFile,
    }  # fmt: skip
    with _decoder("its decoder says: {}"):
        # not Image.open, which has a limit of its own on the number of pixels
        return types[name](io.BytesIO(data), "image")


def _loaded(image: ImageFile.ImageFile) -> ImageFile.ImageFile:
    """Return an image after decoding all its pixels."""
    with _decoder("its pixels are damaged ({})"):
        image.load()
    return image


def header_size(name: str, data: bytes) -> tuple[int, int]:
    """Return width and height [px] by the header alone."""
    if name == "JPEG":
        import simplejpeg

        with _decoder("{}"):
            height, width, *_ = simplejpeg.decode_jpeg_header(data)
        return width, height
    # Pillow would unpack the texts of a PNG first
    if size_of := {"PNG": _png_size, "WEBP": _webp_size, "TIFF": lambda data: _tiff_size(_tiff_tags(data))}.get(name):
        return size_of(data)
    with _opened(name, data) as image:
        return image.size


def png_chunks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Yield kind and bytes of each chunk of a PNG up to its end; they must lie in the file."""
    view, at, kind = memoryview(data), len(PNG_START), b""
    while kind != b"IEND" and at < len(data):
        length, kind = struct.unpack_from(">I4s", data, at) if at + 8 <= len(data) else (len(data), b"")
        expect(at + 12 + length <= len(data), "it ends within a chunk")
        yield kind, view[at : at + 12 + length]
        at += 12 + length


def _png_size(data: bytes) -> tuple[int, int]:
    """Return width and height [px] of a PNG. Its chunks must lie in the file, since OpenCV takes the memory they announce."""
    expect(len(data) >= 33 and data[12:16] == b"IHDR", "it has no header")
    expect(sum(kind == b"IHDR" for kind, _ in png_chunks(data)) == 1, "it has two headers")  # of maybe different sizes
    return struct.unpack_from(">II", data, 16)


def _decoded(name: str, data: bytes) -> np.ndarray | None:
    """Check a file for damage; return its pixels in BGR or BGRA where the check has decoded them, else None for OpenCV."""
    if name == "JPEG":
        return _decoded_jpeg(data)
    if name == "AVIF":
        with _loaded(_opened(name, data)) as image, _decoder("its pixels are damaged ({})"):
            pixels = np.asarray(image.convert("RGBA" if "A" in image.getbands() else "RGB"))
        return np.ascontiguousarray(pixels[..., [2, 1, 0, 3][: pixels.shape[2]]])
    if name == "WEBP":
        expect(any(kind in WEBP_PIXELS for kind, _ in _webp_chunks(data)), "it holds no pixels")
    elif name in ("PNG", "BMP"):
        with _opened(name, data) as image:
            plain = name != "BMP" or image.info.get("compression") not in BMP_RLE
            expect(plain, "its pixels are compressed, so damage would not be detected; save it as PNG")
            _loaded(image)
    else:
        _check_tiff(data)
    return None


BMP_RLE = (1, 2)
SOF = (0xC0, 0xC1, 0xC2)
"""JPEG frames with Huffman codes: baseline, extended, progressive."""
OTHER_SOF = (0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF)
SOI, EOI, SOS, APP1 = 0xD8, 0xD9, 0xDA, 0xE1
LONE = (0x01, *range(0xD0, 0xD8))
"""Markers without a length."""
MARKER = re.compile(rb"\xff+([^\xff])")
NEXT_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
"""End of the coded data of a scan: any marker but a restart."""
COEFFICIENTS = 64


def jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes, bytes]]:
    """Yield marker, contents and all bytes, with any coded data behind it, of each segment of a JPEG before the image's end."""
    at = 2
    while True:
        if (found := MARKER.match(data, at)) is None:
            raise ValueError("it ends early" if at >= len(data) - 1 else f"no marker at byte {at}")
        begin, marker, at = at, found[1][0], found.end()
        if marker == EOI:
            return
        if marker in LONE:
            continue
        expect(marker not in (0, SOI) and at + 2 <= len(data), f"it is broken at byte {at}")
        (length,) = struct.unpack_from(">H", data, at)
        expect(length >= 2 and at + length <= len(data), f"it ends within a segment, at byte {len(data)}")
        contents = data[at + 2 : at + length]
        at += length
        if marker == SOS:
            ends = NEXT_MARKER.search(data, at)
            expect(ends, "it ends within its coded data")
            at = ends.start()
        yield marker, contents, data[begin:at]


def _check_scans(data: bytes) -> None:
    """Check that the scans bring every coefficient of every component of a JPEG to its full precision."""
    missing: dict[int, list[int]] = {}
    for marker, body, _ in jpeg_segments(data):
        expect(marker not in OTHER_SOF, "it is lossless, hierarchical or arithmetically coded; save it as PNG")
        if marker in SOF:
            expect(not missing, "it has two frame headers")
            # number of low bits that are still unknown; 15 where nothing is known
            missing = {number: [15] * COEFFICIENTS for number in body[6::3]}
        elif marker == SOS:
            expect(body and len(body) == 4 + 2 * body[0], "the header of a scan is broken")
            first, last, bits = body[-3:]
            for number in body[1:-3:2]:
                expect(number in missing and first <= last < COEFFICIENTS, "a scan does not belong to the frame")
                missing[number][first : last + 1] = [bits & 15] * (last + 1 - first)
    expect(missing and not any(any(bits) for bits in missing.values()), "some of its scans are missing")


def _decoded_jpeg(data: bytes) -> np.ndarray | None:
    """Return the pixels, uint8, [H, W, 3] in BGR or [H, W, 1] for gray; warnings of libjpeg-turbo are errors. None for CMYK."""
    import simplejpeg

    _check_scans(data)
    with _decoder("{}"):
        colors = simplejpeg.decode_jpeg_header(data, strict=True)[2]
        if colors in ("CMYK", "YCCK"):
            # all codes are read, though only every eighth pixel is made
            simplejpeg.decode_jpeg(data, "CMYK", min_height=1, min_width=1, min_factor=8, strict=True)
            return None
        return simplejpeg.decode_jpeg(data, "GRAY" if colors == "Gray" else "BGR", strict=True)


WEBP_PIXELS = (b"VP8 ", b"VP8L", b"ANMF")
"""Chunks of a WebP that hold pixels: lossy, lossless, a frame of an animation."""


def _webp_chunks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Yield kind and contents of each chunk of a WebP; they must fill the length that the file announces."""
    expect(len(data) >= 20 and data[8:12] == b"WEBP", "it is not a WebP file")
    view = memoryview(data)
    end, at = 8 + struct.unpack_from("<I", data, 4)[0], 12
    expect(end <= len(data), f"it ends early: it has {len(data)} bytes and announces {end}")
    while at < end:
        kind, length = struct.unpack_from("<4sI", data, at) if at + 8 <= end else (b"", end)
        expect(at + 8 + length <= end, "it ends within a chunk")
        yield kind, view[at + 8 : at + 8 + length]
        at += 8 + length + length % 2


def _webp_size(data: bytes) -> tuple[int, int]:
    """Return width and height [px] of a WebP; Pillow would allot its canvas first, up to a gigabyte."""
    kind, body = next(_webp_chunks(data), (b"", memoryview(b"")))
    if len(body) >= 10 and kind == b"VP8X":
        return int.from_bytes(body[4:7], "little") + 1, int.from_bytes(body[7:10], "little") + 1
    if len(body) >= 10 and kind == b"VP8 " and body[3:6] == b"\x9d\x01\x2a":
        width, height = struct.unpack_from("<HH", body, 6)
        return width & 0x3FFF, height & 0x3FFF
    if len(body) >= 5 and kind == b"VP8L" and body[0] == 0x2F:
        bits = int.from_bytes(body[1:5], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    raise ValueError("its header is broken")


LAYOUTS = {1: "B", 3: "H", 4: "I", 16: "Q"}
"""Layouts of the integers that tags may hold, by type."""
SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 6: 1, 7: 1, 8: 2, 9: 4, 11: 4, 13: 4}
"""Bytes of a value by type; values of other types have 8."""
WIDTH, HEIGHT, COMPRESSION, STRIPS, TILES = 256, 257, 259, (273, 279), (324, 325)
"""Tags; the last two are offsets and lengths of the pieces that hold the pixels."""
DEFLATE = (8, 32946)
MAX_ENTRIES = 4096
"""Largest number of tags in a directory."""
MAX_TEXT = 100
"""Longest text that is read [bytes]."""


class _Directory:
    """Tags of a TIFF, or of EXIF, whose layout is the same (CIPA DC-008); a value is read when it is requested."""

    def __init__(self, block: bytes, at: int | None = None):
        """Find the tags of the directory at byte ``at``, None for the first; ValueError if they overlap or lie outside."""
        self.block, self.order = block, "<" if block[:2] == b"II" else ">"
        big = block[2:4] in (b"+\0", b"\0+")
        self.pointer, entry, self.slot = ("Q", "HHQ", 8) if big else ("I", "HHI", 4)
        self.entries: dict[int, tuple[int, int, int]] = {}
        if at is None:
            (at,) = self._unpack(self.pointer, 8 if big else 4)
        (count,) = self._unpack("Q" if big else "H", at)
        expect(count <= MAX_ENTRIES, f"its directory announces {count} tags")
        at, room, self.repeats = at + (8 if big else 2), len(block), False
        for _ in range(count):
            tag, kind, length = self._unpack(entry, at)
            self.repeats |= tag in self.entries
            place = at + struct.calcsize("=" + entry)
            at = place + self.slot
            self.entries[tag] = kind, length, place
            room -= max(0, SIZES.get(kind, 8) * length - self.slot)
        self.overlaps = room < 0

    def _unpack(self, layout: str, at: int) -> tuple[int, ...]:
        try:
            return struct.unpack_from(self.order + layout, self.block, at)
        except (struct.error, OverflowError) as e:
            raise ValueError("its directory points outside the file") from e

    def _place(self, size: int, place: int) -> int:
        """Return where a value of some bytes begins: in its entry if it fits, else where the entry points."""
        return place if size <= self.slot else self._unpack(self.pointer, place)[0]

    def numbers(self, tag: int) -> tuple[int, ...]:
        """Return the integers of a tag; none for a tag that is missing or of another type."""
        kind, length, place = self.entries.get(tag, (0, 0, 0))
        if kind not in LAYOUTS:
            return ()
        return self._unpack(f"{length}{LAYOUTS[kind]}", self._place(SIZES.get(kind, 8) * length, place))

    def number(self, tag: int) -> int | None:
        """Return a single integer of 16 or 32 bits, or None."""
        kind, length, _ = self.entries.get(tag, (0, 0, 0))
        return self.numbers(tag)[0] if kind in (3, 4) and length == 1 else None

    def ratios(self, tag: int) -> list[float]:
        """Return the fractions of a tag; none for a tag that is missing or of another type, NaN for a division by 0."""
        kind, length, place = self.entries.get(tag, (0, 0, 0))
        values = self._unpack(f"{2 * length}I", self._place(8 * length, place)) if kind == 5 and length <= 3 else ()
        return [a / b if b else math.nan for a, b in zip(values[::2], values[1::2])]

    def text(self, tag: int) -> str:
        """Return the text of a tag, maybe empty, without the zero bytes and spaces around it."""
        kind, length, place = self.entries.get(tag, (0, 0, 0))
        place = self._place(length, place) if kind == 2 else len(self.block)
        return self.block[place : place + min(length, MAX_TEXT)].decode("latin-1").strip("\0 ")


def _tiff_tags(data: bytes) -> _Directory:
    """Return the tags of a TIFF; ValueError if they overlap, because Pillow and libtiff would copy each of them."""
    tags = _Directory(data)
    expect(not tags.repeats, "it has two values of a tag")  # decoders differ in which of two sizes they take
    expect(not tags.overlaps, "its tags overlap, or lie outside of the file")
    return tags


def _tiff_size(tags: _Directory) -> tuple[int, int]:
    """Return width and height [px]."""
    width, height = tags.numbers(WIDTH), tags.numbers(HEIGHT)
    expect(width and height, "it has no size")
    return width[0], height[0]


def _check_tiff(data: bytes) -> None:
    """Check that a TIFF holds all its pixels: by Pillow, and by the checksum of Deflate, at which libtiff does not look."""
    tags = _tiff_tags(data)
    offsets, lengths = (tags.numbers(tag) for tag in (TILES if TILES[0] in tags.entries else STRIPS))
    within = all(offset + length <= len(data) for offset, length in zip(offsets, lengths))
    expect(within, "its strips or tiles lie outside of the file")
    if (tags.numbers(COMPRESSION) or (1,))[0] in DEFLATE:
        left = FILE_BYTES_PER_PIXEL * math.prod(_tiff_size(tags)) + EXTRA_FILE_BYTES
        for offset, length in zip(offsets, lengths):
            left -= unpacked_size(memoryview(data)[offset : offset + length], left)
    try:
        image = _opened("TIFF", data)
    except ValueError as e:
        if isinstance(e.__cause__, SyntaxError):
            return  # a kind of pixels that Pillow does not know; OpenCV stops at damage of these
        raise
    _loaded(image).close()


def unpacked_size(packed: memoryview, limit: int) -> int:
    """Return the number of bytes in a zlib stream whose checksum matches; ValueError if it is damaged or exceeds ``limit``."""
    stream = zlib.decompressobj()
    with _decoder("its compressed pixels are damaged ({})"):
        total = len(stream.decompress(packed, limit + 1))
    expect(stream.eof, f"its compressed pixels {'end early' if total <= limit else 'are more than it announces'}")
    return total


def _raster(path: Path, data: bytes, max_pixels: int) -> np.ndarray:
    """Return the pixels as stored, [H, W] or [H, W, C] with colours in BGR order, of any type that OpenCV has."""
    import cv2

    pixels, kind = 0, "RAW" if path.suffix.lower() in RAW_SUFFIXES else brand(data)
    if kind in ("HEIC", "RAW"):
        raise DataError(f"{path}: is {RAW if kind == 'RAW' else HEIC}")
    try:
        name = format_of(data)
        width, height = header_size(name, data)
        if (pixels := width * height) > max_pixels:
            size = f"the image is {width} x {height} px, more than the limit of {max_pixels:,} pixels"
            raise DataError(f"{path}: {size}; shrink it, or raise the limit with --max-pixels {pixels}")
        expect(pixels, f"it has {width} x {height} px")
        if (raster := _decoded(name, data)) is None:
            # IMREAD_UNCHANGED also ignores the EXIF orientation: the camera, not the tag, determines how the raster lies
            raster = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        expect(raster is not None and raster.shape[:2] == (height, width), "its pixels cannot be read")
    except (cv2.error, MemoryError, ValueError) as e:
        if isinstance(e, MemoryError) or getattr(e, "code", None) == cv2.Error.StsNoMem:
            needs = BYTES_PER_PIXEL * pixels / 2**30
            raise ResourceError(f"{path}: decoding the image needs {needs:.1f} GiB; shrink it, or end other programs") from e
        reason = "OpenCV cannot read it" if isinstance(e, cv2.error) else e
        raise DataError(f"{path}: the image cannot be decoded: {reason}. Restore it, or save it as PNG") from e
    return raster


def decode_png(path: Path, max_pixels: int = MAX_PIXELS) -> np.ndarray:
    """Decode a PNG to its numbers as stored, uint8 or uint16, shape [H, W] or [H, W, C] with colours in RGB order."""
    data = read_image_file(path, max_pixels)
    if not data.startswith(PNG_START):
        raise DataError(f"{path}: is not a PNG file; save it as 16-bit PNG or NPY")
    raw = _raster(path, data, max_pixels)
    return raw if raw.ndim == 2 else np.ascontiguousarray(raw[..., [2, 1, 0, 3][: raw.shape[2]]])


def decode(path: Path, max_pixels: int = MAX_PIXELS, data: bytes | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode an image file as stored, without rotation by its EXIF tag.

    Gray, palette, 8- and 16-bit images and straight alpha are supported.
    """
    import cv2

    raw = _raster(path, read_image_file(path, max_pixels) if data is None else data, max_pixels)
    if swapped := raw.ndim == 3 and raw.shape[2] == 3 and raw.dtype in (np.uint8, np.uint16, np.float32):
        raw = cv2.cvtColor(raw, cv2.COLOR_BGR2RGB)  # six times as fast as a copy of reversed floats
    if raw.dtype in (np.uint8, np.uint16):
        values = raw.astype(np.float32)
        values /= np.iinfo(raw.dtype).max
    elif raw.dtype == np.float32:
        values = np.clip(raw, 0, 1)
        if not np.isfinite(raw).all():
            raise DataError(f"{path}: some pixels are not finite; save it as 8- or 16-bit PNG")
    else:
        raise DataError(f"{path}: pixels of type {raw.dtype} are not supported; save it as 8- or 16-bit PNG")
    del raw  # free it before copies are made
    if values.ndim == 2:
        values = values[..., None]
    channels = values.shape[2]
    if channels > 4:
        raise DataError(f"{path}: has {channels} channels; save it as gray, RGB or RGBA")
    alpha = np.ascontiguousarray(values[..., -1]) if channels in (2, 4) else None
    color = np.repeat(values[..., :1], 3, axis=2) if channels <= 2 else values if swapped else values[..., 2::-1]
    return np.ascontiguousarray(color), alpha


# EXIF of a photograph and its lens: a few tags, read from the first directory and the blocks of exposure and GPS data.
#
# Only the values of these tags are read, because libraries that read all of EXIF copy overlapping values again and again.

MAKE, MODEL, ORIENTATION, EXPOSURE, GPS, FOCAL_35MM = 0x010F, 0x0110, 0x0112, 0x8769, 0x8825, 0xA405
"""Tags: maker and model of the device, orientation, places of exposure and GPS data, and focal length on 35 mm film [mm]."""
MAX_FOCAL = 10_000
"""Longest equivalent focal length that is accepted [mm]."""
MAX_HEIGHT = 20_000
"""Largest height that is accepted [m]."""
PREFIX = b"Exif\0\0"
"""First bytes of EXIF in JPEG, and in some WebP files."""


Exif = tuple[int, str, str, float | None]
"""Orientation of the stored raster, 1 to 8; maker and model of the device; equivalent focal length on 35 mm film [mm]."""
NO_EXIF: Exif = (1, "", "", None)


def read_exif(data: bytes) -> Exif:
    """Return the EXIF values of an image file; damaged values count as missing."""
    with contextlib.suppress(ValueError):
        return parse_exif(_block(data))
    return NO_EXIF


def parse_exif(block: bytes) -> Exif:
    """Return the values of a block of EXIF, which begins as a TIFF file does; damaged values count as missing."""
    block = block.removeprefix(PREFIX)
    if block[:4] not in (b"II*\0", b"MM\0*"):
        return NO_EXIF
    try:
        first = _Directory(block)
        orientation, place = first.number(ORIENTATION) or 1, first.number(EXPOSURE)
        maker, model = first.text(MAKE), first.text(MODEL)
        focal = None if place is None else _Directory(block, place).number(FOCAL_35MM)
    except ValueError:
        return NO_EXIF
    return orientation if orientation <= 8 else 1, maker, model, float(focal) if focal and focal <= MAX_FOCAL else None


def read_gps(data: bytes) -> tuple[float, float, float] | None:
    """Return latitude, longitude [deg] and height [m] (0 if unknown) of an image file by its EXIF; None without them."""
    try:
        block = _block(data).removeprefix(PREFIX)
        tags = _Directory(block, _Directory(block).number(GPS))
        degrees = [np.dot(tags.ratios(tag), (1, 1 / 60, 1 / 3600)) for tag in (2, 4)]
        latitude, longitude = (-v if tags.text(tag) in ("S", "W") else v for tag, v in zip((1, 3), degrees))
        height = sum(tags.ratios(6)) * (-1 if tags.numbers(5) == (1,) else 1)
    except ValueError:
        return None
    sound = abs(latitude) <= 90 and abs(longitude) <= 180 and abs(height) <= MAX_HEIGHT
    return (float(latitude), float(longitude), float(height)) if sound and (latitude or longitude) else None


def _block(data: bytes) -> bytes:
    """Return the bytes of EXIF in an image file, which begin as a TIFF file does; maybe empty."""
    name = format_of(data)
    if name == "JPEG":
        head = itertools.takewhile(lambda segment: segment[0] != SOS, jpeg_segments(data))
        return next((body for marker, body, _ in head if marker == APP1 and body.startswith(PREFIX)), b"")
    if name == "WEBP":
        return bytes(next((body for kind, body in _webp_chunks(data) if kind == b"EXIF"), b""))
    if name in ("PNG", "AVIF"):
        with _opened(name, data) as image:
            return bytes(image.info.get("exif", b""))
    return data if name == "TIFF" else b""
