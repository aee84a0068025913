"""Contact sheets: the labelled images and maps of one view on one sheet."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass

import numpy as np

from warpgs.report.images import colored, resized

PAPER, INK, SOFT, LINE = (251, 251, 249), (27, 29, 33), (102, 108, 118), (223, 226, 231)
LABEL_SIZE, TEXT_SIZE, TITLE_SIZE = 15, 13, 22  # [px]
MARGIN, GAP, HEAD = 28, 18, 30  # [px]; HEAD is the height of a label
LEGEND = (72, 8)  # width and height of a colour bar [px]
DOT = (240, 78, 35)
"""Colour of dots."""
MAX_DOT_FRACTION = 0.08
"""Fraction of an image that dots may cover before they shrink, down to a radius of 0.9 px."""


@dataclass(frozen=True)
class Tile:
    """One image of a sheet."""

    label: str
    """Name of the content, in a few words."""
    values: np.ndarray
    """Colours [H, W, 3] in [0, 1], or values [H, W]."""
    colors: str = "INFERNO"
    """Colour map of values."""
    largest: float = 1.0
    """Value of the last colour of the map; the first is 0."""
    dots: np.ndarray | None = None
    """Rows and columns of pixels to mark, shape [S, 2]."""


def _tile_image(tile: Tile, size: tuple[int, int]):
    """Return a tile's pixels at a size (width, height) [px], as a Pillow image."""
    values = tile.values
    if values.ndim == 2:
        values = colored(values / tile.largest, tile.colors)
    image = resized(values, *size)
    return image if tile.dots is None else _dotted(image, (tile.dots + 0.5) * (size[0] / tile.values.shape[1]))


def _dotted(image, centers: np.ndarray):
    """Return an image with small discs at rows and columns [px], shape [S, 2], anti-aliased by supersampling."""
    from PIL import Image, ImageDraw

    least, most = 0.9, max(1.4, image.width / 220)
    radius = min(most, max(least, (MAX_DOT_FRACTION * image.width * image.height / (np.pi * max(1, len(centers)))) ** 0.5))
    fine = 4
    cover = Image.new("L", (fine * image.width, fine * image.height))
    draw = ImageDraw.Draw(cover)
    for y, x in fine * centers:
        draw.ellipse((x - fine * radius, y - fine * radius, x + fine * radius, y + fine * radius), 255)
    image.paste(DOT, mask=cover.reduce(fine))
    return image


def contact_sheet(
    title: str, lines: list[str], tiles: list[Tile], *, columns: int = 4, tile_width: int = 440, text: float = 1.0
) -> np.ndarray:
    """Arrange labelled tiles in rows, with a colour bar at each map and lines of text after the last tile.

    Args:
        title: Headline.
        lines: Sentences, wrapped to the width of a tile.
        tiles: At least one; all of one height and width.
        columns: Tiles per row.
        tile_width: Width of a tile [px].
        text: Factor on the font sizes, for a sheet that is shown at a reduced size.

    Returns:
        The sheet, colours in [0, 1], float32, shape [rows, columns, 3].
    """
    from PIL import Image, ImageDraw, ImageFont

    height, width = tiles[0].values.shape[:2]
    tile_height = max(1, round(tile_width * height / width))
    rows = -(-(len(tiles) + 1) // columns)
    label_size, text_size, title_size, head = (round(text * v) for v in (LABEL_SIZE, TEXT_SIZE, TITLE_SIZE, HEAD))
    top = MARGIN + title_size + 18
    size = (
        2 * MARGIN + columns * tile_width + (columns - 1) * GAP,
        top + rows * (head + tile_height) + (rows - 1) * GAP + MARGIN,
    )
    sheet = Image.new("RGB", size, PAPER)
    draw = ImageDraw.Draw(sheet)
    fonts = {s: ImageFont.load_default(s) for s in (label_size, text_size, title_size)}
    draw.text((MARGIN, MARGIN - 4), title, INK, fonts[title_size])
    for i in range(len(tiles) + 1):
        x, y = MARGIN + (i % columns) * (tile_width + GAP), top + (i // columns) * (head + tile_height + GAP)
        if i == len(tiles):
            draw.line((x, y + head, x + tile_width - 1, y + head), LINE)
            characters = int(tile_width / (0.5 * text_size))
            words = "\n\n".join(textwrap.fill(line, characters) for line in lines)
            draw.multiline_text((x, y + head + 14), words, SOFT, fonts[text_size], spacing=5)
            break
        tile = tiles[i]
        draw.text((x, y + head // 5), tile.label, INK, fonts[label_size])
        sheet.paste(_tile_image(tile, (tile_width, tile_height)), (x, y + head))
        if tile.values.ndim == 2:
            middle, right = y + head // 2, x + tile_width
            largest = f"{tile.largest:g}"
            text_width = round(draw.textlength(largest, fonts[text_size]))
            bar = Tile("", np.linspace(0, 1, LEGEND[0], dtype=np.float32)[None].repeat(LEGEND[1], 0), tile.colors)
            draw.text((right, middle), largest, SOFT, fonts[text_size], anchor="rm")
            sheet.paste(_tile_image(bar, LEGEND), (right - text_width - 6 - LEGEND[0], middle - LEGEND[1] // 2))
            draw.text((right - text_width - 12 - LEGEND[0], middle), "0", SOFT, fonts[text_size], anchor="rm")
    return np.asarray(sheet, np.float32) / 255
