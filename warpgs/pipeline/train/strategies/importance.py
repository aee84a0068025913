"""Importance of the pixels of a training view: the paper's three scores, and their weighted sum.

Paper, section "Multi-Modal Importance Assessment". The paper does not specify the scale of each score, the unit of depth and
the weight of curvature; see docs/decisions/008-method.md for our choices.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from warpgs.errors import UsageError
from warpgs.pipeline.metrics.quantiles import quantiles

PERCENTILES = (0.02, 0.98)
"""Quantiles of a view's score that map to 0 and 1, so that a few extreme pixels do not compress the range of the rest."""
BLUR = 1.0
"""Standard deviation [px] of the blur of residuals and disparities, so that single noisy pixels attract no samples."""


@dataclass(frozen=True)
class ImportanceConfig:
    """Weights of the scores."""

    render: float = 0.4
    """Weight of the rendering residual (paper, w1)."""
    semantic: float = 0.2
    """Weight of the semantic score (paper, w2)."""
    geometry: float = 0.4
    """Weight of the geometric score (paper, w3)."""
    residual: str = "length"
    """Rendering residual: length, the length of the colour difference in the view (the paper); or gain, the estimated decrease
    of the squared error over all training views by a fine Gaussian at the pixel."""
    curvature: float = 0.5
    """Weight of the second derivatives of inverse depth in the geometric score (lambda_curv; the paper gives no value)."""

    def __post_init__(self):
        if self.residual not in ("length", "gain"):
            raise UsageError(f"importance: `residual` {self.residual!r} is not one of length, gain")
        for name in ("render", "semantic", "geometry", "curvature"):
            if not 0 <= getattr(self, name) < math.inf:
                raise UsageError(f"importance: `{name}` must be at least 0 and finite, not {getattr(self, name)}")


def blur(image: torch.Tensor, sigma: float = BLUR) -> torch.Tensor:
    """Blur a map [H, W] by a Gaussian of standard deviation ``sigma`` [px], its border pixels repeated outwards."""
    radius = max(1, round(3 * sigma))
    # on the host, where exponentials of float64 have the same digits on every processor
    offsets = torch.arange(-radius, radius + 1, dtype=torch.float64, device="cpu")
    window = torch.exp(-0.5 * (offsets / sigma) ** 2)
    weights = (window / window.sum()).tolist()
    padded = torch.nn.functional.pad(image[None, None], (radius,) * 4, mode="replicate")[0, 0]
    # shifted sums rather than a convolution, for which CUDA would load a library of its own
    height, width = image.shape
    across, down = torch.zeros_like(padded[:, :width]), torch.zeros_like(image)
    for k, weight in enumerate(weights):
        across = across + weight * padded[:, k : k + width]
    for k, weight in enumerate(weights):
        down = down + weight * across[k : k + height]
    return down


def normalized(score: torch.Tensor, valid: torch.Tensor | None = None) -> torch.Tensor:
    """Scale a score [H, W] so that its 2nd percentile over valid pixels [H, W] is 0 and its 98th 1, clipped; 0 if constant."""
    values = score.flatten() if valid is None else score[valid]
    if len(values) == 0:
        return torch.zeros_like(score)
    low, high = quantiles(values, *PERCENTILES)
    if not high > low:
        return torch.zeros_like(score)
    return ((score - low) / (high - low)).clamp(0, 1)


def _slopes(image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return central differences [1/px] along x and y, one-sided at the border."""
    dy, dx = torch.gradient(image)
    return dx, dy


def geometry_score(disparity: torch.Tensor, curvature: float, valid: torch.Tensor | None = None) -> torch.Tensor:
    """Compute S_geometry: length of the disparity's gradient plus ``curvature`` times the norm of its second derivatives.

    Both are scaled to [0, 1] before they are added, and so is the sum, since relative disparity has no unit.

    Args:
        disparity: Relative inverse depth, shape [H, W].
        curvature: Weight of the second derivatives.
        valid: Pixels that determine the range, bool, shape [H, W]; None for all.

    Returns:
        Score in [0, 1], shape [H, W].
    """
    if min(disparity.shape) < 2:
        return torch.zeros_like(disparity)
    smooth = blur(disparity)
    dx, dy = _slopes(smooth)
    (dxx, dxy), (_, dyy) = _slopes(dx), _slopes(dy)
    bend = (dxx**2 + 2 * dxy**2 + dyy**2).double().sqrt().to(smooth.dtype)
    return normalized(normalized(torch.hypot(dx, dy), valid) + curvature * normalized(bend, valid), valid)


def semantic_score(confidence: torch.Tensor, boundary: torch.Tensor, foreground: torch.Tensor) -> torch.Tensor:
    """Compute S_semantic = F_seg (omega_boundary + omega_foreground), all of shape [H, W], and normalise it to [0, 1]."""
    return normalized(confidence * (boundary + foreground))


def render_score(rendered: torch.Tensor, image: torch.Tensor, valid: torch.Tensor | None = None) -> torch.Tensor:
    """Compute S_render: blurred length of the colour difference of two images [H, W, 3], in [0, 1], shape [H, W]."""
    return normalized(blur((rendered - image).norm(dim=-1)), valid)


def weights(config: ImportanceConfig, *, render: bool, semantic: bool, geometry: bool) -> tuple[float, float, float]:
    """Return the three weights: 0 for missing scores, the others scaled to sum to 1; all 0 without any score."""
    chosen = (config.render * render, config.semantic * semantic, config.geometry * geometry)
    total = sum(chosen)
    return chosen if total == 0 else tuple(w / total for w in chosen)


def importance(scores: tuple[torch.Tensor, torch.Tensor, torch.Tensor], by: tuple[float, float, float]) -> torch.Tensor:
    """Compute S_importance, the sum of the render, semantic and geometric score (each [H, W] in [0, 1]) with weights ``by``.

    If all weights are 0, S_importance is 1 everywhere, so that sampling is uniform.
    """
    if sum(by) == 0:
        return torch.ones_like(scores[0])
    return sum(w * s for w, s in zip(by, scores))
