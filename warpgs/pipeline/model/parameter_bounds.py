"""Bounds of each Gaussian: its highest degree of harmonics and its least width, held after every step."""

from __future__ import annotations

import torch

from warpgs.kernels.sh import MAX_DEGREE
from warpgs.pipeline.model.table import Column, Table

FINEST = 12**-0.5
"""Least standard deviation of an axis, in pixels of the nearest view that sees the Gaussian: that of one pixel's box filter."""
NO_BOUND = torch.finfo(torch.float32).min
"""Least log scale [ln u] of a Gaussian that has no bound."""
FLOAT = 4
"""Bytes of a stored number."""


def model_bytes(degrees: torch.Tensor) -> int:
    """Return the bytes of a model whose Gaussians have these degrees [N]: float32, no coefficient above, nothing compressed."""
    return FLOAT * int((11 + 3 * (degrees.long() + 1) ** 2).sum())


def truncated(sh: torch.Tensor, degrees: torch.Tensor) -> torch.Tensor:
    """Return coefficients [N, K, 3] with zeros above each Gaussian's degree [N], int."""
    bands = torch.arange(sh.shape[1], device=sh.device).add(0.5).sqrt().long()
    return torch.where((bands <= degrees[:, None])[..., None], sh, 0)


def pack(sh: torch.Tensor, degrees: torch.Tensor) -> torch.Tensor:
    """Return the coefficients [N, K, 3] that Gaussians of these degrees [N] have, one after the other, in one row.

    Raises:
        ValueError: The degrees do not ascend: stored degree-sorted, equal degrees make one uniform block.
    """
    if bool((degrees.diff() < 0).any()):
        raise ValueError("degrees must ascend; sort the Gaussians by degree first")
    blocks = [sh[degrees == d, : (d + 1) ** 2].reshape(-1) for d in range(4)]
    return torch.cat(blocks)


def unpack(packed: torch.Tensor, degrees: torch.Tensor) -> torch.Tensor:
    """Return the coefficients [N, K, 3] that `pack` stored, K that of the highest degree, zeros above each one's degree.

    Raises:
        ValueError: The degrees are not whole numbers from 0 to 3, or others than those that the coefficients were packed with.
    """
    whole = degrees.ndim == 1 and not degrees.is_floating_point() and bool(((degrees >= 0) & (degrees <= MAX_DEGREE)).all())
    count = 3 * int((degrees.long() + 1).square().sum()) if whole else -1
    if packed.shape != (count,):
        raise ValueError(
            f"{list(packed.shape)} packed coefficients do not go with {list(degrees.shape)} degrees from 0 to {MAX_DEGREE}"
        )
    highest = int(degrees.max()) if len(degrees) else 0
    sh, at = packed.new_zeros(len(degrees), (highest + 1) ** 2, 3), 0
    for d in range(highest + 1):
        rows = degrees == d
        size = 3 * (d + 1) ** 2 * int(rows.sum())
        sh[rows, : (d + 1) ** 2] = packed[at : at + size].reshape(-1, (d + 1) ** 2, 3)
        at += size
    return sh


def bound_columns(degree: int) -> dict[str, Column]:
    """Return the columns that bounds live in.

    ``max_degree``: highest degree of harmonics that a Gaussian may have; ``degree`` for new ones. ``min_log_scale``: its least
    log scale [ln u].
    """
    return {"max_degree": Column(degree, torch.int32), "min_log_scale": Column(NO_BOUND)}


@torch.no_grad()
def enforce_bounds(table: Table) -> None:
    """Bring parameters within their bounds, in place.

    A second time changes nothing, so a captured step that is not taken may end with it.
    """
    log_scales, sh = table.params["log_scales"].detach(), table.params["sh"].detach()
    log_scales.copy_(torch.maximum(log_scales, table.columns["min_log_scale"][:, None]))
    if sh.shape[1] > 1:
        sh.copy_(truncated(sh, table.columns["max_degree"]))


def min_log_scale(footprint: torch.Tensor) -> torch.Tensor:
    """Return the least log scale [N] for the width of a pixel at each Gaussian [u], shape [N]; no bound where it is 0."""
    return torch.log(FINEST * footprint).clamp_min(NO_BOUND)
