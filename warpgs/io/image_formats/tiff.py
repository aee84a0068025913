"""TIFF: the strips or tiles of the first image must lie in the file, must not overlap, and must hold all their pixels.

Deflate has a checksum, which is checked. Pillow decodes other compressions, and stops if libtiff reports an error. OpenCV
decodes pixels with more bits than Pillow supports, and stops at errors, too.
"""

from __future__ import annotations

import io
import struct
from dataclasses import dataclass

from warpgs.io.image_formats.png import unpacked_size

TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
"""Layouts of the integers that tags may hold, by type."""
SIZES = {1: 1, 2: 1, 3: 2, 4: 4, 6: 1, 7: 1, 8: 2, 9: 4, 11: 4, 13: 4}
"""Bytes of a value by type; values of other types have 8."""
WIDTH, HEIGHT, BITS, COMPRESSION, CHANNELS, PLANES = 256, 257, 258, 259, 277, 284
ROWS, OFFSETS, COUNTS = 278, 273, 279
TILE_WIDTH, TILE_HEIGHT, TILE_OFFSETS, TILE_COUNTS = 322, 323, 324, 325
PHOTOMETRIC, YCBCR = 262, 6
READ = (
    WIDTH, HEIGHT, BITS, COMPRESSION, CHANNELS, PLANES, ROWS, OFFSETS, COUNTS, TILE_WIDTH, TILE_HEIGHT, TILE_OFFSETS,
    TILE_COUNTS, PHOTOMETRIC,
)  # fmt: skip
"""Tags that are read here."""
RAW, DEFLATE = 1, (8, 32946)
MAX_ENTRIES = 4096
"""Largest number of tags in a directory."""


def _tags(data: bytes) -> dict[int, tuple[int, ...]]:
    """Return the integers of the first directory by tag."""
    order = "<" if data[:2] == b"II" else ">"
    big = len(data) > 4 and data[2:4] in (b"+\0", b"\0+")
    number, entry, slot = ("Q", "HHQ", 8) if big else ("I", "HHI", 4)
    try:
        (at,) = struct.unpack_from(order + number, data, 8 if big else 4)
        (count,) = struct.unpack_from(order + ("Q" if big else "H"), data, at)
        at += 8 if big else 2
        if count > MAX_ENTRIES:
            raise ValueError(f"its directory announces {count} tags")
        tags, room = {}, len(data)
        for _ in range(count):
            tag, kind, length = struct.unpack_from(order + entry, data, at)
            place = at + struct.calcsize(order + entry)
            at = place + slot
            room -= max(0, SIZES.get(kind, 8) * length - slot)
            if room < 0:
                raise ValueError("its tags overlap, or lie outside of the file")
            if tag not in READ or kind not in TYPES:
                continue
            layout = order + f"{length}{TYPES[kind]}"
            if struct.calcsize(layout) > slot:
                (place,) = struct.unpack_from(order + number, data, place)
            tags[tag] = struct.unpack_from(layout, data, place)
    except (struct.error, OverflowError) as e:
        raise ValueError("its directory points outside the file") from e
    return tags


@dataclass(frozen=True)
class _Image:
    """The first image of a file."""

    tags: dict[int, tuple[int, ...]]

    def one(self, tag: int, default: int | None = None) -> int:
        values = self.tags.get(tag) or (() if default is None else (default,))
        if not values:
            raise ValueError(f"it lacks the tag {tag}")
        return values[0]

    def pieces(self) -> list[tuple[int, int, int]]:
        """Return offset, bytes in the file and bytes unpacked of each strip or tile."""
        width, height = self.one(WIDTH), self.one(HEIGHT)
        channels, planes = self.one(CHANNELS, 1), self.one(PLANES, 1)
        depths = self.tags.get(BITS, (1,))
        if len(set(depths)) != 1 or planes not in (1, 2):
            raise ValueError("its channels differ in bit depth, or their layout is unknown; save it as PNG")
        bits, copies = depths[0] * (channels if planes == 1 else 1), channels if planes == 2 else 1
        if TILE_OFFSETS in self.tags:
            across, down = self.one(TILE_WIDTH), self.one(TILE_HEIGHT)
            if not across or not down:
                raise ValueError("its tiles have no size")
            sizes = [down * ((across * bits + 7) // 8)] * (-(-width // across) * -(-height // down))
            offsets, counts = self.tags[TILE_OFFSETS], self.tags.get(TILE_COUNTS, ())
        else:
            rows = min(self.one(ROWS, height), height)
            if not rows:
                raise ValueError("its strips have no rows")
            row = (width * bits + 7) // 8
            sizes = [row * min(rows, height - y) for y in range(0, height, rows)]
            offsets, counts = self.tags.get(OFFSETS, ()), self.tags.get(COUNTS, ())
        if not len(offsets) == len(counts) == len(sizes) * copies:
            raise ValueError(f"it has {len(offsets)} strips or tiles and needs {len(sizes) * copies}")
        return list(zip(offsets, counts, sizes * copies))


def size(data: bytes) -> tuple[int, int]:
    """Return width and height [px] of the first image.

    Raises:
        ValueError: The header is broken.
    """
    image = _Image(_tags(data))
    return image.one(WIDTH), image.one(HEIGHT)


def _check_deflate(data: bytes, pieces: list[tuple[int, int, int]]) -> None:
    view = memoryview(data)
    for offset, count, unpacked in pieces:
        if unpacked_size(iter([view[offset : offset + count]]), unpacked) < unpacked:
            raise ValueError("a strip or tile holds too few pixels")


def _check_by_pillow(data: bytes) -> None:
    from PIL import Image, TiffImagePlugin, UnidentifiedImageError

    try:
        with TiffImagePlugin.TiffImageFile(io.BytesIO(data)) as image:
            image.load()
    except (SyntaxError, UnidentifiedImageError):
        return  # a kind of pixels that Pillow does not know
    except (OSError, ValueError, KeyError, TypeError, OverflowError, struct.error, Image.DecompressionBombError) as e:
        raise ValueError(f"its compressed pixels are damaged ({e})") from e


def check(data: bytes) -> None:
    """Check that all strips or tiles are there, do not overlap, and unpack to the right number of bytes.

    Raises:
        ValueError: A strip or tile is missing, overlaps another, or has the wrong size; or a checksum does not match.
    """
    image = _Image(_tags(data))
    pieces = image.pieces()
    end = 0
    for offset, count, _ in sorted(pieces):
        if offset < max(end, 8) or offset + count > len(data):
            raise ValueError("its strips or tiles overlap, or lie outside of the file")
        end = offset + count
    compression = image.one(COMPRESSION, RAW)
    if compression == RAW:
        if image.one(PHOTOMETRIC, 0) == YCBCR:
            raise ValueError("its colours are YCbCr; save it as PNG")
        if any(count < unpacked for _, count, unpacked in pieces):
            raise ValueError("a strip or tile holds too few pixels")
    elif compression in DEFLATE:
        _check_deflate(data, pieces)
    else:
        _check_by_pillow(data)
