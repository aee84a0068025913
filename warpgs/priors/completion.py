"""Depth where nothing confirms one: carried over from confirmed pixels, along the surfaces that the picture shows."""

from __future__ import annotations

import numpy as np

from warpgs.priors.opencv import alone

SMOOTHNESS = (1e2, 1e4, 1e6)
"""Strengths tried in turn; a stronger one reaches farther, and a pixel takes the first that reaches it."""
COLOR_SIGMA = 8.0
"""Step of the picture, of 255, at which neighbours stop sharing depth."""
REACHED = 1e-3
"""Share of a smoothed value that must come from confirmed pixels."""


def complete(depth: np.ndarray, valid: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Fill a depth map by edge-aware averages of inverse depth.

    The fast global smoother (Min et al. 2014) of the confirmed inverse depths over that of the mask: planes stay planes in
    inverse depth, and what is far is not pulled near. Measured in docs/decisions/007-coarse-start.md.

    Args:
        depth: z-depths [u], float32, shape [H, W].
        valid: Where they count, bool, shape [H, W].
        image: Colours in [0, 1], shape [H, W, 3].

    Returns:
        Depths [u], float32, shape [H, W]: unchanged where valid, the median where nothing reaches, 0 everywhere where
        nothing is valid.
    """
    import cv2

    if not valid.any():
        return np.zeros(depth.shape, np.float32)
    inverse = np.where(valid, 1 / np.where(valid, depth, 1), 0).astype(np.float32)
    guide = (image * 255).round().clip(0, 255).astype(np.uint8)
    filled = np.full(depth.shape, np.median(inverse[valid]))
    left = np.ones(depth.shape, bool)
    with alone():
        for strength in SMOOTHNESS:
            smoother = cv2.ximgproc.createFastGlobalSmootherFilter(guide, strength, COLOR_SIGMA)
            share = smoother.filter(valid.astype(np.float32))
            reached = left & (share > REACHED)
            filled[reached] = smoother.filter(inverse)[reached] / share[reached]
            left &= ~reached
    low, high = inverse[valid].min(), inverse[valid].max()
    return np.where(valid, depth, 1 / filled.clip(low, high)).astype(np.float32)
