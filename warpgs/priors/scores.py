"""The two importance scores of a view that follow from its prior alone (paper, Multi-Modal Importance Assessment)."""

from __future__ import annotations

import numpy as np

from warpgs.scene import Prior

LOW, HIGH = 2, 98
"""Percentiles of a view that become 0 and 1."""
BLUR = 1.0
"""Standard deviation of the blur [px] before second derivatives."""


def normalized(score: np.ndarray) -> np.ndarray:
    """A score [H, W] scaled per view, its 2nd percentile to 0 and its 98th to 1, and clipped; 0 where both are equal."""
    low, high = np.percentile(score, [LOW, HIGH])
    if not high > low:
        # a map that is flat but for a few pixels, such as one thin edge
        low, high = float(score.min()), float(score.max())
    if not high > low:
        return np.zeros(score.shape, np.float32)
    return np.clip((score - low) / (high - low), 0, 1).astype(np.float32)


def semantic_score(prior: Prior) -> np.ndarray:
    """S_semantic = F_seg (omega_boundary + omega_foreground), float32, shape [H, W], in [0, 2]; not normalised."""
    return prior.confidence * (prior.boundary + prior.foreground)


def curvature(disparity: np.ndarray) -> np.ndarray:
    """kappa: Frobenius norm of the Hessian [1/px^2] of a map [H, W] blurred by 1 px, float32."""
    import cv2

    smooth = cv2.GaussianBlur(np.ascontiguousarray(disparity, np.float32), (0, 0), BLUR, borderType=cv2.BORDER_REPLICATE)
    dy, dx = np.gradient(smooth)
    (dyy, dyx), (dxy, dxx) = np.gradient(dy), np.gradient(dx)
    return np.sqrt(dxx**2 + dxy**2 + dyx**2 + dyy**2)


def geometric_score(disparity: np.ndarray, curvature_weight: float = 0.5) -> np.ndarray:
    """S_geometry = |grad D| + lambda_curv kappa of a disparity map [H, W], float32, in [0, 1 + lambda_curv].

    Both terms are normalised to [0, 1] first, so that noise of second order does not rule; their sum is not.
    """
    gradient = np.hypot(*np.gradient(disparity.astype(np.float32)))
    return normalized(gradient) + np.float32(curvature_weight) * normalized(curvature(disparity))
