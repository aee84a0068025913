"""Images of a report: PNG bytes, colour maps, error and depth maps."""

from __future__ import annotations

import numpy as np

from warpgs.errors import ResourceError

GRAY = (0.5, 0.5, 0.5)
PAGE_WIDTH = 1280
"""Largest width of an image on a page [px]: a page shows it at about half this width, and phone screens have two device pixels
per CSS pixel."""
MAX_WEBP_SIDE = 16383
"""Largest side of a WebP image [px]."""


def png(image: np.ndarray) -> bytes:
    """Encode colours in [0, 1], [H, W, 3] or with straight alpha [H, W, 4], as 8-bit PNG; values outside are clamped.

    Raises:
        ResourceError: OpenCV cannot encode the image.
    """
    import cv2

    pixels = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)
    done, data = cv2.imencode(".png", pixels[..., [2, 1, 0, 3][: pixels.shape[2]]])
    if not done:
        raise ResourceError(f"an image of {image.shape[1]} x {image.shape[0]} px could not be encoded as PNG")
    return data.tobytes()


def webp(image: np.ndarray | bytes, width: int = PAGE_WIDTH, quality: int = 82) -> bytes:
    """Encode an image for a page as WebP: losses are hard to see, and a photograph takes a tenth of its PNG.

    Args:
        image: Colours in [0, 1], shape [H, W, 3], or the contents of an image file.
        width: Largest width [px]; a wider image is reduced to it.
        quality: From 0 to 100.

    Raises:
        ResourceError: OpenCV cannot encode the image.
    """
    import cv2

    if isinstance(image, bytes):
        pixels = cv2.imdecode(np.frombuffer(image, np.uint8), cv2.IMREAD_COLOR)
    else:
        pixels = np.round(np.clip(image, 0, 1) * 255).astype(np.uint8)[..., ::-1]
    factor = min(1.0, width / pixels.shape[1], MAX_WEBP_SIDE / pixels.shape[0])
    if factor < 1:
        size = [max(1, round(factor * side)) for side in pixels.shape[1::-1]]
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA)
    done, data = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not done:
        raise ResourceError(f"an image of {pixels.shape[1]} x {pixels.shape[0]} px could not be encoded as WebP")
    return data.tobytes()


def straight_alpha(image: np.ndarray, alpha: np.ndarray, background: tuple[float, float, float]) -> np.ndarray:
    """Return colours with straight alpha, [H, W, 4], of colours over a background [H, W, 3]; black where ``alpha`` is 0.

    Composited over ``background``, the result is the image again; over another colour, the scene in front of that colour.
    """
    own = image - (1 - alpha[..., None]) * np.float32(background)
    colors = np.divide(own, alpha[..., None], out=np.zeros_like(own), where=alpha[..., None] > 0)
    return np.concatenate([np.clip(colors, 0, 1), alpha[..., None]], axis=2)


def resized(image: np.ndarray, width: int, height: int):
    """Return colours in [0, 1], [H, W, 3], at another size, as a Pillow image; areas are averaged if the width shrinks."""
    from PIL import Image

    pixels = Image.fromarray(np.round(np.clip(image, 0, 1) * 255).astype(np.uint8))
    way = Image.Resampling.BOX if width < image.shape[1] else Image.Resampling.BICUBIC
    return pixels.resize((width, height), way)


def colored(values: np.ndarray, name: str) -> np.ndarray:
    """Return the colours [H, W, 3] that a colour map of OpenCV, such as INFERNO, gives to values [H, W] between 0 and 1."""
    import cv2

    table = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], getattr(cv2, f"COLORMAP_{name}"))[:, 0, ::-1]
    return table[np.round(np.clip(values, 0, 1) * 255).astype(np.uint8)].astype(np.float32) / 255


def error_map(image: np.ndarray, reference: np.ndarray, largest: float = 0.3) -> np.ndarray:
    """Return colours [H, W, 3] of the absolute error averaged over channels; ``largest`` and above is the brightest."""
    return colored(np.abs(np.clip(image, 0, 1) - reference).mean(-1) / largest, "INFERNO")


def depth_map(depth: np.ndarray, alpha: np.ndarray) -> np.ndarray:
    """Return colours [H, W, 3] of depth, near warm and far cold, by inverse depth between its 2nd and 98th percentile.

    Gray where alpha is at most one half, or depth is 0.
    """
    valid = (alpha > 0.5) & (depth > 0)
    colors = np.full((*depth.shape, 3), GRAY, np.float32)
    if valid.any():
        inverse = 1 / depth[valid]
        low, high = np.percentile(inverse, [2, 98])
        colors[valid] = colored(((inverse - low) / max(high - low, 1e-12))[:, None], "TURBO")[:, 0]
    return colors


def side_by_side(images: list[np.ndarray], gap: int = 4) -> np.ndarray:
    """Return images [H, W, 3] of one height in a row, with ``gap`` white columns between them."""
    height = images[0].shape[0]
    bar = np.ones((height, gap, 3), np.float32)
    row = [part for image in images for part in (image, bar)][:-1]
    return np.concatenate(row, axis=1)


def frame_sheet(frames: list[np.ndarray], columns: int = 3, gap: int = 4) -> np.ndarray:
    """Return frames [H, W, 3] of one size in rows of ``columns``, with ``gap`` white pixels between them."""
    frames = frames + [np.ones_like(frames[0])] * (-len(frames) % columns)
    rows = [side_by_side(frames[i : i + columns], gap) for i in range(0, len(frames), columns)]
    bar = np.ones((gap, rows[0].shape[1], 3), np.float32)
    return np.concatenate([part for row in rows for part in (row, bar)][:-1])
