"""The matching costs of a plane sweep as OpenCV's warps and blurs give them."""

from collections.abc import Sequence

import cv2
import numpy as np

from warpgs.kernels.sweep import NEUTRAL
from warpgs.priors.sweep import NOISE, gray_of, plane_homography
from warpgs.scene import View


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
            m = cv2.blur(warped, box)
            v = np.maximum(cv2.blur(warped * warped, box) - m * m, 0) + NOISE
            cost = 0.5 - 0.5 * (cv2.blur(own * warped, box) - mean * m) / np.sqrt(v * variance)
            costs.append(np.where(warped >= 0, cost, NEUTRAL))
        total[:] = 0.5 * np.mean(costs, 0) + 0.5 * np.min(costs, 0)
    return planes
