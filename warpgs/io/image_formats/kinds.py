"""Supported image formats, detected by the first bytes of a file."""

from __future__ import annotations

from types import ModuleType

from warpgs.io.image_formats import avif, bmp, jpeg, png, tiff, webp

FORMATS: tuple[tuple[bytes, str, ModuleType], ...] = (
    (b"\xff\xd8\xff", "JPEG", jpeg),
    (png.SIGNATURE, "PNG", png),
    (b"BM", "BMP", bmp),
    (b"II*\0", "TIFF", tiff),
    (b"MM\0*", "TIFF", tiff),
    (b"II+\0", "TIFF", tiff),
    (b"MM\0+", "TIFF", tiff),
    (b"RIFF", "WEBP", webp),
)
"""First bytes, Pillow's name, and module of each supported format; AVIF is recognised by its brand."""
READ = "JPEG, PNG, BMP, TIFF, WebP or AVIF"
"""The formats that are read, for messages."""


def format_of(data: bytes) -> tuple[str, ModuleType]:
    """Return name and module of the format of an image file, by its first bytes.

    Raises:
        ValueError: The format is not supported.
    """
    for start, name, module in FORMATS:
        if data.startswith(start):
            return name, module
    if avif.kind(data) == "AVIF":
        return "AVIF", avif
    raise ValueError(f"it is not a {READ} file" if data else "it is empty")
