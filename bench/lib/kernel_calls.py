"""Kernels called with single tensors and numbers, as tests and benchmarks call them."""

from __future__ import annotations

import torch

from warpgs.constants import Rule
from warpgs.kernels import blend as blending, sh, tiles, walk
from warpgs.kernels.ellipse import ProjectInputs, checked_factors
from warpgs.kernels.falloff import Pass
from warpgs.kernels.project import project_inputs
from warpgs.kernels.update import BETAS, EPS, adam_scheduled, scheduled_lrs, update_rows


def _pass(width: int, height: int, rule: Rule, origin: tuple[int, int] = (0, 0), **others) -> Pass:
    """Return the settings of a window at ``origin`` [px]."""
    return Pass((width, height), (*origin, width, height), rule, **others)


def bin_tiles(projected, tile_counts, *, memory=tiles.AS_NEEDED, slotted=True, listed=None, **window) -> tiles.Tiles:
    """Return the result of `tiles.bin_tiles` for a window of some size, rule, origin and size of tiles."""
    return tiles.bin_tiles(projected, tile_counts, _pass(**window), memory, slotted, listed)


def blend(projected, made, backgrounds, **window):
    """Return the result of `blend.blend` for a window."""
    return blending.blend(projected, made, backgrounds, _pass(**window))


def blend_channels(projected, made, colors, backgrounds, **window):
    """Return the result of `blend.blend` with other colours for a window."""
    return blending.blend(projected, made, backgrounds, _pass(**window), colors)


def median_depth(projected, made, **window):
    """Return the result of `walk.median_depth` for a window."""
    return walk.median_depth(projected, made, _pass(**window))


def heaviest(projected, made, k, **window):
    """Return the result of `walk.heaviest` for a window."""
    return walk.heaviest(projected, made, k, _pass(**window))


def contributions(projected, made, **window):
    """Return the result of `walk.contributions` for a window."""
    return walk.contributions(projected, made, _pass(**window))


def project(
    means: torch.Tensor,
    quats: torch.Tensor,
    log_scales: torch.Tensor,
    logit_opacities: torch.Tensor,
    sh_coefficients: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    *,
    width: int,
    height: int,
    degree: int,
    rule: Rule,
    tile_size: int = 16,
    opacity_factors: torch.Tensor | None = None,
    window: tuple[int, int, int, int] | None = None,
    camera_model: str = "pinhole",
    distortion: torch.Tensor | None = None,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the result of `project_inputs` for single tensors."""
    if distortion is None:
        distortion = viewmats.new_empty(len(viewmats), 0)
    factors = checked_factors(means, opacity_factors)
    inputs = ProjectInputs(means, quats, log_scales, logit_opacities, sh_coefficients, viewmats, Ks, distortion, factors)
    count, window = sh.coefficient_count(degree), window or (0, 0, width, height)
    return project_inputs(inputs, Pass((width, height), window, rule, count, tile_size, camera_model))


def adam_step(
    param: torch.Tensor,
    grad: torch.Tensor,
    exp_avg: torch.Tensor,
    exp_avg_sq: torch.Tensor,
    *,
    lr: float,
    step: int,
    betas: tuple[float, float] = BETAS,
    eps: float = EPS,
    head_lr: float | None = None,
    head: int = 0,
) -> None:
    """Update a parameter [N, ...] and its moments in place, with bias correction as in `torch.optim.Adam`."""
    # The first ``head`` numbers of each of the N rows take the learning rate ``head_lr``.
    lrs = scheduled_lrs(lr, step, betas, head_lr)
    if param.is_cuda and param.dtype == torch.float32:
        # one kernel for this and for captured steps, so that both give the same bits
        skip = torch.zeros(1, dtype=torch.int32, device=param.device)
        on_device = torch.tensor(lrs, device=param.device, dtype=torch.float32)
        adam_scheduled(param, grad, exp_avg, exp_avg_sq, on_device, skip, betas=betas, eps=eps, head=head)
        return
    update_rows(param, grad, exp_avg, exp_avg_sq, lrs, head, betas, eps)
