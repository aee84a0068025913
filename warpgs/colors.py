"""Colours as coefficients of spherical harmonics: a Gaussian's colour without its changes by direction."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import torch

C0 = 0.28209479177387814
"""Harmonic of degree 0, 1/2 sqrt(1/pi): a colour is 1/2 + C0 times its coefficient."""


def base_colors(sh: np.ndarray | torch.Tensor) -> np.ndarray | torch.Tensor:
    """Return the colours [N, 3], not clipped, that coefficients [N, K, 3] have without the harmonics above degree 0."""
    return 0.5 + C0 * sh[:, 0]


def base_coefficients(colors: np.ndarray | torch.Tensor) -> np.ndarray | torch.Tensor:
    """Return the coefficients of degree 0, of the shape [..., 3] of ``colors``, that give these colours."""
    return (colors - 0.5) / C0
