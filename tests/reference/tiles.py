"""The tiles that hold a pixel to which a Gaussian contributes, found by a look at every pixel."""

import torch


def touched_reference(means, covs, opacities, width, height, tile_size, alpha_cut):
    """For each Gaussian the set of (row, column) of tiles that hold a pixel with alpha at or above the cut."""
    ys, xs = torch.meshgrid(
        torch.arange(height, dtype=means.dtype) + 0.5, torch.arange(width, dtype=means.dtype) + 0.5, indexing="ij"
    )
    grid = torch.stack([xs, ys], -1)
    result = []
    for mean, cov, opacity in zip(means, covs, opacities):
        d = grid - mean
        alpha = opacity * torch.exp(-0.5 * torch.einsum("hwi,ij,hwj->hw", d, torch.linalg.inv(cov), d))
        rows, columns = torch.nonzero(alpha >= alpha_cut, as_tuple=True)
        result.append(set(zip((rows // tile_size).tolist(), (columns // tile_size).tolist())))
    return result
