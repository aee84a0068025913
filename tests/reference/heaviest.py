"""The k heaviest Gaussians of each pixel by a stable sort of all weights, dense over pixels, float64."""

import torch

from tests.reference.blend import blend_reference


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
