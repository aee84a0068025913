"""Sampling of pixels for fine Gaussians, and their initial values (paper, section "Geometric-Aware Sampling")."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from warpgs.colors import base_coefficients
from warpgs.errors import UsageError
from warpgs.geometry import back_project_tensors, logit
from warpgs.pipeline.metrics.quantiles import quantiles
from warpgs.scene import Camera

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
