"""Merging of two neighbouring Gaussians into one with the moments of both."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from warpgs.colors import C0
from warpgs.geometry import quaternions, rotation_matrices
from warpgs.kernels.knn import morton_codes
from warpgs.pipeline.model.table import DensityUpdate
from warpgs.scene import Gaussians

OPAQUE = 0.99
"""Largest opacity of a merged Gaussian: the largest that the rasterizer blends."""


def covariances(quats: torch.Tensor, log_scales: torch.Tensor) -> torch.Tensor:
    """Return covariances [N, 3, 3] [u^2] from quaternions wxyz [N, 4] and log scales [N, 3] [ln u]."""
    axes = rotation_matrices(torch.nn.functional.normalize(quats, dim=1)) * log_scales.exp()[:, None, :]
    return axes @ axes.transpose(1, 2)


def _area(log_scales: torch.Tensor) -> torch.Tensor:
    """Return the product of the two longer axes [u^2], the area that a Gaussian covers when seen face on, shape [N]."""
    return (log_scales.sum(1) - log_scales.amin(1)).exp()


def _covered(opacity: torch.Tensor, area: torch.Tensor, own: torch.Tensor, means: torch.Tensor) -> torch.Tensor:
    """Return 1 / (2 pi) times the integral of 1 - (1 - a G)(1 - b H) over the plane that both face [u^2], shape [P].

    Args:
        opacity: a and b, shape [P, 2].
        area: `_area` of both, shape [P, 2].
        own: Covariances of G and H, shape [P, 2, 3, 3].
        means: Their means, shape [P, 2, 3].
    """
    squares, axes = torch.linalg.eigh(own.sum(1))
    squares = squares.clamp_min(1e-30)
    apart = (axes.transpose(1, 2) @ (means[:, 0] - means[:, 1])[..., None]).squeeze(-1)
    together = torch.exp(-0.5 * (apart.square() / squares).sum(1)) / squares[:, 1:].prod(1).sqrt()
    return (opacity * area).sum(1) - opacity.prod(1) * area.prod(1) * together


@dataclass(frozen=True)
class Merges:
    """Pairs that could become one, the cheapest first."""

    first: torch.Tensor
    """Row of one Gaussian of each pair, int64, shape [P]; no row occurs twice in ``first`` and ``second`` together."""
    second: torch.Tensor
    """Row of the other Gaussian of each pair, int64, shape [P]."""
    merged: dict[str, torch.Tensor]
    """Merged Gaussian of each pair: rows of the five tensors, shape [P, ...]."""

    def change(self, count: int, taken: int) -> DensityUpdate:
        """Return the change that merges the first ``taken`` pairs in a set of ``count`` Gaussians."""
        stays = torch.ones(count, dtype=torch.bool, device=self.first.device)
        stays[self.first[:taken]] = False
        stays[self.second[:taken]] = False
        added = {n: t[:taken] for n, t in self.merged.items()}
        return DensityUpdate(torch.nonzero(stays).squeeze(1), added, self.first[:taken])


def _curve(means: torch.Tensor, shift: float) -> torch.Tensor:
    """Return the rows of means [N, 3] along the Morton curve of their bounding box, enlarged by ``shift`` on one side."""
    low, high = means.amin(0), means.amax(0)
    boxed = torch.cat([means, (low - shift * (high - low))[None]])
    return torch.argsort(morton_codes(boxed)[:-1], stable=True)


@torch.no_grad()
def merges(gaussians: Gaussians, maxima: torch.Tensor, kinds: torch.Tensor, odd: bool, shift: float = 0.0) -> Merges:
    """Pair neighbours along the Morton curve, and compute the merged Gaussian of each pair.

    Mean, covariance and colours are those of the mixture, weighted by opacity times face-on area. The product of the new
    opacity and the new area is the area that the pair covers face on; the overlap counts once. If this needs an opacity above
    `OPAQUE`, the two longer axes grow instead: otherwise a surface of opaque Gaussians would get holes. The cost of a pair is
    its largest blending weight times the sum of three terms. They are the difference of the colours; the logarithm of new over
    old covered area, since distant pairs or pairs of different planes bulge; and the logarithm of the factor by which the area
    had to grow.

    Args:
        gaussians: N Gaussians.
        maxima: Largest blending weight of each, shape [N].
        kinds: Only Gaussians of the same kind are paired, int, shape [N].
        odd: Pair the second with the third, and so on, instead of the first with the second.
        shift: Fraction of the cloud's size by which the curve is moved, so that neighbours in two large cells can be paired.
    """
    order = _curve(gaussians.means, shift)[int(odd) :]
    order = order[: len(order) // 2 * 2].reshape(-1, 2)
    order = order[kinds[order[:, 0]] == kinds[order[:, 1]]]
    g = {n: t.detach()[order].double().cpu() for n, t in gaussians.tensors().items()}
    opacity = g["logit_opacities"].sigmoid()
    area = torch.stack([_area(g["log_scales"][:, i]) for i in range(2)], 1)
    mass = opacity * area
    fraction = mass / mass.sum(1, keepdim=True)
    means = (fraction[..., None] * g["means"]).sum(1)
    apart = g["means"] - means[:, None]
    own = torch.stack([covariances(g["quats"][:, i], g["log_scales"][:, i]) for i in range(2)], 1)
    both = (fraction[..., None, None] * (own + apart[..., :, None] * apart[..., None, :])).sum(1)
    squares, axes = torch.linalg.eigh(both)  # in float64 on the CPU: the same on every device
    axes = axes * torch.linalg.det(axes)[:, None, None].sign()
    log_scales = 0.5 * squares.clamp_min(1e-30).log()
    wanted = _covered(opacity, area, own, g["means"]) / _area(log_scales)
    grown = (wanted / OPAQUE).clamp_min(1).log()
    log_scales[:, 1:] += 0.5 * grown[:, None]  # eigenvalues ascend
    merged = {
        "means": means, "quats": quaternions(axes), "log_scales": log_scales,
        "logit_opacities": wanted.clamp(1e-6, OPAQUE).logit(), "sh": (fraction[..., None, None] * g["sh"]).sum(1),
    }  # fmt: skip
    colour = (C0 * (g["sh"][:, 0, 0] - g["sh"][:, 1, 0])).abs().amax(1)
    bulge = (_area(log_scales) / area.sum(1)).log().clamp_min(0)
    weight = maxima.detach()[order].amax(1).double().cpu()
    cost = weight * (colour + bulge + grown)
    cost = torch.where(torch.isfinite(cost), cost, torch.inf)
    ranks = torch.argsort(cost, stable=True)
    ranks = ranks[torch.isfinite(cost[ranks])]
    device = gaussians.means.device
    chosen = order[ranks.to(device)]
    return Merges(chosen[:, 0], chosen[:, 1], {n: t[ranks].to(device, gaussians.means.dtype) for n, t in merged.items()})
