"""Importance of pixels, and the Gaussians sampled by it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch

from warpgs.errors import UsageError
from warpgs.geometry import back_project_tensors, logit, project_tensors
from warpgs.pipeline.metrics.scores import quantiles
from warpgs.pipeline.train.views import TrainingView
from warpgs.scene import Camera, base_coefficients

# Importance of the pixels of a training view: the paper's three scores, and their weighted sum.
#
# Paper, section "Multi-Modal Importance Assessment". The paper does not specify the scale of each score, the unit of
# depth and the weight of curvature; see docs/decisions/008-method.md for our choices.

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


EVERY = 2
"""Distance between pixels for which gains are computed [px]; pixels in between repeat these gains, since footprints are wider
than this distance."""
HIDDEN = 1.05
"""A point is hidden in a view if its depth exceeds the rendered depth by this factor."""


class Residual(NamedTuple):
    """Residual of one view, averaged over the footprint of a Gaussian."""

    camera: Camera
    """Camera of the view, tensors."""
    blurred: torch.Tensor
    """I - C (three channels) and (I - C) . C of image I and render C, blurred by the footprint, shape [H, W, 4]."""
    depth: torch.Tensor
    """Rendered z-depth [u], shape [H, W]."""


def residual_of(view: TrainingView, rgb: torch.Tensor, depth: torch.Tensor, footprint: float) -> Residual:
    """Return the residual of a view; it is 0 at masked and transparent pixels.

    Args:
        view: The view.
        rgb: Rendered colours after the view modules of the fit, shape [H, W, 3].
        depth: Rendered depth [u], shape [H, W].
        footprint: Standard deviation of a Gaussian in the image [px].
    """
    residual = view.image - rgb
    if view.countable is not None:
        residual = residual * view.countable[..., None]
    channels = (*residual.unbind(-1), (residual * rgb).sum(-1))
    return Residual(view.camera, torch.stack([blur(c.contiguous(), footprint) for c in channels], -1), depth)


def gains(points: torch.Tensor, colors: torch.Tensor, residuals: Sequence[Residual]) -> torch.Tensor:
    """Return the gain of Gaussians: half the slope at which their opacity lowers the squared error of all views, shape [S].

    A Gaussian of colour c, opacity o and footprint w in front of a colour C changes C to C + o w (c - C). The squared error to
    the image I falls by 2 o sum w (I - C) . (c - C) to first order. The sum is c times the blurred residual, minus the blurred
    (I - C) . C. The gain adds the sums of all views in which the point is not hidden.

    Args:
        points: World points [u], shape [S, 3].
        colors: Their colours, shape [S, 3].
        residuals: Residual of each view.
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
    """Return the gain of a Gaussian behind each pixel, in the pixel's colour, negative gains as 0, shape [H, W].

    Args:
        view: The view with the pixels.
        depth: Depth that Gaussians are placed at [u], shape [H, W].
        valid: Pixels with a depth, bool, shape [H, W].
        residuals: Residual of each view.
    """
    at = torch.nonzero(valid[::EVERY, ::EVERY])
    rows, columns = (EVERY * at).unbind(1)
    points = back_project_tensors(view.camera, torch.stack([columns, rows], 1).to(depth.dtype) + 0.5, depth[rows, columns])
    coarse = torch.zeros_like(depth[::EVERY, ::EVERY])
    coarse[at[:, 0], at[:, 1]] = gains(points, view.image[rows, columns], residuals).clamp_min(0)
    height, width = depth.shape
    return coarse.repeat_interleave(EVERY, 0).repeat_interleave(EVERY, 1)[:height, :width]


SUPPORT = 4
"""Fewest pixels that must pass a gate, as a multiple of those to be sampled; with fewer, the gate's quantile is lowered."""


@dataclass(frozen=True)
class SamplerConfig:
    """Placement of fine Gaussians at one event."""

    depth: str = "rendered"
    """Depth of new Gaussians: rendered (the paper), or consistent, the initial depth that other views confirm. With consistent,
    and with the reliability gate on, views with consistent depth are sampled only where it exists."""
    fraction: float = 0.005
    """Gaussians per event and view, as a fraction of the view's pixels."""
    gate_quantile: float = 0.6
    """Quantile of a view's geometric score above which a pixel is reliable, in [0, 1) (tau_geometry); 0 to disable."""
    min_alpha: float = 0.5
    """Smallest rendered opacity of a pixel that may receive a Gaussian, in [0, 1)."""
    border: int = 2
    """Width of the image border in which no pixel is sampled [px]."""
    opacity: float = 0.1
    """Initial opacity of a fine Gaussian, in (0, 1)."""
    footprint: float = 1.0
    """Initial standard deviation of a fine Gaussian [px], in the view of its pixel."""
    max_fraction: float = 0.5
    """Largest number of fine Gaussians, as a fraction of the coarse ones."""

    def __post_init__(self):
        if self.depth not in ("rendered", "consistent"):
            raise UsageError(f"sampler: `depth` {self.depth!r} is not one of rendered, consistent")
        if not 0 < self.fraction <= 1 or not 0 <= self.gate_quantile < 1 or not 0 <= self.min_alpha < 1:
            raise UsageError(
                "sampler: `fraction` must be in (0, 1], `gate-quantile` and `min-alpha` in [0, 1), not "
                f"{self.fraction}, {self.gate_quantile} and {self.min_alpha}"
            )
        if (
            not 0 < self.opacity < 1
            or not 0 < self.footprint < math.inf
            or self.border < 0
            or not 0 <= self.max_fraction < math.inf
        ):
            raise UsageError(
                "sampler: `opacity` must be in (0, 1), `footprint` above 0, `border` and `max-fraction` at least 0, not "
                f"{self.opacity}, {self.footprint}, {self.border} and {self.max_fraction}"
            )


def valid_pixels(alpha: torch.Tensor, depth: torch.Tensor, mask: torch.Tensor | None, config: SamplerConfig) -> torch.Tensor:
    """Return the unmasked pixels with enough opacity and positive, finite depth, away from the border; all maps are [H, W]."""
    valid = (alpha > config.min_alpha) & torch.isfinite(depth) & (depth > 0)
    if mask is not None:
        valid &= mask > 0
    inner = torch.zeros_like(valid)
    b = config.border
    inner[b : valid.shape[0] - b, b : valid.shape[1] - b] = True
    return valid & inner


def geometry_gate(geometry: torch.Tensor, valid: torch.Tensor, quantile: float, wanted: int) -> tuple[torch.Tensor, float]:
    """Return M_reliable, the valid pixels with a geometric score above a quantile over valid pixels, and the quantile used.

    Args:
        geometry: S_geometry, shape [H, W].
        valid: Pixels that may be sampled at all, bool, shape [H, W].
        quantile: tau_geometry as a quantile, in [0, 1).
        wanted: Number of pixels to be sampled; the gate is widened until `SUPPORT` times this number, or all valid pixels,
            pass.

    Returns:
        The gate, bool, shape [H, W], and the quantile that was used; if the score is constant, all valid pixels pass.
    """
    values = geometry[valid]
    while quantile > 0 and len(values) > 0:
        gate = valid & (geometry > quantiles(values, quantile)[0])
        if int(gate.sum()) >= SUPPORT * wanted:
            return gate, quantile
        quantile = quantile - 0.2 if quantile > 0.2 else 0.0
    return valid, 0.0


def sample_pixels(
    score: torch.Tensor, gate: torch.Tensor, count: int, generator: torch.Generator, *, random: bool
) -> torch.Tensor:
    """Sample pixels within a gate without replacement, with probability proportional to a score (P_sample).

    Successive sampling: the ``count`` smallest of E_i / score_i with exponential E_i (Efraimidis and Spirakis 2006).

    Args:
        score: S_importance, at least 0, shape [H, W].
        gate: Pixels that may be sampled, bool, shape [H, W].
        count: Number of pixels.
        generator: CPU generator, the same numbers on every device.
        random: False takes the highest scores instead (the ablation without adaptive placement).

    Returns:
        Rows and columns, int64, shape [S, 2] with S = count or the number of gated pixels with a positive score.
    """
    allowed = gate & (score > 0)
    count = min(count, int(allowed.sum()))
    if random:
        uniform = torch.rand(score.shape, dtype=torch.float64, generator=generator, device="cpu").to(score.device)
        key = score.double() / -torch.log1p(-uniform)
    else:
        key = score.double()
    key = torch.where(allowed, key, -1.0)
    chosen = torch.topk(key.flatten(), count).indices.sort().values
    return torch.stack([chosen // score.shape[1], chosen % score.shape[1]], 1)


def fine_gaussians(
    camera: Camera, image: torch.Tensor, depth: torch.Tensor, at: torch.Tensor, config: SamplerConfig, coefficients: int
) -> dict[str, torch.Tensor]:
    """Return isotropic Gaussians behind pixels, ``config.footprint`` pixels wide there, in the colours of the image.

    Args:
        camera: Camera of the view, tensors.
        image: Colours in [0, 1], shape [H, W, 3].
        depth: z-depth [u], shape [H, W].
        at: Rows and columns, shape [S, 2].
        config: Opacity and footprint.
        coefficients: Spherical-harmonics coefficients per channel.

    Returns:
        Rows of the five tensors of `Gaussians`, shape [S, ...] each.

    Raises:
        UsageError: The camera model is only supported by the kernels.
    """
    rows, columns = at.unbind(1)
    depths = depth[rows, columns]
    means = back_project_tensors(camera, torch.stack([columns, rows], 1).to(depth.dtype) + 0.5, depths)
    count = len(means)
    focal = 0.5 * (camera.K[0, 0] + camera.K[1, 1])
    sh = means.new_zeros(count, coefficients, 3)
    sh[:, 0] = base_coefficients(image[rows, columns])
    quats = means.new_zeros(count, 4)
    quats[:, 0] = 1
    return {
        "means": means,
        "quats": quats,
        "log_scales": (math.log(config.footprint) + (depths / focal).double().log()).to(depths.dtype)[:, None].repeat(1, 3),
        "logit_opacities": torch.full_like(depths, logit(config.opacity)),
        "sh": sh,
    }
