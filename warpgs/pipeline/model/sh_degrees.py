"""Degrees of each Gaussian's harmonics: coefficients packed up to these degrees, and the size of a model in bytes."""

from __future__ import annotations

import torch

from warpgs.kernels.sh import MAX_DEGREE

FLOAT = 4
"""Size of a stored number [bytes]."""


def model_bytes(degrees: torch.Tensor) -> int:
    """Return the bytes of a model with these degrees [N]: float32, uncompressed, without coefficients above the degrees."""
    return FLOAT * int((11 + 3 * (degrees.long() + 1) ** 2).sum())


def truncated(sh: torch.Tensor, degrees: torch.Tensor) -> torch.Tensor:
    """Return coefficients [N, K, 3] with zeros above each Gaussian's degree [N], int."""
    bands = torch.arange(sh.shape[1], device=sh.device).add(0.5).sqrt().long()
    return torch.where((bands <= degrees[:, None])[..., None], sh, 0)


def pack(sh: torch.Tensor, degrees: torch.Tensor) -> torch.Tensor:
    """Pack coefficients, given as [N, K, 3], up to each Gaussian's degree [N], Gaussian by Gaussian, into one vector [M].

    Raises:
        ValueError: The degrees do not ascend; Gaussians are stored sorted by degree, so that equal degrees make one block.
    """
    if bool((degrees.diff() < 0).any()):
        raise ValueError("degrees must ascend; sort the Gaussians by degree first")
    blocks = [sh[degrees == d, : (d + 1) ** 2].reshape(-1) for d in range(MAX_DEGREE + 1)]
    return torch.cat(blocks)


def unpack(packed: torch.Tensor, degrees: torch.Tensor) -> torch.Tensor:
    """Return coefficients [N, K, 3] from the vector [M] of `pack`: K for the highest degree, 0 above each Gaussian's degree.

    Raises:
        ValueError: The degrees are not integers from 0 to 4, or do not match the packed coefficients.
    """
    whole = degrees.ndim == 1 and not degrees.is_floating_point() and bool(((degrees >= 0) & (degrees <= MAX_DEGREE)).all())
    count = 3 * int((degrees.long() + 1).square().sum()) if whole else -1
    if packed.shape != (count,):
        raise ValueError(
            f"{list(packed.shape)} packed coefficients do not match {list(degrees.shape)} degrees from 0 to {MAX_DEGREE}"
        )
    highest = int(degrees.max()) if len(degrees) else 0
    sh, at = packed.new_zeros(len(degrees), (highest + 1) ** 2, 3), 0
    for d in range(highest + 1):
        rows = degrees == d
        size = 3 * (d + 1) ** 2 * int(rows.sum())
        sh[rows, : (d + 1) ** 2] = packed[at : at + size].reshape(-1, (d + 1) ** 2, 3)
        at += size
    return sh
