"""Estimated gain of a fine Gaussian: the rate at which it would lower the squared error of all views (docs/method.md)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch

from warpgs.geometry import back_project_tensors, project_tensors
from warpgs.pipeline.train.strategies.importance import blur
from warpgs.pipeline.train.views import TrainingView
from warpgs.scene import Camera

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
