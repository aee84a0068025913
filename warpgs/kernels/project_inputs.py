"""Inputs of a projection: its tensors and its settings."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import NamedTuple, Self

import torch

from warpgs.constants import Rule
from warpgs.errors import UsageError
from warpgs.kernels import sh
from warpgs.runtime import interop
from warpgs.runtime.derivatives import first_order

PROJECTED_SIZE = 12
"""Number of values of a projected Gaussian, whose rows are 16-byte aligned in float32:
0:2 mean [px], 2:5 factor u11 u12 u22 [1/px], 5 opacity, 6:9 colour, 9 depth [u] (z; the distance for a fisheye),
10:12 half width and half height [px] of the box that holds every pixel with alpha at or above the cut-off."""

OFF_DIAGONAL = ((0, 1), (0, 2), (1, 2))
"""Rows and columns of the entries of a covariance above the diagonal, in the order in which they are packed."""


@dataclass(frozen=True)
class ProjectSettings:
    """Everything that a projection depends on besides tensors."""

    size: tuple[int, int]
    """Width and height of the image [px]."""
    window: tuple[int, int, int, int]
    """Left, top, width and height [px] of the part that is rendered; left and top are multiples of ``tile_size``."""
    sh_count: int
    """Number of spherical-harmonics coefficients per channel that are used."""
    rule: Rule
    """Cut-offs."""
    tile_size: int
    """Side of a tile [px]."""
    camera_model: str
    """Name of the camera model."""
    parameters: str = "stored"
    """Parameters in `ProjectInputs`: ``stored`` log scales and logits, ``activated`` scales and opacities, or ``covariances``
    (as `packed_covariances` returns them) and opacities."""
    antialiased: bool = False
    """True to multiply each opacity by sqrt(det(cov2d) / det(cov2d + low_pass I)) (docs/project.md)."""

    def variant(self) -> tuple[str, str, bool, int]:
        """Return the settings that are compiled into the kernels."""
        return self.camera_model, self.parameters, self.antialiased, sh.bases_for(self.sh_count)


class ProjectInputs(NamedTuple):
    """The tensors of a projection, of one scalar type and on one device."""

    means: torch.Tensor
    """World positions [u], shape [N, 3]."""
    quats: torch.Tensor
    """Rotations wxyz, or entries xy, xz, yz of covariances and a 0 (`ProjectSettings.parameters`), shape [N, 4]."""
    log_scales: torch.Tensor
    """Logarithm of the axis lengths [u], the lengths themselves, or the diagonals of covariances, shape [N, 3]."""
    logit_opacities: torch.Tensor
    """Inverse sigmoid of the opacity, or the opacity itself, shape [N]."""
    sh: torch.Tensor
    """Spherical-harmonics coefficients of the colour, shape [N, K, 3]."""
    viewmats: torch.Tensor
    """camera_from_world, shape [C, 4, 4]."""
    Ks: torch.Tensor
    """Intrinsics [px] with zero skew, shape [C, 3, 3]."""
    distortion: torch.Tensor
    """Coefficients of the camera model, shape [C, P]. They have no gradient."""
    opacity_factors: torch.Tensor
    """Factors of the opacities, at least 0, shape [N]; shape [0] for none. They have no gradient."""

    def detached(self) -> Self:
        """Return the same tensors [...], detached from autograd."""
        return self._make(t.detach() for t in self)


@functools.lru_cache(maxsize=64)
def nothing(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """Return a tensor without entries [...], the same one each time, since making one takes 5 us."""
    with torch.inference_mode(False):  # an inference-mode tensor could not be saved for a backward pass
        return torch.empty(shape, dtype=dtype, device=device)


def checked_factors(means: torch.Tensor, factors: torch.Tensor | None) -> torch.Tensor:
    """Return opacity factors as `ProjectInputs` holds them, shape [N], or [0] for None.

    Args:
        means: Positions of the Gaussians, shape [N, 3].
        factors: Factors, shape [N]; None for 1.

    Raises:
        TypeError: The scalar types differ.
        UsageError: A gradient of the factors would be recorded.
        ValueError: The shape or the device differs.
    """
    if factors is None:
        return nothing((0,), means.dtype, means.device)
    interop.check(means=(means, "N 3"), opacity_factors=(factors, "N"))
    if factors.requires_grad and torch.is_grad_enabled():
        raise UsageError(
            "gradients of opacity_factors are not supported: give opacity_factors.detach(), or multiply the opacities "
            "themselves"
        )
    return factors.detach()


class _PackedCovariances(torch.autograd.Function):
    @staticmethod
    def forward(ctx, covars):
        off = covars.new_zeros(len(covars), 4)
        for k, (i, j) in enumerate(OFF_DIAGONAL):
            off[:, k] = 0.5 * covars[:, i, j] + 0.5 * covars[:, j, i]
        return off, covars.diagonal(dim1=1, dim2=2).contiguous()

    @staticmethod
    @first_order
    def backward(ctx, v_off, v_diagonal):
        v_covars = torch.diag_embed(v_diagonal)
        for k, (i, j) in enumerate(OFF_DIAGONAL):
            v_covars[:, i, j] = v_covars[:, j, i] = 0.5 * v_off[:, k]
        return (v_covars,)


def packed_covariances(covars: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the symmetric part of covariances as `ProjectInputs` holds them. Differentiable.

    Args:
        covars: Covariances [u^2], shape [N, 3, 3].

    Returns:
        Entries xy, xz, yz and a 0, shape [N, 4], and the diagonals, shape [N, 3].
    """
    found: tuple[torch.Tensor, torch.Tensor] = _PackedCovariances.apply(covars)
    return found
