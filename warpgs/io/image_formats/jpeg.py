"""JPEG: markers and scans are checked, then libjpeg-turbo decodes; its warnings count as errors.

JPEG has no checksum: damage that leaves a valid code of the same length is not detected
(docs/decisions/012-files-from-anyone.md).
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator

import numpy as np

SOF = (0xC0, 0xC1, 0xC2)
"""Frames with Huffman codes: baseline, extended, progressive."""
OTHER_SOF = (0xC3, 0xC5, 0xC6, 0xC7, 0xC9, 0xCA, 0xCB, 0xCD, 0xCE, 0xCF)
SOI, EOI, SOS, APP1 = 0xD8, 0xD9, 0xDA, 0xE1
LONE = (0x01, *range(0xD0, 0xD8))
"""Markers without a length."""
MARKER = re.compile(rb"\xff+([^\xff])")
NEXT_MARKER = re.compile(rb"\xff[^\x00\xd0-\xd7\xff]")
"""End of the coded data of a scan: any marker but a restart."""
COEFFICIENTS = 64
MAX_SCANS = 100
"""Largest number of scans, each of which passes over the whole image; progressive files have about ten."""


def segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Yield marker and contents of each segment up to the end of the image; coded data is skipped.

    Raises:
        ValueError: The file is broken or ends early.
    """
    at = 2
    while True:
        found = MARKER.match(data, at)
        if found is None:
            raise ValueError("it ends early" if at >= len(data) - 1 else f"no marker at byte {at}")
        marker, at = found[1][0], found.end()
        if marker == EOI:
            return
        if marker in LONE:
            continue
        if marker in (0, SOI) or at + 2 > len(data):
            raise ValueError(f"it is broken at byte {at}")
        (length,) = struct.unpack_from(">H", data, at)
        if length < 2 or at + length > len(data):
            raise ValueError(f"it ends within a segment, at byte {len(data)}")
        yield marker, data[at + 2 : at + length]
        at += length
        if marker == SOS:
            found = NEXT_MARKER.search(data, at)
            if found is None:
                raise ValueError("it ends within its coded data")
            at = found.start()


def _frame(marker: int, body: bytes) -> tuple[int, int, tuple[int, ...]]:
    """Return width, height and the numbers of the components of a frame header."""
    if marker in OTHER_SOF:
        raise ValueError("it is lossless, hierarchical or arithmetically coded; save it as PNG")
    if len(body) < 6 or len(body) != 6 + 3 * body[5]:
        raise ValueError("its frame header is broken")
    depth, height, width, count = struct.unpack_from(">BHHB", body)
    if depth != 8:
        raise ValueError(f"it has {depth} bits per sample; save it as PNG")
    return width, height, tuple(body[6 : 6 + 3 * count : 3])


def size(data: bytes) -> tuple[int, int]:
    """Return width and height [px].

    Raises:
        ValueError: The header is broken or not supported.
    """
    for marker, body in segments(data):
        if marker in SOF + OTHER_SOF:
            return _frame(marker, body)[:2]
    raise ValueError("it has no frame header")


def _check_scans(data: bytes) -> None:
    """Check that the scans bring every coefficient of every component to its full precision."""
    missing: dict[int, list[int]] = {}
    scans = 0
    for marker, body in segments(data):
        if marker in SOF + OTHER_SOF:
            if missing:
                raise ValueError("it has two frame headers")
            # number of low bits that are still unknown; 15 where nothing is known
            missing = {number: [15] * COEFFICIENTS for number in _frame(marker, body)[2]}
        elif marker == SOS:
            scans += 1
            if scans > MAX_SCANS:
                raise ValueError(f"it has more than {MAX_SCANS} scans; save it as PNG")
            count = body[0] if body else 0
            if len(body) != 4 + 2 * count:
                raise ValueError("the header of a scan is broken")
            first, last, bits = body[-3:]
            for number in body[1 : 1 + 2 * count : 2]:
                if number not in missing or not first <= last < COEFFICIENTS:
                    raise ValueError("a scan does not belong to the frame")
                missing[number][first : last + 1] = [bits & 15] * (last + 1 - first)
    if not missing or any(any(bits) for bits in missing.values()):
        raise ValueError("some of its scans are missing")


def decode(data: bytes) -> np.ndarray | None:
    """Return all pixels, uint8, [H, W, 3] in BGR or [H, W, 1] for gray; None if OpenCV must convert them (CMYK).

    Raises:
        ValueError: Coded data is missing, or libjpeg-turbo warns of it.
    """
    import simplejpeg

    _check_scans(data)
    colors = simplejpeg.decode_jpeg_header(data, strict=True)[2]
    if colors in ("CMYK", "YCCK"):
        # all codes are read, though only every eighth pixel is made
        simplejpeg.decode_jpeg(data, "CMYK", min_height=1, min_width=1, min_factor=8, strict=True)
        return None
    pixels: np.ndarray = simplejpeg.decode_jpeg(data, "GRAY" if colors == "Gray" else "BGR", strict=True)
    return pixels
