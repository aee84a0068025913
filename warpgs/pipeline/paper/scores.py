"""The paper's importance of pixels: three scores, their sum, and the gate (Multi-Modal Importance Assessment)."""

from collections.abc import Sequence

import torch

from warpgs.geometry import back_project_tensors, project_tensors
from warpgs.pipeline.metrics.scores import quantiles
from warpgs.pipeline.train.views import TrainingView
from warpgs.scene import Camera

# The paper does not specify the scale of each score, the unit of depth and the weight of curvature; see
# docs/decisions/008-method.md for our choices.

WEIGHTS = 0.4, 0.2, 0.4
"""Weights w1, w2, w3 of the rendering residual, the semantic and the geometric score."""
CURVATURE = 0.5
"""Weight of the second derivatives of inverse depth in the geometric score (lambda_curv; the paper gives no value)."""
PERCENTILES = (0.02, 0.98)
"""Quantiles of a view's score that map to 0 and 1, so that a few extreme pixels do not compress the range of the rest."""
BLUR = 1.0
"""Standard deviation [px] of the blur of residuals and disparities, so that single noisy pixels attract no samples."""


def blur(image: torch.Tensor, sigma: float = BLUR) -> torch.Tensor:
    """Blur a map [H, W] by a Gaussian of standard deviation ``sigma`` [px], its border pixels repeated outwards."""
    radius = max(1, round(3 * sigma))
    # on the host, where exponentials of float64 have the same digits on every processor
    window = torch.exp(-0.5 * (torch.arange(-radius, radius + 1, dtype=torch.float64, device="cpu") / sigma) ** 2)
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
    low, high = quantiles(values, *PERCENTILES) if len(values) else (0, 0)
    return ((score - low) / (high - low)).clamp(0, 1) if high > low else torch.zeros_like(score)


def geometry_score(disparity: torch.Tensor, valid: torch.Tensor | None = None) -> torch.Tensor:
    """Compute S_geometry: length of the disparity's gradient plus `CURVATURE` times the norm of its second derivatives.

    Both are scaled to [0, 1] over valid pixels [H, W] before they are added, and so is the sum, since relative disparity [H, W]
    has no unit.
    """
    if min(disparity.shape) < 2:
        return torch.zeros_like(disparity)
    smooth = blur(disparity)
    dy, dx = torch.gradient(smooth)  # central differences [1/px], one-sided at the border
    (dxy, dxx), (dyy, _) = torch.gradient(dx), torch.gradient(dy)
    bend = (dxx**2 + 2 * dxy**2 + dyy**2).double().sqrt().to(smooth.dtype)
    return normalized(normalized(torch.hypot(dx, dy), valid) + CURVATURE * normalized(bend, valid), valid)


def semantic_score(confidence: torch.Tensor, boundary: torch.Tensor, foreground: torch.Tensor) -> torch.Tensor:
    """Compute S_semantic = F_seg (omega_boundary + omega_foreground), all of shape [H, W], and normalise it to [0, 1]."""
    return normalized(confidence * (boundary + foreground))


def render_score(rendered: torch.Tensor, image: torch.Tensor, valid: torch.Tensor | None = None) -> torch.Tensor:
    """Compute S_render: blurred length of the colour difference of two images [H, W, 3], in [0, 1], shape [H, W]."""
    return normalized(blur((rendered - image).norm(dim=-1)), valid)


def weights(render: bool, semantic: bool, geometry: bool) -> tuple[float, float, float]:
    """Return the three weights: 0 for missing scores, the others scaled to sum to 1; all 0 without any score."""
    chosen = tuple(w * on for w, on in zip(WEIGHTS, (render, semantic, geometry)))
    total = sum(chosen)
    return chosen if total == 0 else tuple(w / total for w in chosen)


def importance(scores: tuple[torch.Tensor, torch.Tensor, torch.Tensor], by: tuple[float, float, float]) -> torch.Tensor:
    """Compute S_importance, the sum of the render, semantic and geometric score (each [H, W] in [0, 1]) with weights ``by``.

    If all weights are 0, S_importance is 1 everywhere, so that sampling is uniform.
    """
    return sum(w * s for w, s in zip(by, scores)) if sum(by) else torch.ones_like(scores[0])


EVERY = 2
"""Distance between pixels for which gains are computed [px]; pixels in between repeat these gains, since footprints are wider
than this distance."""
HIDDEN = 1.05
"""A point is hidden in a view if its depth exceeds the rendered depth by this factor."""


Residual = tuple[Camera, torch.Tensor, torch.Tensor]
"""Camera of a view with tensors; I - C (three channels) and (I - C) . C of image I and render C, blurred by the footprint of a
Gaussian, shape [H, W, 4]; and rendered z-depth [u], shape [H, W]."""


def residual_of(view: TrainingView, rgb: torch.Tensor, depth: torch.Tensor, footprint: float) -> Residual:
    """Return the residual of a view's render, 0 at masked and transparent pixels, for a footprint [px]."""
    residual = view.image - rgb
    if view.countable is not None:
        residual = residual * view.countable[..., None]
    channels = (*residual.unbind(-1), (residual * rgb).sum(-1))
    return view.camera, torch.stack([blur(c.contiguous(), footprint) for c in channels], -1), depth


def gains(points: torch.Tensor, colors: torch.Tensor, residuals: Sequence[Residual]) -> torch.Tensor:
    """Return the gain of Gaussians: half the slope at which their opacity lowers the squared error of all views, shape [S].

    A Gaussian of colour c, opacity o and footprint w in front of a colour C changes C to C + o w (c - C). The squared error to
    the image I falls by 2 o sum w (I - C) . (c - C) to first order. The sum is c times the blurred residual, minus the blurred
    (I - C) . C. The gain adds the sums of all views in which the point is not hidden.
    """
    total = torch.zeros_like(points[:, 0])
    for camera, blurred, depth in residuals:
        pixels, away = project_tensors(camera, points)
        size = torch.tensor([camera.width, camera.height], dtype=torch.int64, device="cpu").to(pixels)
        inside = (away > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)
        columns, rows = torch.where(inside[:, None], pixels, 0).long().unbind(1)
        seen = inside & (away < HIDDEN * depth[rows, columns])
        here = blurred[rows, columns]
        total = total + torch.where(seen, (colors * here[:, :3]).sum(1) - here[:, 3], 0)
    return total


def gain_map(view: TrainingView, depth: torch.Tensor, valid: torch.Tensor, residuals: Sequence[Residual]) -> torch.Tensor:
    """Return the gain of a Gaussian behind each valid pixel, in the pixel's colour, negative gains as 0, shape [H, W]."""
    at = torch.nonzero(valid[::EVERY, ::EVERY])
    rows, columns = (EVERY * at).unbind(1)
    points = back_project_tensors(view.camera, torch.stack([columns, rows], 1).to(depth.dtype) + 0.5, depth[rows, columns])
    coarse = torch.zeros_like(depth[::EVERY, ::EVERY])
    coarse[at[:, 0], at[:, 1]] = gains(points, view.image[rows, columns], residuals).clamp_min(0)
    height, width = depth.shape
    return coarse.repeat_interleave(EVERY, 0).repeat_interleave(EVERY, 1)[:height, :width]


SUPPORT = 4
"""Fewest pixels that must pass a gate, as a multiple of those to be sampled; with fewer, the gate's quantile is lowered."""


def geometry_gate(geometry: torch.Tensor, valid: torch.Tensor, quantile: float, wanted: int) -> tuple[torch.Tensor, float]:
    """Return M_reliable, the valid pixels with S_geometry [H, W] above a quantile (tau_geometry), and the quantile used.

    The gate is widened until `SUPPORT` times the ``wanted`` number of pixels, or all valid ones, pass.
    """
    values = geometry[valid]
    while quantile > 0 and len(values) > 0:
        gate = valid & (geometry > quantiles(values, quantile)[0])
        if int(gate.sum()) >= SUPPORT * wanted:
            return gate, quantile
        quantile = quantile - 0.2 if quantile > 0.2 else 0.0
    return valid, 0.0
