"""Gaussians as browsers render them: covariances in half precision, and one colour each."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from warpgs.colors import base_colors
from warpgs.geometry import rotation_matrices
from warpgs.scene import Gaussians

LARGEST_HALF = 65504.0
"""Largest finite number in half precision."""
MEDIAN_AXIS = 1.0
"""Length of the median Gaussian's longest axis in the units of stored covariances. Squares of axes are exact to 0.05 % if they
are at least 6.1e-5, the smallest normal number: for axes from 1/128 of the median to 255 times the median."""


@dataclass(frozen=True)
class Packed:
    """N Gaussians of one colour each, in their own units; one such unit is ``scale`` scene units."""

    centers: np.ndarray
    """Positions in stored units, float32, shape [N, 3]."""
    covariances: np.ndarray
    """Covariances in squared stored units, float32 within half precision, shape [N, 3, 3]."""
    colors: np.ndarray
    """Colours of degree 0, uint8, shape [N, 3]."""
    opacities: np.ndarray
    """Opacities, uint8, shape [N, 1]."""
    scale: float
    """Scene units [u] per stored unit."""
    shortened: int
    """Number of Gaussians that are too long for half precision, and are shown shorter."""


def packed(gaussians: Gaussians) -> Packed:
    """Return Gaussians for the browser.

    Half precision is too coarse for covariances in scene units: an axis of 0.001 u has the square 1e-6, of which four bits
    remain; the square of an axis below 0.00017 u becomes 0. In units in which the median of the longest axes is 1, nearly all
    squares keep eleven bits.

    Args:
        gaussians: N Gaussians, on any device.
    """
    means, quats, log_scales, logits, sh = (t.detach().cpu().double().numpy() for t in gaussians.tensors().values())
    median = float(np.median(log_scales.max(1))) if len(means) else 0.0
    scale = math.exp(median) / MEDIAN_AXIS
    longest = 0.5 * math.log(LARGEST_HALF) - 1e-3  # the diagonal of a rotated covariance is no longer than its longest axis
    relative = log_scales - math.log(scale)
    axes = np.exp(np.minimum(relative, longest))
    rotations = rotation_matrices(quats / np.linalg.norm(quats, axis=1, keepdims=True))
    covariances = np.einsum("nij,nj,nkj->nik", rotations, axes**2, rotations)
    colors = np.clip(base_colors(sh), 0, 1)
    opacities = torch.sigmoid(torch.from_numpy(logits)).numpy()[:, None]
    return Packed(
        (means / scale).astype(np.float32), covariances.astype(np.float32), _bytes(colors), _bytes(opacities), scale,
        int((relative > longest).any(1).sum()),
    )  # fmt: skip


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.round(255 * values).astype(np.uint8)
