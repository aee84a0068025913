"""WebP: chunks must fill the length that the file announces. Lossy WebP has no checksum: damage to it is not detected."""

from __future__ import annotations

import struct
from collections.abc import Iterator

PIXELS = (b"VP8 ", b"VP8L", b"ANMF")
"""Chunks that hold pixels: lossy, lossless, a frame of an animation."""


def chunks(data: bytes) -> Iterator[tuple[bytes, memoryview]]:
    """Yield kind and contents of each chunk.

    Raises:
        ValueError: The file is not a WebP file, or ends within a chunk.
    """
    if len(data) < 20 or data[8:12] != b"WEBP":
        raise ValueError("it is not a WebP file")
    view = memoryview(data)
    end, at = 8 + struct.unpack_from("<I", data, 4)[0], 12
    if end > len(data):
        raise ValueError(f"it ends early: it has {len(data)} bytes and announces {end}")
    while at < end:
        if at + 8 > end:
            raise ValueError("it ends within a chunk")
        kind, length = struct.unpack_from("<4sI", data, at)
        if at + 8 + length > end:
            raise ValueError("it ends within a chunk")
        yield kind, view[at + 8 : at + 8 + length]
        at += 8 + length + length % 2


def size(data: bytes) -> tuple[int, int]:
    """Return width and height [px].

    Raises:
        ValueError: The header is broken.
    """
    kind, body = next(chunks(data), (b"", memoryview(b"")))
    if len(body) >= 10 and kind == b"VP8X":
        width, height = (int.from_bytes(body[i : i + 3], "little") + 1 for i in (4, 7))
    elif len(body) >= 10 and kind == b"VP8 " and body[3:6] == b"\x9d\x01\x2a":
        width, height = (v & 0x3FFF for v in struct.unpack_from("<HH", body, 6))
    elif len(body) >= 5 and kind == b"VP8L" and body[0] == 0x2F:
        bits = int.from_bytes(body[1:5], "little")
        width, height = (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1
    else:
        raise ValueError("its header is broken")
    return width, height


def check(data: bytes) -> None:
    """Check that all chunks are complete, and that the file holds pixels.

    Raises:
        ValueError: A chunk is not complete, or there are no pixels.
    """
    if not any(kind in PIXELS for kind, _ in chunks(data)):
        raise ValueError("it holds no pixels")
