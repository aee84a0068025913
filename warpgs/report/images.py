"""Images of a report: colour maps, crops, sheets."""

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageDraw, ImageFont

GRAY = (0.5, 0.5, 0.5)
PAGE_WIDTH = 1280
"""Largest width of an image on a page [px]: a page shows it at about half this width, and phone screens have two device pixels
per CSS pixel."""
MAX_WEBP_SIDE = 16383
"""Largest side of a WebP image [px]."""


def png(image: np.ndarray) -> bytes:
    """Encode values in [0, 1], grey [H, W], RGB or RGBA [H, W, C], as PNG of 8 bits a channel; values outside are clamped."""
    pixels = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    return _encoded(".png", pixels if pixels.ndim == 2 else pixels[..., [2, 1, 0, 3][: pixels.shape[2]]])


def _encoded(suffix: str, pixels: np.ndarray, options: Sequence[int] = ()) -> bytes:
    import cv2

    return cv2.imencode(suffix, pixels, options)[1].tobytes()


def webp(image: np.ndarray | bytes, width: int = PAGE_WIDTH, quality: int = 82) -> bytes:
    """Encode colours [H, W, 3] in [0, 1], or an image file, as WebP of at most ``width`` px, a tenth of the size of a PNG."""
    import cv2

    if isinstance(image, bytes):
        pixels = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
    else:
        pixels = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)[..., ::-1]
    factor = min(1.0, width / pixels.shape[1], MAX_WEBP_SIDE / pixels.shape[0])
    if factor < 1:
        size = [max(1, round(factor * side)) for side in pixels.shape[1::-1]]
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    return _encoded(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, quality])


def straight_alpha(image: np.ndarray, alpha: np.ndarray, background: tuple[float, float, float]) -> np.ndarray:
    """Return colours with straight alpha, [H, W, 4], of colours over a background [H, W, 3]; black where ``alpha`` is 0."""
    own = image - (1 - alpha[..., None]) * np.float32(background)
    colors = np.divide(own, alpha[..., None], out=np.zeros_like(own), where=alpha[..., None] > 0)
    return np.concatenate([np.clip(colors, 0, 1), alpha[..., None]], axis=2)


def resized(image: np.ndarray, width: int, height: int):
    """Return colours in [0, 1], [H, W, 3], at another size, as a Pillow image; areas are averaged if the width shrinks."""
    pixels = Image.fromarray(np.round(np.clip(image, 0, 1) * 255).astype(np.uint8))
    return pixels.resize((width, height), Image.Resampling.BOX if width < image.shape[1] else Image.Resampling.BICUBIC)


def colored(values: np.ndarray, name: str) -> np.ndarray:
    """Return the colours [H, W, 3] that a colour map of OpenCV, such as INFERNO, gives to values [H, W] between 0 and 1."""
    import cv2

    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], getattr(cv2, f"COLORMAP_{name}"))[:, 0, ::-1]
    return np.take(table.astype(np.float32) / 255, np.round(np.clip(values, 0, 1) * 255).astype(np.uint8), axis=0)


def channel_mean(image: np.ndarray) -> np.ndarray:
    """Return the mean over the channels of an image [H, W, 3], [H, W]: as ``image.mean(-1)``, in a tenth of its time."""
    total = image[..., 0] + image[..., 1]
    total += image[..., 2]
    total /= 3
    return total


def error_map(image: np.ndarray, reference: np.ndarray, largest: float = 0.3) -> np.ndarray:
    """Return colours [H, W, 3] of the absolute error averaged over channels; ``largest`` and above is the brightest."""
    return colored(channel_mean(np.abs(np.clip(image, 0, 1) - reference)) / largest, "INFERNO")


def depth_map(depth: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return colours [H, W, 3] of inverse depth, near warm, far cold; gray where alpha is at most 0.5 or depth is 0."""
    valid = (alpha > 0.5) & (depth > 0)
    values = np.zeros(depth.shape)
    if valid.any():
        inverse = 1 / depth[valid]
        low, high = np.percentile(inverse, [2, 98])
        values[valid] = (inverse - low) / max(high - low, 1e-12)
    colors = colored(values, "TURBO")
    colors[~valid] = GRAY
    return colors


def side_by_side(images: list[np.ndarray], gap: int = 4) -> np.ndarray:
    """Return images [H, W, 3] of one height in a row, with ``gap`` white columns between them."""
    bar = np.ones((images[0].shape[0], gap, 3), np.float32)
    return np.concatenate([part for image in images for part in (image, bar)][:-1], axis=1)


def frame_sheet(frames: list[np.ndarray], columns: int = 3, gap: int = 4) -> np.ndarray:
    """Return frames [H, W, 3] of one size in rows of ``columns``, with ``gap`` white pixels between them."""
    frames = frames + [np.ones_like(frames[0])] * (-len(frames) % columns)
    rows = [side_by_side(frames[i : i + columns], gap) for i in range(0, len(frames), columns)]
    return side_by_side([row.swapaxes(0, 1) for row in rows], gap).swapaxes(0, 1)


def crops(values: np.ndarray, width: int, height: int, count: int) -> list[tuple[int, int]]:
    """Return corners (x, y) [px] of up to ``count`` disjoint crops with the largest sums of ``values`` [H, W]."""
    H, W = values.shape
    width, height = min(width, W), min(height, H)
    total = np.zeros((H + 1, W + 1))
    total[1:, 1:] = values.astype(np.float64).cumsum(0).cumsum(1)
    sums = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    if not sums.max() > 1e-9:
        sums[(H - height) // 2, (W - width) // 2] = 1
    found: list[tuple[int, int]] = []
    while len(found) < count and sums.max() >= 0:
        y, x = map(int, np.unravel_index(sums.argmax(), sums.shape))
        found.append((x, y))
        sums[max(0, y - height + 1) : y + height, max(0, x - width + 1) : x + width] = -1
    return found


UNSEEN, ONCE = (0.82, 0.0, 0.52), (1.0, 0.69, 0.0)
"""Magenta and amber: they differ in brightness, too, and for every kind of colour vision."""
COVERAGE_LEGEND = "striped magenta: seen by no training view; amber: seen by one; unchanged: seen by two or more, or background"
"""Meaning of the colours."""
STRIPES = 90
"""Stripes along the larger side of an image."""


def coverage_image(image: np.ndarray, unseen: np.ndarray, once: np.ndarray) -> np.ndarray:
    """Return a render [H, W, 3] with magenta stripes where ``unseen`` [H, W], and an amber tint where ``once`` [H, W]."""
    image = np.ascontiguousarray(np.clip(image, 0, 1), np.float32)
    height, width = unseen.shape
    period = max(4, round(max(height, width) / STRIPES))
    stripe = np.lib.stride_tricks.sliding_window_view(np.arange(height + width - 1) % period < period / 2, width)
    for pixels, share, tint in ((unseen & stripe, 0.75, UNSEEN), (unseen & ~stripe, 0.3, UNSEEN), (once & ~unseen, 0.45, ONCE)):
        at, shade = np.flatnonzero(pixels), np.float32(share)
        # gray beneath the tint: the colours of the image would change its hue
        gray = channel_mean(image.reshape(-1, 3).take(at, axis=0))
        image.reshape(-1, 3)[at] = (1 - shade) * gray[:, None] + shade * np.float32(tint)
    return image


CONTACT_PAPER, CONTACT_INK, CONTACT_SOFT, CONTACT_LINE = (251, 251, 249), (27, 29, 33), (102, 108, 118), (223, 226, 231)
LABEL_SIZE, TEXT_SIZE, TITLE_SIZE = 15, 13, 22  # [px]
CONTACT_MARGIN, CONTACT_GAP, CONTACT_HEAD = 28, 18, 30  # [px]; HEAD is the height of a label
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
    """Colours [H, W, 3], or values [H, W], both in [0, 1]."""
    colors: str = "INFERNO"
    """Colour map of values."""
    dots: np.ndarray | None = None
    """Rows and columns of pixels to mark, shape [S, 2]."""


def _tile_image(tile: Tile, size: tuple[int, int]):
    """Return a tile's pixels at a size (width, height) [px], as a Pillow image."""
    values = tile.values
    if values.ndim == 2:
        values = colored(values, tile.colors)
    image = resized(values, *size)
    return image if tile.dots is None else _dotted(image, (tile.dots + 0.5) * (size[0] / tile.values.shape[1]))


def _dotted(image, centers: np.ndarray):
    """Return an image with small discs at rows and columns [px], shape [S, 2], anti-aliased by supersampling."""
    least, most = 0.9, max(1.4, image.width / 220)
    radius = min(most, max(least, (MAX_DOT_FRACTION * image.width * image.height / (np.pi * max(1, len(centers)))) ** 0.5))
    fine = 4
    cover = Image.new("L", (fine * image.width, fine * image.height))
    draw = ImageDraw.Draw(cover)
    for y, x in fine * centers:
        draw.ellipse((x - fine * radius, y - fine * radius, x + fine * radius, y + fine * radius), 255)
    image.paste(DOT, mask=cover.reduce(fine))
    return image


def contact_sheet(title: str, lines: list[str], tiles: list[Tile], *, columns: int = 4, tile_width: int = 440) -> np.ndarray:
    """Arrange labelled tiles of one size in rows, with lines of text; colours [rows, columns, 3]."""
    height, width = tiles[0].values.shape[:2]
    tile_height = max(1, round(tile_width * height / width))
    cells = len(tiles) + bool(lines)
    rows = -(-cells // columns)
    top = CONTACT_MARGIN + TITLE_SIZE + 18
    across = 2 * CONTACT_MARGIN + columns * tile_width + (columns - 1) * CONTACT_GAP
    down = top + rows * (CONTACT_HEAD + tile_height) + (rows - 1) * CONTACT_GAP + CONTACT_MARGIN
    sheet = Image.new("RGB", (across, down), CONTACT_PAPER)
    draw = ImageDraw.Draw(sheet)
    fonts = {s: ImageFont.load_default(s) for s in (LABEL_SIZE, TEXT_SIZE, TITLE_SIZE)}
    draw.text((CONTACT_MARGIN, CONTACT_MARGIN - 4), title, CONTACT_INK, fonts[TITLE_SIZE])
    for i in range(cells):
        x = CONTACT_MARGIN + (i % columns) * (tile_width + CONTACT_GAP)
        y = top + (i // columns) * (CONTACT_HEAD + tile_height + CONTACT_GAP)
        if i == len(tiles):
            draw.line((x, y + CONTACT_HEAD, x + tile_width - 1, y + CONTACT_HEAD), CONTACT_LINE)
            characters = int(tile_width / (0.5 * TEXT_SIZE))
            words = "\n\n".join(textwrap.fill(line, characters) for line in lines)
            draw.multiline_text((x, y + CONTACT_HEAD + 14), words, CONTACT_SOFT, fonts[TEXT_SIZE], spacing=5)
            break
        tile = tiles[i]
        label = tile.label[: int(tile_width / (0.5 * LABEL_SIZE))]
        draw.text((x, y + CONTACT_HEAD // 5), label, CONTACT_INK, fonts[LABEL_SIZE])
        sheet.paste(_tile_image(tile, (tile_width, tile_height)), (x, y + CONTACT_HEAD))
    return np.asarray(sheet, np.float32) / 255
