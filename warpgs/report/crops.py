"""Where pictures of one view differ most: the places worth enlarging."""

from __future__ import annotations

import numpy as np


def disagreement(images: list[np.ndarray], truth: np.ndarray) -> np.ndarray:
    """How far apart pictures [H, W, 3] are at each pixel, [H, W]: largest minus smallest value, mean over channels.

    Of a single picture its absolute error to ``truth``.
    """
    if len(images) == 1:
        return np.abs(images[0] - truth).mean(-1)
    stack = np.stack(images)
    return (stack.max(0) - stack.min(0)).mean(-1)


def crops(values: np.ndarray, width: int, height: int, count: int) -> list[tuple[int, int]]:
    """Corners (x, y) [px] of the ``count`` windows with the largest sums of ``values`` [H, W], most first.

    Windows share no pixel; fewer come back where no more fit. Where nothing differs the first lies in the middle.
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
