"""Figure of images side by side: one row per view, one column per method, with enlarged crops, as PNG."""

from __future__ import annotations

import io
from dataclasses import dataclass

import numpy as np

from warpgs.report.images import resized

INK, SOFT, PAPER = (27, 29, 33), (102, 108, 118), (255, 255, 255)
BOXES = ((240, 78, 35), (0, 158, 190), (240, 190, 0))
"""Colours of the boxes, and of the frames of their crops."""
MAX_WIDTH = 2600
"""Largest width of a figure of many columns [px]; exceeded if columns would be narrower than `CELL` allows."""
CELL = (180, 480)
"""Smallest and largest width of a column [px]."""
GAP, MARGIN, HEAD, CAPTION = 8, 20, 38, 32


@dataclass(frozen=True)
class Cell:
    """One image of a row."""

    image: np.ndarray
    """Colours in [0, 1], [H, W, 3]; all images of a row have one size."""
    caption: str
    """Text below the image."""


@dataclass(frozen=True)
class Strip:
    """One row: the images of a view by every method."""

    title: str
    """Text above the row."""
    cells: tuple[Cell, ...]
    crops: tuple[tuple[int, int, int, int], ...]
    """Crops to enlarge: x, y, width, height [px]."""


def _column(count: int, widest: int) -> int:
    available = (MAX_WIDTH - 2 * MARGIN + GAP) // count - GAP
    return max(CELL[0], min(CELL[1], available, max(widest, 320)))


def sheet(headings: list[str], strips: list[Strip]) -> bytes:
    """Return a figure as PNG bytes.

    Args:
        headings: Headings of the columns, from left to right.
        strips: Rows; each has a cell per heading.

    Returns:
        An 8-bit RGB PNG; images are scaled to the width of a column, and the crops below them share this width.
    """
    from PIL import Image, ImageDraw, ImageFont

    column = _column(len(headings), max(s.cells[0].image.shape[1] for s in strips))
    bold, small = (ImageFont.load_default(max(least, column / part)) for least, part in ((17, 22), (14, 30)))

    def fitted(text: str, font, width: int) -> str:
        while text and font.getlength(text) > width:
            text = text[:-2].rstrip("…") + "…" if len(text) > 2 else ""
        return text

    heights = []
    for s in strips:
        H, W = s.cells[0].image.shape[:2]
        zoom = 0
        if s.crops:
            inner = (column - GAP * (len(s.crops) - 1)) // len(s.crops)
            zoom = GAP + max(round(inner * h / w) for _, _, w, h in s.crops)
        heights.append((round(column * H / W), zoom))
    width = 2 * MARGIN + len(headings) * (column + GAP) - GAP
    height = MARGIN + HEAD + sum(HEAD + a + b + CAPTION for a, b in heights) + MARGIN // 2
    canvas = Image.new("RGB", (width, height), PAPER)
    draw = ImageDraw.Draw(canvas)
    for i, heading in enumerate(headings):
        middle = MARGIN + i * (column + GAP) + column / 2
        draw.text((middle, MARGIN + 18), fitted(heading, bold, column), INK, bold, anchor="ms")
    y = MARGIN + HEAD
    for s, (tall, zoom) in zip(strips, heights):
        draw.line((MARGIN, y, width - MARGIN, y), (217, 220, 225))
        draw.text((MARGIN, y + 10), s.title, SOFT, small)
        y += HEAD
        factor = column / s.cells[0].image.shape[1]
        for i, cell in enumerate(s.cells):
            x = MARGIN + i * (column + GAP)
            canvas.paste(resized(cell.image, column, tall), (x, y))
            for k, (cx, cy, w, h) in enumerate(s.crops):
                inner = (column - GAP * (len(s.crops) - 1)) // len(s.crops)
                color = BOXES[k % len(BOXES)]
                box = [x + cx * factor, y + cy * factor, x + (cx + w) * factor - 1, y + (cy + h) * factor - 1]
                draw.rectangle([round(v) for v in box], outline=color, width=3)
                left, top = x + k * (inner + GAP), y + tall + GAP
                canvas.paste(resized(cell.image[cy : cy + h, cx : cx + w], inner, round(inner * h / w)), (left, top))
                draw.rectangle([left, top, left + inner - 1, top + round(inner * h / w) - 1], outline=color, width=3)
            words = fitted(cell.caption, small, column)
            draw.text((x + column / 2, y + tall + zoom + 20), words, SOFT, small, anchor="ms")
        y += tall + zoom + CAPTION
    out = io.BytesIO()
    canvas.save(out, "PNG")
    return out.getvalue()
