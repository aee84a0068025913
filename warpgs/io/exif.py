"""EXIF of a photograph and its lens: five tags, read from the first directory and the block of exposure data.

The layout is that of TIFF (CIPA DC-008). Only the values of these tags are read, because libraries that read all of EXIF copy
overlapping values again and again.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from warpgs.io.image_formats import avif, jpeg, png, webp
from warpgs.io.image_formats.kinds import format_of

MAKE, MODEL, ORIENTATION, EXPOSURE, FOCAL_35MM = 0x010F, 0x0110, 0x0112, 0x8769, 0xA405
"""Tags: maker and model of the device, orientation, place of the exposure data, and focal length on 35 mm film [mm]."""
ASCII = 2
NUMBERS = {3: "H", 4: "I"}
"""Layouts of the integers that EXIF tags may hold, by type."""
MAX_ENTRIES = 1000
"""Largest number of tags in a directory."""
MAX_TEXT = 100
"""Longest maker or model that is read [bytes]."""
MAX_FOCAL = 10_000
"""Longest equivalent focal length that is accepted [mm]."""
PREFIX = b"Exif\0\0"
"""First bytes of EXIF in JPEG, and in some WebP files."""


@dataclass(frozen=True)
class Exif:
    """Values of EXIF; missing values have the defaults."""

    orientation: int = 1
    """Orientation of the stored raster, 1 to 8."""
    maker: str = ""
    """Maker of the device."""
    model: str = ""
    """Model of the device."""
    focal: float | None = None
    """Focal length [mm] that gives the same field of view on 35 mm film."""

    @property
    def device(self) -> str:
        """Maker and model, as far as known."""
        return " ".join(filter(None, (self.maker, self.model)))[:MAX_TEXT]


def read_exif(data: bytes) -> Exif:
    """Return the EXIF values of an image file; damaged values count as missing."""
    try:
        return parse_exif(_block(data))
    except ValueError:
        return Exif()


def parse_exif(block: bytes) -> Exif:
    """Return the values of a block of EXIF, which begins as a TIFF file does; damaged values count as missing."""
    block = block.removeprefix(PREFIX)
    order = {b"II*\0": "<", b"MM\0*": ">"}.get(block[:4])
    if order is None:
        return Exif()
    try:
        first = _Directory(block, order, *struct.unpack_from(order + "I", block, 4))
        orientation, place = first.number(ORIENTATION), first.number(EXPOSURE)
        maker, model = first.text(MAKE), first.text(MODEL)
        focal = None if place is None else _Directory(block, order, place).number(FOCAL_35MM)
    except (ValueError, struct.error):
        return Exif()
    if orientation is None or not 1 <= orientation <= 8:
        orientation = 1
    return Exif(orientation, maker, model, float(focal) if focal and focal <= MAX_FOCAL else None)


def _block(data: bytes) -> bytes:
    """Return the bytes of EXIF in an image file, which begin as a TIFF file does; maybe empty."""
    name, _ = format_of(data)
    found: bytes | memoryview = b""
    if name == "TIFF":
        found = data
    elif name == "JPEG":
        for marker, body in jpeg.segments(data):
            if marker == jpeg.SOS:
                break
            if marker == jpeg.APP1 and body.startswith(PREFIX):
                found = body
                break
    elif name == "PNG":
        found = next((body for kind, body in png.chunks(data) if kind == b"eXIf"), b"")
    elif name == "WEBP":
        found = next((body for kind, body in webp.chunks(data) if kind == b"EXIF"), b"")
    elif name == "AVIF":
        with avif.open_image(data) as image:
            found = image.info.get("exif", b"")
    return bytes(found)


class _Directory:
    """Entries of a directory of tags."""

    def __init__(self, block: bytes, order: str, at: int):
        self.block, self.order = block, order
        (count,) = struct.unpack_from(order + "H", block, at)
        if count > MAX_ENTRIES:
            raise ValueError(f"a directory of {count} tags")
        self.entries: dict[int, tuple[int, int, int]] = {}
        for i in range(count):
            place = at + 2 + 12 * i
            tag, kind, length = struct.unpack_from(order + "HHI", block, place)
            self.entries[tag] = kind, length, place + 8

    def number(self, tag: int) -> int | None:
        """Return a single integer, or None."""
        kind, length, place = self.entries.get(tag, (0, 0, 0))
        if kind not in NUMBERS or length != 1:
            return None
        value: int = struct.unpack_from(self.order + NUMBERS[kind], self.block, place)[0]
        return value

    def text(self, tag: int) -> str:
        """Return the text of a tag, maybe empty, without the zero bytes and spaces around it."""
        kind, length, place = self.entries.get(tag, (0, 0, 0))
        if kind != ASCII:
            return ""
        if length > 4:
            (place,) = struct.unpack_from(self.order + "I", self.block, place)
        return self.block[place : place + min(length, MAX_TEXT)].decode("latin-1").strip("\0 ")
