"""Which pixels get a fine Gaussian, and where in space it is put (paper, section "Geometric-Aware Sampling")."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from warpgs.errors import UsageError
from warpgs.kernels.sh import C0
from warpgs.pipeline.metrics.quantiles import quantiles
from warpgs.scene import Camera

SUPPORT = 4
"""A gate leaves at least this many times as many pixels as are drawn; else its quantile is lowered."""


@dataclass(frozen=True)
class SamplerConfig:
    """How fine Gaussians are placed at one event."""

    depth: str = "rendered"
    """Depth that Gaussians are placed at: rendered (the paper), or confirmed: that of the start where other views confirm it.
    With it, a pixel is reliable only where its depth is confirmed, if any of its view's is."""
    fraction: float = 0.005
    """Gaussians per event and view, as a share of the view's pixels."""
    gate_quantile: float = 0.6
    """A pixel is reliable where its geometric score is above this quantile of its view's (tau_geometry)."""
    min_alpha: float = 0.5
    """Pixels whose rendered opacity is below this have no depth to place anything at."""
    border: int = 2
    """Pixels nearer than this to the image border are never drawn [px]."""
    opacity: float = 0.1
    """First opacity of a fine Gaussian, in (0, 1)."""
    footprint: float = 1.0
    """First standard deviation of a fine Gaussian [px], in the view that placed it."""
    max_fraction: float = 0.5
    """Most fine Gaussians, as a share of the coarse ones."""

    def __post_init__(self):
        if self.depth not in ("rendered", "consistent"):
            raise UsageError(f"sampler depth {self.depth!r} is not one of rendered, confirmed")
        if not 0 < self.fraction <= 1 or not 0 <= self.gate_quantile < 1 or not 0 <= self.min_alpha < 1:
            raise UsageError("sampler: share must lie in (0, 1], gate quantile and min alpha in [0, 1)")
        if (
            not 0 < self.opacity < 1
            or not 0 < self.footprint < math.inf
            or self.border < 0
            or not 0 <= self.max_fraction < math.inf
        ):
            raise UsageError("sampler: opacity must lie in (0, 1), footprint above 0, border and max share at 0 or above")


def valid_pixels(alpha: torch.Tensor, depth: torch.Tensor, mask: torch.Tensor | None, config: SamplerConfig) -> torch.Tensor:
    """Pixels where something is drawn at a finite depth, away from the border and not masked out; all [H, W]."""
    valid = (alpha > config.min_alpha) & torch.isfinite(depth) & (depth > 0)
    if mask is not None:
        valid &= mask > 0
    inner = torch.zeros_like(valid)
    b = config.border
    inner[b : valid.shape[0] - b, b : valid.shape[1] - b] = True
    return valid & inner


def geometry_gate(geometry: torch.Tensor, valid: torch.Tensor, quantile: float, wanted: int) -> tuple[torch.Tensor, float]:
    """M_reliable: valid pixels whose geometric score is above its quantile over the valid ones.

    Args:
        geometry: S_geometry, shape [H, W].
        valid: Pixels that may be drawn at all, shape [H, W].
        quantile: tau_geometry as a quantile, in [0, 1).
        wanted: Number of pixels to be drawn; the gate is widened until 4 times as many pass, or all valid ones.

    Returns:
        The gate [H, W], and the quantile that was used; a score that is constant has no quantile, so all valid pixels pass.
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
    """Draw pixels within a gate without replacement, with probability proportional to a score (P_sample).

    The draw is that of successive sampling: the ``count`` smallest of E_i / score_i with exponential E_i (Efraimidis and
    Spirakis 2006).

    Args:
        score: S_importance, at least 0, shape [H, W].
        gate: Pixels that may be drawn, shape [H, W].
        count: Number of pixels.
        generator: CPU generator; the same numbers on every device.
        random: False takes the highest scores instead (the ablation without adaptive placement).

    Returns:
        Rows and columns, int64, shape [S, 2] with S = count or the number of gated pixels with a positive score.
    """
    allowed = gate & (score > 0)
    count = min(count, int(allowed.sum()))
    if random:
        uniform = torch.rand(score.shape, dtype=torch.float64, generator=generator).to(score.device)
        key = score.double() / -torch.log1p(-uniform)
    else:
        key = score.double()
    key = torch.where(allowed, key, -1.0)
    chosen = torch.topk(key.flatten(), count).indices.sort().values
    return torch.stack([chosen // score.shape[1], chosen % score.shape[1]], 1)


def back_project(camera: Camera, pixels: torch.Tensor, depths: torch.Tensor) -> torch.Tensor:
    """World points [S, 3] behind pixel positions [S, 2] (x, y; centres at +0.5) at z-depths [S] [u]: R^T (d K^-1 [x y 1] - t).

    The camera's tensors are float32 or float64 on the device of the others. Of K the focal lengths and the centre count, as in
    projection.
    """
    K, viewmat = camera.K, camera.viewmat
    x, y = ((pixels[:, i] - K[i, 2]) / K[i, i] * depths for i in range(2))
    moved = torch.stack([x, y, depths], 1) - viewmat[:3, 3]
    return (moved[:, :, None] * viewmat[:3, :3]).sum(1)  # a product of matrices would load another library on CUDA


def fine_gaussians(
    camera: Camera, image: torch.Tensor, depth: torch.Tensor, at: torch.Tensor, config: SamplerConfig, coefficients: int
) -> dict[str, torch.Tensor]:
    """Isotropic Gaussians behind pixels, as wide as a pixel there, in the photo's colours.

    Args:
        camera: Of the view, tensors.
        image: Its photograph, shape [H, W, 3].
        depth: Rendered z-depth [u], shape [H, W].
        at: Rows and columns, shape [S, 2].
        config: Opacity and footprint.
        coefficients: Spherical-harmonics coefficients a channel.

    Returns:
        Rows of the five tensors of `Gaussians`.
    """
    rows, columns = at.unbind(1)
    depths = depth[rows, columns]
    means = back_project(camera, torch.stack([columns, rows], 1).to(depth.dtype) + 0.5, depths)
    count = len(means)
    focal = 0.5 * (camera.K[0, 0] + camera.K[1, 1])
    sh = means.new_zeros(count, coefficients, 3)
    sh[:, 0] = (image[rows, columns] - 0.5) / C0
    quats = means.new_zeros(count, 4)
    quats[:, 0] = 1
    return {
        "means": means,
        "quats": quats,
        "log_scales": (math.log(config.footprint) + (depths / focal).double().log()).to(depths.dtype)[:, None].repeat(1, 3),
        "logit_opacities": torch.full_like(depths, math.log(config.opacity / (1 - config.opacity))),
        "sh": sh,
    }
