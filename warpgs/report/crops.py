"""Rectangular crops in which images of one view differ most, to be enlarged."""

from __future__ import annotations

import numpy as np


def disagreement(images: list[np.ndarray], reference: np.ndarray) -> np.ndarray:
    """Return the largest minus the smallest value of images [H, W, 3] at each pixel, averaged over channels, shape [H, W].

    For a single image, return its absolute error against ``reference`` [H, W, 3], averaged over channels.
    """
    if len(images) == 1:
        return np.abs(images[0] - reference).mean(-1)
    stack = np.stack(images)
    return (stack.max(0) - stack.min(0)).mean(-1)


def crops(values: np.ndarray, width: int, height: int, count: int) -> list[tuple[int, int]]:
    """Return the top left corners (x, y) [px] of ``count`` crops with the largest sums of ``values`` [H, W], largest first.

    Crops do not overlap; fewer are returned if no more fit. If all values are 0, the first crop is in the middle.
    """
    H, W = values.shape
    width, height = min(width, W), min(height, H)
    total = np.zeros((H + 1, W + 1))
    total[1:, 1:] = values.astype(np.float64).cumsum(0).cumsum(1)
    sums = total[height:, width:] - total[:-height, width:] - total[height:, :-width] + total[:-height, :-width]
    found: list[tuple[int, int]] = []
    if not sums.max() > 1e-9:
        found.append(((W - width) // 2, (H - height) // 2))
    ys, xs = np.mgrid[: sums.shape[0], : sums.shape[1]]
    while len(found) < count:
        free = np.ones(sums.shape, bool)
        for x, y in found:
            free &= (np.abs(xs - x) >= width) | (np.abs(ys - y) >= height)
        if not free.any():
            break
        at = int(np.argmax(np.where(free, sums, -1.0)))
        found.append((int(xs.flat[at]), int(ys.flat[at])))
    return found
