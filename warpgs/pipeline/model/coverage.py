"""Coverage of a model by the training views: contribution, viewing directions and sensitivity of each Gaussian."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import torch

from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.scene import Camera, Gaussians

SEEN = 4 / 255
"""Least blending weight at which a view sees a Gaussian: below, it changes no pixel by more than four of 255 levels."""
CONE = math.radians(5)
"""Least angle of the cone of view directions for each band of harmonics. Over a smaller one the band changes by less than a
twelfth of its range, and its coefficients answer for the noise of the photographs instead."""
PROBES = 2
"""Random images per view for the Fisher sensitivity."""


@dataclass(frozen=True)
class Coverage:
    """Per Gaussian, over all training views; tensors of shape [N] on the device of the Gaussians."""

    maxima: torch.Tensor
    """Largest blending weight over all pixels of all views (RadSplat, arXiv 2403.13806; a sum is small for thin Gaussians)."""
    views: torch.Tensor
    """Number of views with a weight of at least `SEEN`, int64."""
    cone: torch.Tensor
    """Full opening angle of the cone around the mean direction that holds the directions to those views [rad]."""
    footprint: torch.Tensor
    """Width of a pixel at the Gaussian in the nearest of those views [u]; 0 where no view sees it."""

    def supported_degree(self) -> torch.Tensor:
        """Return the highest degree that the views can tell apart, int64 [N]: d needs d + 1 views in a cone of d `CONE`."""
        return torch.minimum((self.views - 1).clamp_min(0), (self.cone / CONE).long()).clamp_max(3)


@torch.no_grad()
def coverage(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions) -> Coverage:
    """Render every view once and measure what it sees of each Gaussian.

    Args:
        gaussians: N Gaussians.
        cameras: Cameras of the training views, tensors.
        options: Settings of the rasterizer.
    """
    count, means = len(gaussians), gaussians.means
    maxima, views = means.new_zeros(count), torch.zeros(count, dtype=torch.int64, device=means.device)
    footprint, total = means.new_full((count,), torch.inf), torch.zeros_like(means)
    seen = []
    for c in cameras:
        weights = rasterize(gaussians, c, replace(options, contributions=True)).weight_maxima[0]
        maxima = torch.maximum(maxima, weights)
        sees = weights >= SEEN
        seen.append(sees)
        views += sees
        depth = means @ c.viewmat[2, :3] + c.viewmat[2, 3]
        footprint = torch.where(sees, torch.minimum(footprint, depth / (c.K[0, 0] * c.K[1, 1]).sqrt()), footprint)
        total += torch.where(sees[:, None], _directions(means, c), 0)
    middle = torch.nn.functional.normalize(total, dim=1)
    widest = means.new_zeros(count)
    for c, sees in zip(cameras, seen):
        # from the distance of the unit vectors: the arc cosine of their product knows no small angles in float32
        angle = 2 * torch.asin((0.5 * (_directions(means, c) - middle).norm(dim=1)).clamp(max=1))
        widest = torch.where(sees, torch.maximum(widest, angle), widest)
    widest = torch.where(views > 1, widest, 0)  # of a single direction only its rounding is left
    return Coverage(maxima, views, 2 * widest, torch.where(torch.isfinite(footprint), footprint, 0))


def _directions(means: torch.Tensor, camera: Camera) -> torch.Tensor:
    center = -camera.viewmat[:3, :3].T @ camera.viewmat[:3, 3]
    return torch.nn.functional.normalize(center - means, dim=1)


@torch.enable_grad()  # whoever asks may have switched gradients off, as the trainer does when the set changes
def fisher(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions, seed: int) -> torch.Tensor:
    """Estimate how much the images change when a Gaussian moves by its own width or its axes grow.

    The trace of PUP-3DGS' sensitivity (arXiv 2406.10219, eq. 6: the sum over pixels of the outer product of the gradient of the
    colour in mean and scale), in units of the Gaussian's width, where PUP has the log-determinant. With random signs e as the
    gradient of an image, the backward pass gives J^T e, and the mean of its square is the diagonal of J^T J.

    Args:
        gaussians: N Gaussians.
        cameras: Cameras of the training views, tensors.
        options: Settings of the rasterizer.
        seed: Seed of the signs, the same on every device.

    Returns:
        Sensitivities, at least 0, shape [N].
    """
    leaves = {n: t.detach().clone().requires_grad_(n in ("means", "log_scales")) for n, t in gaussians.tensors().items()}
    width = leaves["log_scales"].detach().exp().amax(1, keepdim=True)
    generator = torch.Generator().manual_seed(seed)
    total = width.new_zeros(len(width))
    for camera in cameras:
        rgb = rasterize(Gaussians(**leaves), camera, options).rgb
        for probe in range(PROBES):
            signs = (2 * torch.randint(2, rgb.shape, generator=generator) - 1).to(rgb)
            wanted = [leaves["means"], leaves["log_scales"]]
            v_means, v_scales = torch.autograd.grad(rgb, wanted, signs, retain_graph=probe + 1 < PROBES)
            total += ((v_means * width).square().sum(1) + v_scales.square().sum(1)) / PROBES
    return total
