"""Images and gradients with ordered and with atomic sums, and the spread of atomic sums."""

from __future__ import annotations

import torch

from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians


def gradients_of(g: Gaussians, cam: Camera, *, deterministic: bool) -> list[torch.Tensor]:
    """Return colour, alpha and depth, and the gradients of a fixed mix of them in the five tensors of ``g``."""
    leaves = {n: t.detach().requires_grad_() for n, t in g.tensors().items()}
    r = rasterize(Gaussians(**leaves), cam, RasterizeOptions(deterministic=deterministic, record=False))
    loss = r.rgb.square().sum() + (r.alpha * r.depth).sum()
    return [t.detach() for t in (r.rgb, r.alpha, r.depth)] + list(torch.autograd.grad(loss, list(leaves.values())))


def ulps(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the number of float32 values between the entries of two tensors, int64."""

    def ordered(t: torch.Tensor) -> torch.Tensor:
        bits = t.contiguous().view(torch.int32).long()
        return torch.where(bits < 0, -(bits & 0x7FFFFFFF), bits)

    return (ordered(a) - ordered(b)).abs()


def atomic_spread(g: Gaussians, cam: Camera, repeats: int) -> dict[str, dict]:
    """Return the distance of the gradients of repeated atomic sums from the ordered ones, by parameter.

    ``rel_l2``: largest relative L2 distance of a repeat from the ordered sum. ``max_ulp``: largest distance of an entry that
    is at least a thousandth of its tensor's largest, in units in the last place. ``repeats_that_differ``: number of repeats
    whose bits differ from the first.
    """
    wanted = gradients_of(g, cam, deterministic=True)[3:]
    names = list(g.tensors())
    rows = {n: {"rel_l2": 0.0, "max_ulp": 0, "repeats_that_differ": 0} for n in names}
    first = None
    for _ in range(repeats):
        found = gradients_of(g, cam, deterministic=False)[3:]
        first = found if first is None else first
        for name, a, b, c in zip(names, found, wanted, first):
            row = rows[name]
            row["rel_l2"] = max(row["rel_l2"], float((a.double() - b.double()).norm() / b.double().norm()))
            large = b.abs() >= 1e-3 * b.abs().max()
            row["max_ulp"] = max(row["max_ulp"], int(ulps(a, b)[large].max()))
            row["repeats_that_differ"] += int(not torch.equal(a, c))
    return rows
