"""Walks along rays: the median depth by a loop, the heaviest Gaussians by a sort."""

import torch

from tests.reference.blend import blend_reference

# The k heaviest Gaussians of each pixel by a stable sort of all weights, dense over pixels, float64.


def heaviest_reference(means, covs, opacities, depths, k, width, height, rule, tile_size=16):
    """One camera: numbers [H, W, k] of the heaviest Gaussians, -1 where fewer have a weight, their weights, and all counts."""
    colors, black = torch.zeros(len(means), 3, dtype=means.dtype), torch.zeros(3, dtype=means.dtype)
    weights = blend_reference(
        means, covs, opacities, colors, depths, black, width, height, rule, tile_size=tile_size
    )[3]  # fmt: skip
    front_to_back = torch.argsort(depths, stable=True)
    padded = torch.cat([weights[front_to_back], torch.zeros(k, height, width, dtype=means.dtype)])
    numbers = torch.cat([front_to_back, torch.full((k,), -1)])
    order = torch.argsort(padded, dim=0, descending=True, stable=True)[:k]
    found = torch.gather(padded, 0, order)
    ids = torch.where(found > 0, numbers[order], -1)
    return ids.permute(1, 2, 0), found.permute(1, 2, 0), (weights > 0).sum(0)


# Median depth by a plain loop over Gaussians sorted by depth, dense over pixels, float64.


def median_depth_reference(means, covs, opacities, depths, width, height, rule, tile_size=16):
    """One camera: depth [H, W] of the Gaussian that leaves at most half of a pixel's light, by a sum of weights; 0 for none."""
    colors, black = torch.zeros(len(means), 3, dtype=means.dtype), torch.zeros(3, dtype=means.dtype)
    weights = blend_reference(
        means, covs, opacities, colors, depths, black, width, height, rule, tile_size=tile_size
    )[3]  # fmt: skip
    order = torch.argsort(depths, stable=True)
    reached = weights[order].cumsum(0) >= 0.5
    first = reached.double().argmax(0)
    return torch.where(reached.any(0), depths[order][first], 0.0)
