"""Depth of a surface along each ray: where the Gaussians of a pixel are densest, and the fraction of their weight there.

The depth of a Gaussian's mean, which the rasterizer reports, makes steps on a slanted surface. Here, a Gaussian's depth is
where its density along the ray is largest.
"""

from __future__ import annotations

import torch

from warpgs.geometry import rotation_matrices
from warpgs.scene import Camera, Gaussians

CONTRIBUTORS = 32
"""Number of Gaussians that are used for a pixel: those with the largest blending weights."""
BAND = 0.02
"""Largest difference from the median depth, as a fraction of the median, that counts as the same surface."""
MIN_SHARE = 0.5
"""A pixel shows a surface if at least this fraction of its weights is within `BAND` of the median depth
(docs/decisions/027-mesh-depth.md)."""
BLOCK = 2**15
"""Number of pixels that are processed at a time: 38 MB for the matrices of their Gaussians."""


def whitening(gaussians: Gaussians, camera: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Return for each Gaussian a linear map of camera space that makes the Gaussian isotropic; and the Gaussians' means.

    Args:
        gaussians: N Gaussians.
        camera: Camera, arrays of numpy.

    Returns:
        Matrices, shape [N, 3, 3], and the means in camera space [u], shape [N, 3]. Each row of a matrix is a unit axis of the
        Gaussian, times the smallest scale divided by the scale of this axis.
    """
    view = torch.as_tensor(camera.viewmat, dtype=gaussians.means.dtype, device=gaussians.means.device)
    axes = rotation_matrices(torch.nn.functional.normalize(gaussians.quats, dim=1))
    # elementwise, not as a product of matrices: its bits would depend on the processor
    turned = (axes.mT[:, :, None] * view[None, None, :3, :3]).sum(-1)
    means = (gaussians.means[:, None] * view[None, :3, :3]).sum(-1) + view[:3, 3]
    scales = gaussians.log_scales
    return turned * torch.exp(scales.amin(1, keepdim=True) - scales)[..., None], means


def densest_depths(matrices: torch.Tensor, means: torch.Tensor, rays: torch.Tensor, ids: torch.Tensor) -> torch.Tensor:
    """Return the z-depth [u] at which each of k Gaussians is densest along a ray, shape [P, k].

    The depth of the mean replaces a depth that is 0, negative or not finite.

    Args:
        matrices: Matrices of `whitening`, shape [N, 3, 3].
        means: Means in camera space [u], shape [N, 3].
        rays: Directions in camera space with z = 1, shape [P, 3].
        ids: Indices of the Gaussians, shape [P, k].
    """
    own, mean = matrices[ids], means[ids]
    along = (own * rays[:, None, None]).sum(-1)
    center = (own * mean[:, :, None]).sum(-1)
    squared = (along * along).sum(-1)
    depth = (along * center).sum(-1) / squared
    return torch.where((squared > 0) & torch.isfinite(depth) & (depth > 0), depth, mean[..., 2])


def weighted_median(depths: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    """Return the weighted median [P] of depths [P, k] with weights [P, k]; depths of weight 0 are ignored."""
    order = torch.where(weights > 0, depths, torch.inf).argsort(dim=1, stable=True)
    sums = weights.gather(1, order).cumsum(1)
    half = (2 * sums >= sums[:, -1:]).int().argmax(1, keepdim=True)
    return depths.gather(1, order.gather(1, half))[:, 0]


def surface_depth(
    gaussians: Gaussians, camera: Camera, ids: torch.Tensor, weights: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the median depth of each pixel's Gaussians, and the fraction of their weights within `BAND` of that depth.

    Args:
        gaussians: N Gaussians in the units of the camera.
        camera: Pinhole camera, arrays of numpy.
        ids: Indices of each pixel's Gaussians, -1 for none, shape [H, W, k].
        weights: Their blending weights, 0 for none, shape [H, W, k].

    Returns:
        z-depth [u] and fraction in [0, 1], shape [H, W] each; 0 and 0 where a pixel has no Gaussian.
    """
    height, width, k = ids.shape
    if not len(gaussians):
        return weights.new_zeros(height, width), weights.new_zeros(height, width)
    matrices, means = whitening(gaussians, camera)
    rows, columns = (torch.arange(n, dtype=means.dtype, device=means.device) + 0.5 for n in (height, width))
    x = (columns - float(camera.K[0, 2])) / float(camera.K[0, 0])
    y = (rows - float(camera.K[1, 2])) / float(camera.K[1, 1])
    rays = torch.stack([x.repeat(height), y.repeat_interleave(width), x.new_ones(height * width)], 1)
    found = []
    for first in range(0, len(rays), BLOCK):
        part = slice(first, first + BLOCK)
        w, i = weights.reshape(-1, k)[part], ids.reshape(-1, k)[part].clamp_min(0).long()
        depths, sums = densest_depths(matrices, means, rays[part], i), w.sum(1)
        median = weighted_median(depths, w)
        near = (depths - median[:, None]).abs() <= BAND * median[:, None]
        share = torch.where(near, w, 0).sum(1) / torch.where(sums > 0, sums, 1)
        found.append(torch.stack([torch.where(sums > 0, median, 0), share]))
    depth, share = torch.cat(found, 1).reshape(2, height, width)
    return depth, share
