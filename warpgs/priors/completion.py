"""Completion of a depth map from its consistent pixels, along the surfaces that the image shows."""

from __future__ import annotations

import numpy as np

from warpgs.priors.opencv import single_threaded_opencv

SMOOTHNESS = (1e2, 1e4, 1e6)
"""Strengths of the smoother, in order. A stronger smoother reaches farther; each pixel uses the first that reaches it."""
COLOR_SIGMA = 8.0
"""Colour difference [1/255] at which the weight between neighbours falls to 1/e."""
MIN_FRACTION = 1e-3
"""Smallest fraction of a smoothed value that must come from consistent pixels."""


def complete(depth: np.ndarray, valid: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Fill a depth map by edge-aware averages of inverse depth.

    The result is a ratio: smoothed inverse depths of consistent pixels, divided by the smoothed mask. The smoother is that of
    Min et al. 2014. Planes stay planes in inverse depth, and far surfaces are not pulled near. Measured in
    docs/decisions/007-coarse-start.md.

    Args:
        depth: z-depths [u], float32, shape [H, W].
        valid: True where the depth is consistent, bool, shape [H, W].
        image: Colours in [0, 1], shape [H, W, 3].

    Returns:
        z-depths [u], float32, shape [H, W]: unchanged where valid, the median where no consistent pixel reaches; 0 everywhere
        if no pixel is valid.
    """
    import cv2

    if not valid.any():
        return np.zeros(depth.shape, np.float32)
    inverse = np.where(valid, 1 / np.where(valid, depth, 1), 0).astype(np.float32)
    guide = (image * 255).round().clip(0, 255).astype(np.uint8)
    filled = np.full(depth.shape, np.median(inverse[valid]))
    left = np.ones(depth.shape, bool)
    with single_threaded_opencv():
        for strength in SMOOTHNESS:
            smoother = cv2.ximgproc.createFastGlobalSmootherFilter(guide, strength, COLOR_SIGMA)
            fraction = smoother.filter(valid.astype(np.float32))
            filled_now = left & (fraction > MIN_FRACTION)
            filled[filled_now] = smoother.filter(inverse)[filled_now] / fraction[filled_now]
            left &= ~filled_now
    low, high = inverse[valid].min(), inverse[valid].max()
    return np.where(valid, depth, 1 / filled.clip(low, high)).astype(np.float32)
