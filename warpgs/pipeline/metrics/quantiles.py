"""Quantiles of large arrays, such as images."""

from __future__ import annotations

import torch


def quantiles(values: torch.Tensor, *fractions: float) -> list[torch.Tensor]:
    """Return quantiles of numbers [N], N at least 1, for fractions in [0, 1], linear between neighbours; a NaN ranks last.

    torch.quantile rejects more than 2^24 numbers, and photographs may have more pixels.
    """
    ordered = values.sort().values
    found = []
    for fraction in fractions:
        rank = fraction * (len(ordered) - 1)
        below = int(rank)
        found.append(torch.lerp(ordered[below], ordered[min(below + 1, len(ordered) - 1)], rank - below))
    return found
