"""BMP: it has no checksum, so the rows that the header announces must lie in the file."""

from __future__ import annotations

import struct

OLD_HEADER = 12
"""Bytes of the header of OS/2, with sides of 16 bits."""
RAW, MASKED = 0, (3, 6)
"""Ways to store pixels: plain, and with bit masks of the colours."""


def _header(data: bytes) -> tuple[int, int, int, int, int]:
    """Return width, height, bits per pixel, the way the pixels are stored, and the place of their first byte."""
    if len(data) < 54:
        raise ValueError("it ends within its header")
    start, length = struct.unpack_from("<II", data, 10)
    if length == OLD_HEADER:
        width, height, _, bits = struct.unpack_from("<HHHH", data, 18)
        return width, height, bits, RAW, start
    width, height, _, bits, stored = struct.unpack_from("<iiHHI", data, 18)
    return width, abs(height), bits, stored, start


def size(data: bytes) -> tuple[int, int]:
    """Return width and height [px].

    Raises:
        ValueError: The header is broken.
    """
    return _header(data)[:2]


def check(data: bytes) -> None:
    """Check that the file holds all rows.

    Raises:
        ValueError: A row is missing, or the rows are compressed.
    """
    width, height, bits, stored, start = _header(data)
    if stored != RAW and stored not in MASKED:
        raise ValueError("its pixels are compressed, so damage would not be detected; save it as PNG")
    rows = height * ((width * bits + 31) // 32 * 4)
    (announced,) = struct.unpack_from("<I", data, 2)
    if start < 26 or max(start + rows, announced) > len(data):
        raise ValueError(f"it ends early: it has {len(data)} bytes and needs {max(start + rows, announced)}")
