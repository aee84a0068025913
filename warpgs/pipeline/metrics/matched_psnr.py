"""PSNR of a held-out view after the render's colours are matched to it, for fits with an exposure for each training view."""

from __future__ import annotations

import numpy as np

from warpgs.geometry import inverse, matmul
from warpgs.pipeline.metrics.evaluate import to_8_bit
from warpgs.pipeline.metrics.psnr import psnr
from warpgs.pipeline.metrics.region import scored_region
from warpgs.scene import View

RULE = "over the right half of each view, after an affine colour map fitted to its left half"
"""Definition of the score, as text for the user."""
RIDGE = 1e-6
"""Added to the variances of the colours, so that an image of one colour has a map, too: a deviation of 0.001 of full range."""


def affine_map(rendered: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the least-squares matrix [3, 3] and offset [3] that map rendered colours to target colours, [N, 3] each."""
    a, b = rendered.astype(np.float64), target.astype(np.float64)
    of_a, of_b = a.mean(0), b.mean(0)
    a, b = a - of_a, b - of_b
    matrix = matmul(matmul(b.T, a) / len(a), inverse(matmul(a.T, a) / len(a) + RIDGE * np.eye(3)))
    return matrix, of_b - matmul(matrix, of_a)


def matched_psnr(view: View, image: np.ndarray) -> float:
    """Return the PSNR [dB] of a render [H, W, 3] of a view by `RULE`; NaN if a half has no scored pixel."""
    region, _ = scored_region(view)
    counted = np.ones(view.image.shape[:2], bool) if region is None else region
    left, right = counted.copy(), counted.copy()
    middle = counted.shape[1] // 2
    left[:, middle:], right[:, :middle] = False, False
    if not (left.any() and right.any()):
        return float("nan")
    matrix, offset = affine_map(image[left], view.image[left])
    mapped = matmul(image[right].astype(np.float64), matrix.T) + offset
    return psnr(to_8_bit(mapped), to_8_bit(view.image[right]))
