"""PNG: checks the checksums of chunks and compressed pixels, and compares the number of pixels with the header."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator

SIGNATURE = b"\x89PNG\r\n\x1a\n"
CHANNELS = {0: 1, 2: 3, 3: 1, 4: 2, 6: 4}
"""Channels by type of colour."""
DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
"""Bits per sample that a type of colour may have."""
PASSES = ((0, 0, 8, 8), (4, 0, 8, 8), (0, 4, 4, 8), (2, 0, 4, 4), (0, 2, 2, 4), (1, 0, 2, 2), (0, 1, 1, 2))
"""First column, first row and steps of the passes of an interlaced image."""
PIECE, INPUT_PIECE = 1 << 20, 1 << 14
"""Bytes unpacked at a time, and bytes that are given to the unpacker at a time."""


def _header(data: bytes) -> tuple[int, int, int, int, int]:
    """Return width, height, bits per sample, type of colour and 1 for an interlaced image."""
    if len(data) < 33 or data[12:16] != b"IHDR":
        raise ValueError("it has no header")
    width, height, depth, color, packing, filtering, interlaced = struct.unpack_from(">IIBBBBB", data, 16)
    if depth not in DEPTHS.get(color, ()) or packing or filtering or interlaced > 1:
        raise ValueError("its header is broken")
    return width, height, depth, color, interlaced


def size(data: bytes) -> tuple[int, int]:
    """Return width and height [px].

    Raises:
        ValueError: The header is broken.
    """
    return _header(data)[:2]


def chunks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Yield kind and contents of each chunk up to the last; each is checked against its checksum.

    Raises:
        ValueError: A checksum does not match, or the file ends early.
    """
    at, view, kind = len(SIGNATURE), memoryview(data), b""
    while kind != b"IEND":
        if at + 12 > len(data):
            raise ValueError("it ends early")
        length, kind = struct.unpack_from(">I4s", data, at)
        end = at + 8 + length
        if end + 4 > len(data):
            raise ValueError("it ends within a chunk")
        if zlib.crc32(view[at + 4 : end]) != struct.unpack_from(">I", data, end)[0]:
            raise ValueError(f"the checksum of its part {kind.decode('ascii', 'replace')} does not match")
        yield kind, view[at + 8 : end]
        at = end + 4


def _raw_size(width: int, height: int, bits: int, interlaced: int) -> int:
    """Return the number of bytes of the unpacked rows, each with its filter byte."""
    total = 0
    for x, y, step_x, step_y in PASSES if interlaced else ((0, 0, 1, 1),):
        columns, rows = -(-max(width - x, 0) // step_x), -(-max(height - y, 0) // step_y)
        total += rows * (1 + (columns * bits + 7) // 8) if columns else 0
    return total


def unpacked_size(pieces: Iterator[memoryview], limit: int) -> int:
    """Return the number of bytes in a zlib stream whose checksum matches.

    Args:
        pieces: The stream, in order.
        limit: Expected number of bytes. Little more than this is unpacked: enough to reveal damage, too little for a
            decompression bomb to fill the memory.

    Raises:
        ValueError: The stream is damaged or ends early.
    """
    stream, total = zlib.decompressobj(), 0
    most = limit + PIECE
    try:
        for piece in pieces:
            for at in range(0, len(piece), INPUT_PIECE):  # zlib copies all that is left of its input each time
                left: bytes | memoryview = piece[at : at + INPUT_PIECE]
                while left and total <= most and not stream.eof:
                    total += len(stream.decompress(left, PIECE))
                    left = stream.unconsumed_tail
        while not stream.eof and total <= most and (more := stream.decompress(b"", PIECE)):
            total += len(more)
    except zlib.error as e:
        raise ValueError(f"its compressed pixels are damaged ({e})") from e
    if total <= most and not stream.eof:
        raise ValueError("its compressed pixels end early")
    return total


def check(data: bytes) -> None:
    """Check all checksums, and the number of pixels against the header.

    Raises:
        ValueError: A checksum or the number of pixels does not match.
    """
    width, height, depth, color, interlaced = _header(data)
    parts = list(chunks(data))
    expected = _raw_size(width, height, depth * CHANNELS[color], interlaced)
    if unpacked_size((body for kind, body in parts if kind == b"IDAT"), expected) != expected:
        raise ValueError("its number of pixels differs from its header")
