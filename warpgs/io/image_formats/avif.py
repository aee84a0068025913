"""AVIF: decoding to 8 bits by Pillow's libavif, and detection; HEIC files have the same container (ISO base media file).

libavif rejects a file that ends early. Damage inside the coded pixels is not detected.
"""

from __future__ import annotations

import io
import struct
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from PIL import ImageFile

BRANDS = {
    b"heic": "HEIC", b"heix": "HEIC", b"heim": "HEIC", b"heis": "HEIC", b"hevc": "HEIC", b"hevx": "HEIC", b"mif1": "HEIC",
    b"msf1": "HEIC", b"avif": "AVIF", b"avis": "AVIF", b"crx ": "RAW",
}  # fmt: skip
"""Major brands of ISO base media files (ISO/IEC 14496-12; 23008-12 for HEIC), and the formats that they stand for."""
HEAD = 12
"""Number of first bytes that determine the format: length, ``ftyp`` and the major brand."""
BRANDS_END = 32
"""End of the bytes that are searched for compatible brands."""
BROKEN = (OSError, SyntaxError, RuntimeError, EOFError, LookupError, AttributeError, TypeError, ValueError, struct.error)
"""Errors that Pillow raises about malformed files, as fuzzing shows."""


def kind(data: bytes) -> str | None:
    """Return HEIC, AVIF or RAW by the first bytes of an ISO base media file, or None for any other file."""
    found = BRANDS.get(data[8:HEAD]) if data[4:8] == b"ftyp" else None
    # mif1 is any still image; the compatible brands name the codec
    return "AVIF" if found == "HEIC" and b"avif" in data[HEAD:BRANDS_END] else found


def open_image(data: bytes) -> ImageFile.ImageFile:
    """Return an image whose header is read; its pixels are decoded when they are requested.

    Raises:
        ValueError: The header is broken, or the file ends early.
    """
    from PIL import AvifImagePlugin

    try:
        # not Image.open, which has a limit of its own on the number of pixels
        return AvifImagePlugin.AvifImageFile(io.BytesIO(data), "image")
    except BROKEN as e:
        raise ValueError(f"its decoder says: {e}") from e


def size(data: bytes) -> tuple[int, int]:
    """Return width and height [px].

    Raises:
        ValueError: The header is broken.
    """
    with open_image(data) as image:
        return image.size


def decode(data: bytes) -> np.ndarray:
    """Return the pixels, uint8, BGR or BGRA, shape [H, W, 3 or 4].

    Raises:
        ValueError: The decoder finds damage.
    """
    with open_image(data) as image:
        try:
            pixels = np.asarray(image.convert("RGBA" if "A" in image.getbands() else "RGB"))
        except BROKEN as e:
            raise ValueError(f"its decoder says: {e}") from e
    return np.ascontiguousarray(pixels[..., [2, 1, 0, 3][: pixels.shape[2]]])
