"""Compositing as a plain loop over Gaussians, and as a product of matrices."""

import math

import torch

from warpgs.constants import SMALLEST_WEIGHT

# Compositing by a plain loop over Gaussians sorted by depth, dense over pixels, float64, with the cut-offs of a rule.


def blend_reference(means, covs, opacities, colors, depths, background, width, height, rule, keep=None, tile_size=16):
    """One camera: rgb [H, W, 3], alpha, depth [H, W], weights [N, H, W]; inputs [N, ...]; ``keep`` [N] culls the others."""
    ys, xs = torch.meshgrid(
        torch.arange(height, dtype=means.dtype) + 0.5, torch.arange(width, dtype=means.dtype) + 0.5, indexing="ij"
    )
    grid = torch.stack([xs, ys], -1)
    T = torch.ones(height, width, dtype=means.dtype)
    running = torch.ones(height, width, dtype=torch.bool)
    weights = [torch.zeros_like(T)] * len(means)
    for i in torch.argsort(depths.detach(), stable=True).tolist():
        if (keep is not None and not keep[i]) or not bool(depths[i] >= rule.near):
            continue
        d = grid - means[i]
        power = torch.einsum("hwi,ij,hwj->hw", d, torch.linalg.inv(covs[i]), d)
        alpha = opacities[i] * torch.exp(-0.5 * power)
        alpha = torch.where(alpha > rule.alpha_max, torch.full_like(alpha, rule.alpha_max), alpha)
        drawn = running & (alpha >= rule.alpha_cut)
        if rule.square_sigma > 0:
            drawn = drawn & _square(means[i].detach(), covs[i].detach(), grid, rule.square_sigma, tile_size)
        after = T * (1 - alpha)
        stays = after.detach() >= rule.transmittance_stop
        blended = drawn if rule.inclusive_stop else drawn & stays
        weights[i] = torch.where(blended, alpha * T, torch.zeros_like(T))
        T = torch.where(blended, after, T)
        running = running & ~(drawn & ~stays)
    w = torch.stack(weights) if len(means) else torch.zeros(0, height, width, dtype=means.dtype)
    rgb = torch.einsum("nhw,nc->hwc", w, colors) + T[..., None] * background
    total = w.sum(0)
    covered = total >= SMALLEST_WEIGHT
    depth = torch.where(covered, torch.einsum("nhw,n->hw", w, depths) / torch.where(covered, total, 1.0), 0.0)
    return rgb, 1 - T, depth, w


def _square(mean, cov, grid, sigma, tile_size):
    """Pixels of the tiles that the square around a Gaussian touches with at least one pixel centre's column and row."""
    half = math.ceil(sigma * math.sqrt(float(torch.linalg.eigvalsh(cov)[-1])))
    inside = ((grid - mean).abs() <= half + 0.01 + 2e-6 * (mean.abs() + half)).all(-1)
    height, width = inside.shape
    result = torch.zeros_like(inside)
    for y in range(0, height, tile_size):
        for x in range(0, width, tile_size):
            tile = (slice(y, y + tile_size), slice(x, x + tile_size))
            result[tile] = inside[tile].any()
    return result


# Any number of channels as one product: blending weights [P, N] times channels [N, D], and what is left of the
# background.


def blend_channels_reference(means, covs, opacities, colors, depths, background, width, height, rule):
    """One camera: image [H, W, D], alpha [H, W], depth [H, W]; inputs [N, ...], colors [N, D], background [D]."""
    black, none = colors.new_zeros(len(means), 3), background.new_zeros(3)
    _, alpha, depth, weights = blend_reference(means, covs, opacities, black, depths, none, width, height, rule)
    product = weights.flatten(1).T @ colors
    return product.view(height, width, -1) + (1 - weights.sum(0))[..., None] * background, alpha, depth
