"""A sheet of labelled pictures: what is known of one view, at a glance."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

import numpy as np

from warpgs.report.pictures import colored

PAPER, INK, SOFT, LINE = (251, 251, 249), (27, 29, 33), (102, 108, 118), (223, 226, 231)
LABEL_SIZE, TEXT_SIZE, TITLE_SIZE = 15, 13, 22  # [px]
MARGIN, GAP, HEAD = 28, 18, 30  # [px]; HEAD is the height of a label
LEGEND = (72, 8)  # width and height of a colour bar [px]


@dataclass(frozen=True)
class Tile:
    """One picture of a sheet."""

    label: str
    """What it shows, in a few words."""
    values: np.ndarray
    """Colours [H, W, 3] in [0, 1], or values [H, W]."""
    colors: str = "INFERNO"
    """Colour map of values."""
    largest: float = 1.0
    """Value of the map's last colour; the first is 0."""


def _picture(tile: Tile, size: tuple[int, int]):
    """A tile's pixels at a size (width, height), as a Pillow image."""
    from PIL import Image

    values = tile.values
    if values.ndim == 2:
        values = colored(values / tile.largest, tile.colors)
    pixels = np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)
    return Image.fromarray(pixels).resize(size, Image.Resampling.LANCZOS)


def contact_sheet(title: str, lines: list[str], tiles: list[Tile], *, columns: int = 4, tile_width: int = 440) -> np.ndarray:
    """Draw labelled tiles in rows, a colour bar with its range at each map, and lines of text in the place after the last.

    Args:
        title: Headline.
        lines: Sentences, wrapped to the width of a tile.
        tiles: At least one; all of one shape [H, W].
        columns: Tiles per row.
        tile_width: Width of a tile [px].

    Returns:
        The sheet, colours in [0, 1], float32, shape [rows, columns, 3].
    """
    from PIL import Image, ImageDraw, ImageFont

    height, width = tiles[0].values.shape[:2]
    tile_height = max(1, round(tile_width * height / width))
    rows = -(-(len(tiles) + 1) // columns)
    top = MARGIN + TITLE_SIZE + 18
    size = (
        2 * MARGIN + columns * tile_width + (columns - 1) * GAP,
        top + rows * (HEAD + tile_height) + (rows - 1) * GAP + MARGIN,
    )
    sheet = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(sheet)
    fonts = {s: ImageFont.load_default(s) for s in (LABEL_SIZE, TEXT_SIZE, TITLE_SIZE)}
    draw.text((MARGIN, MARGIN - 4), title, INK, fonts[TITLE_SIZE])
    for i in range(len(tiles) + 1):
        x, y = MARGIN + (i % columns) * (tile_width + GAP), top + (i // columns) * (HEAD + tile_height + GAP)
        if i == len(tiles):
            draw.line((x, y + HEAD, x + tile_width - 1, y + HEAD), LINE)
            characters = int(tile_width / (0.5 * TEXT_SIZE))
            text = "\n\n".join(textwrap.fill(line, characters) for line in lines)
            draw.multiline_text((x, y + HEAD + 14), text, SOFT, fonts[TEXT_SIZE], spacing=5)
            break
        tile = tiles[i]
        draw.text((x, y + 6), tile.label, INK, fonts[LABEL_SIZE])
        sheet.paste(_picture(tile, (tile_width, tile_height)), (x, y + HEAD))
        if tile.values.ndim == 2:
            right = x + tile_width
            largest = f"{tile.largest:g}"
            room = round(draw.textlength(largest, fonts[TEXT_SIZE]))
            bar = Tile("", np.linspace(0, 1, LEGEND[0], dtype=np.float32)[None].repeat(LEGEND[1], 0), tile.colors)
            draw.text((right, y + 8), largest, SOFT, fonts[TEXT_SIZE], anchor="ra")
            sheet.paste(_picture(bar, LEGEND), (right - room - 6 - LEGEND[0], y + 11))
            draw.text((right - room - 12 - LEGEND[0], y + 8), "0", SOFT, fonts[TEXT_SIZE], anchor="ra")
    return np.asarray(sheet, np.float32) / 255
