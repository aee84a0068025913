"""Image files without personal metadata: EXIF with its GPS position, XMP, comments, profiles."""

from __future__ import annotations

from warpgs.io.image_formats.jpeg import EOI, LONE, MARKER, NEXT_MARKER, SOS
from warpgs.io.image_formats.png import SIGNATURE

JFIF, ADOBE, COMMENT = 0xE0, 0xEE, 0xFE
"""JPEG segments: the first two define the colour coding, and are kept."""
APPLICATION = range(0xE0, 0xF0)
"""JPEG segments of applications."""
KEPT_CHUNKS = (b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND")
"""Chunks of a PNG file with its pixels; all others are metadata."""


def without_jpeg_metadata(data: bytes) -> bytes:
    """Return a JPEG file that decodes to the same pixels, without comments and application segments (JFIF and Adobe stay).

    Data after the end of the image are removed, too: phones store films and depth maps there.

    Args:
        data: A file that was decoded without an error.
    """
    parts, at = [data[:2]], 2
    while found := MARKER.match(data, at):
        marker, begin, at = found[1][0], at, found.end()
        if marker == EOI:
            return b"".join([*parts, data[begin:at]])
        if marker not in LONE:
            at += int.from_bytes(data[at : at + 2], "big")
        if marker == SOS:
            after = NEXT_MARKER.search(data, at)
            at = len(data) if after is None else after.start()
        if marker in (JFIF, ADOBE) or not (marker == COMMENT or marker in APPLICATION):
            parts.append(data[begin:at])
    return b"".join(parts)


def without_png_metadata(data: bytes) -> bytes:
    """Return a PNG file with only those chunks that hold pixels.

    Args:
        data: A file that was decoded without an error.
    """
    parts, at = [SIGNATURE], len(SIGNATURE)
    while at + 12 <= len(data):
        kind, begin = data[at + 4 : at + 8], at
        at += 12 + int.from_bytes(data[at : at + 4], "big")
        if kind in KEPT_CHUNKS:
            parts.append(data[begin:at])
        if kind == b"IEND":
            break
    return b"".join(parts)
