"""Errors of gradients against those of float64, by parameter: of single Gaussians, and of the whole tensor."""

from __future__ import annotations

import torch

SEEN = 1e-6
"""A Gaussian counts if its gradient is at least this fraction of the largest in its tensor: smaller ones have no effect."""
TENSORS = ("means", "quats", "log_scales", "logit_opacities", "sh")


def errors_of(found: torch.Tensor, wanted: torch.Tensor) -> dict:
    """Return the errors of a gradient [N, ...] against that of float64.

    ``median``, ``p99`` and ``largest`` are statistics over Gaussians of the length of the error divided by that of the
    gradient. ``rel_l2``, ``one_minus_cosine`` and ``bias`` are those of the whole tensor. ``bias`` is the mean error in the
    direction of the gradient, entry by entry, over the mean magnitude: above 0 gradients are too long. ``lost`` is the number
    of Gaussians whose gradient is 0 or not finite.
    """
    a, b = (t.detach().double().reshape(len(wanted), -1) for t in (found, wanted))
    length = b.norm(dim=1)
    seen = length >= max(SEEN * float(length.max()), 1e-300)
    a, b, length = a[seen], b[seen], length[seen]
    good = a.isfinite().all(1) & (a != 0).any(1)
    ratios = ((a - b).norm(dim=1) / length)[good].sort().values
    at = {name: float(ratios[int(q * (len(ratios) - 1))]) for name, q in (("median", 0.5), ("p99", 0.99), ("largest", 1.0))}
    a, b = a[good], b[good]
    # 1 - cos = |a / |a| - b / |b||^2 / 2, which does not cancel
    apart = 0.5 * (a / a.norm() - b / b.norm()).square().sum()
    whole = {"rel_l2": (a - b).norm() / b.norm(), "one_minus_cosine": apart, "bias": ((a - b) * b.sign()).sum() / b.abs().sum()}
    return at | {k: float(v) for k, v in whole.items()} | {"gaussians": len(good), "lost": int((~good).sum())}
