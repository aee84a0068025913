"""The plane sweep by OpenCV and numpy."""

from collections.abc import Sequence

import cv2
import numpy as np

from warpgs.kernels.sweep import NEUTRAL
from warpgs.priors.sweep import NOISE, gray_of, plane_homography
from warpgs.scene import View

# The matching costs of a plane sweep as OpenCV's warps and blurs give them.


def matching_costs(view: View, others: Sequence[View], inverses: np.ndarray, window: int) -> np.ndarray:
    """Return the disagreement of views at D inverse depths [1/u], in [0, 1], float32, shape [D, H, W]."""
    size, box = (view.camera.width, view.camera.height), (window, window)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    own, *grays = [gray_of(v) for v in (view, *others)]
    mean = cv2.blur(own, box)
    variance = np.maximum(cv2.blur(own * own, box) - mean * mean, 0) + NOISE
    planes = np.empty((len(inverses), *own.shape), np.float32)
    for inverse, total in zip(inverses, planes):
        costs = []
        for other, gray in zip(others, grays):
            H = plane_homography(view.camera, other.camera, inverse)
            warped = cv2.warpPerspective(gray, H, size, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=-1)
            kept = np.ones(gray.shape, np.uint8) if other.mask is None else other.mask.astype(np.uint8)
            votes = cv2.warpPerspective(kept, H, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP) > 0
            m = cv2.blur(warped, box)
            v = np.maximum(cv2.blur(warped * warped, box) - m * m, 0) + NOISE
            cost = 0.5 - 0.5 * (cv2.blur(own * warped, box) - mean * m) / np.sqrt(v * variance)
            costs.append(np.where(votes & (warped >= 0), cost, NEUTRAL))
        total[:] = 0.5 * np.mean(costs, 0) + 0.5 * np.min(costs, 0)
    return planes


# The best plane of each pixel in numpy.


def best_inverse(costs: np.ndarray, inverses: np.ndarray) -> np.ndarray:
    """Return the inverse depth [1/u], shape [H, W], of least cost [H, W, D], refined by the parabola through three costs."""
    k = np.clip(costs.argmin(2), 1, len(inverses) - 2)
    left, middle, right = (np.take_along_axis(costs, (k + o)[..., None], 2)[..., 0].astype(float) for o in (-1, 0, 1))
    bend = left - 2 * middle + right
    offset = np.where(bend > 1e-9, 0.5 * (left - right) / np.maximum(bend, 1e-9), 0).clip(-1, 1)
    return inverses[0] + (k + offset) * (inverses[1] - inverses[0])


# The path costs of semi-global matching as they are defined, pixel by pixel.


def scanline_costs(costs: np.ndarray, down: np.ndarray, across: np.ndarray, small: int) -> np.ndarray:
    """Sum over the four directions, int, shape [H, W, D]; arguments as of the kernel's function."""
    height, width, planes = costs.shape
    total = np.zeros(costs.shape, int)
    for dy, dx in ((0, 1), (0, -1), (1, 0), (-1, 0)):
        path = np.zeros(costs.shape, int)
        for y in range(height)[:: 1 if dy >= 0 else -1]:
            for x in range(width)[:: 1 if dx >= 0 else -1]:
                path[y, x] = costs[y, x]
                py, px = y - dy, x - dx
                if 0 <= py < height and 0 <= px < width:
                    before = path[py, px]
                    limit = down[min(y, py), x] if dy else across[y, min(x, px)]
                    for d in range(planes):
                        options = [before[d], before.min() + limit]
                        options += [before[k] + small for k in (d - 1, d + 1) if 0 <= k < planes]
                        path[y, x, d] += min(options) - before.min()
        total += path
    return total
