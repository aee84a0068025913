"""Image of coverage: a render with a pattern where few training views looked."""

from __future__ import annotations

import numpy as np

UNSEEN, ONCE = (0.82, 0.0, 0.52), (1.0, 0.69, 0.0)
"""Magenta and amber: they differ in brightness, too, and for every kind of colour vision."""
LEGEND = "striped magenta: seen by no training view; amber: seen by one; unchanged: seen by two or more, or background"
"""Meaning of the colours."""
STRIPES = 90
"""Stripes along the larger side of an image."""


def coverage_image(image: np.ndarray, unseen: np.ndarray, once: np.ndarray) -> np.ndarray:
    """Return a render with magenta stripes where no training view saw the surface, and an amber tint where one did.

    Args:
        image: Colours in [0, 1], shape [H, W, 3]; values outside are clamped.
        unseen: True where no training view saw the point, bool, shape [H, W].
        once: True where one training view saw it, bool, shape [H, W].

    Returns:
        Colours in [0, 1], float32, shape [H, W, 3].
    """
    image = np.clip(image, 0, 1).astype(np.float32)
    height, width = unseen.shape
    period = max(4, round(max(height, width) / STRIPES))
    rows, columns = np.mgrid[:height, :width]
    stripe = (rows + columns) % period < period / 2
    shade = np.where(unseen, np.where(stripe, 0.75, 0.3), np.where(once, 0.45, 0)).astype(np.float32)[..., None]
    tint = np.where(unseen[..., None], np.float32(UNSEEN), np.float32(ONCE))
    # gray beneath the tint: the colours of the image would change its hue
    gray = image.mean(-1, keepdims=True)
    return np.where(shade > 0, (1 - shade) * gray + shade * tint, image)
