"""Median depth by a plain loop over Gaussians sorted by depth, dense over pixels, float64."""

import torch

from tests.reference.blend import blend_reference


def median_depth_reference(means, covs, opacities, depths, width, height, rule, tile_size=16):
    """One camera: the depth [H, W] of the Gaussian that leaves half of a pixel's light, or less; 0 where none does.

    Weights come from `blend_reference`: what has been blended up to a Gaussian is a sum, not a product as in the kernel.
    """
    colors, black = torch.zeros(len(means), 3, dtype=means.dtype), torch.zeros(3, dtype=means.dtype)
    weights = blend_reference(
        means, covs, opacities, colors, depths, black, width, height, rule, tile_size=tile_size
    )[3]  # fmt: skip
    order = torch.argsort(depths, stable=True)
    reached = weights[order].cumsum(0) >= 0.5
    first = reached.double().argmax(0)
    return torch.where(reached.any(0), depths[order][first], 0.0)
