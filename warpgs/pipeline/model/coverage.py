"""Coverage of a model by the training views: contribution and sensitivity of each Gaussian."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch

from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

SEEN = 4 / 255
"""Least blending weight at which a view sees a Gaussian: with less, the Gaussian changes no pixel by more than 4 of 255
levels."""
PROBES = 2
"""Random images per view for the Fisher sensitivity."""


@dataclass(frozen=True)
class Coverage:
    """Coverage of each Gaussian by all training views; tensors of shape [N] on the device of the Gaussians."""

    maxima: torch.Tensor
    """Largest blending weight over all pixels of all views (RadSplat, arXiv 2403.13806); a sum of weights would be small for
    thin Gaussians."""
    views: torch.Tensor
    """Number of views with a weight of at least `SEEN`, int64."""


@torch.no_grad()
def coverage(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions) -> Coverage:
    """Render every view once; measure each Gaussian's largest blending weight, and the number of views that see it.

    Args:
        gaussians: N Gaussians.
        cameras: Cameras of the training views, tensors.
        options: Settings of the rasterizer.
    """
    count, means = len(gaussians), gaussians.means
    maxima, views = means.new_zeros(count), torch.zeros(count, dtype=torch.int64, device=means.device)
    for c in cameras:
        weights = rasterize(gaussians, c, replace(options, contributions=True)).weight_maxima[0]
        maxima = torch.maximum(maxima, weights)
        views += weights >= SEEN
    return Coverage(maxima, views)


@torch.enable_grad()  # the caller may have switched gradients off, as the trainer does when the set changes
def fisher(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions, seed: int) -> torch.Tensor:
    """Estimate the change of the images when a Gaussian moves by its own width or its axes grow.

    The result is the trace of PUP-3DGS' sensitivity, in units of the Gaussian's width (arXiv 2406.10219, eq. 6: the sum over
    pixels of the outer product of the colour's gradient with respect to mean and scale). PUP uses the log-determinant instead.
    With random signs e as the gradient of an image, the backward pass gives J^T e; the mean of the squares of J^T e is the
    diagonal of J^T J.

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
            signs = (2 * torch.randint(2, rgb.shape, generator=generator, device="cpu") - 1).to(rgb)
            wanted = [leaves["means"], leaves["log_scales"]]
            v_means, v_scales = torch.autograd.grad(rgb, wanted, signs, retain_graph=probe + 1 < PROBES)
            total += ((v_means * width).square().sum(1) + v_scales.square().sum(1)) / PROBES
    return total
