"""Colours as spherical-harmonics coefficients of degree 0, the part of a colour that is the same in all directions."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    import torch

C0 = 0.28209479177387814
"""Harmonic of degree 0, 1/2 sqrt(1/pi): a colour is 1/2 + C0 times its coefficient."""


def base_colors(sh: np.ndarray | torch.Tensor) -> np.ndarray | torch.Tensor:
    """Return the unclipped colours [N, 3] given by the degree-0 terms of coefficients [N, K, 3]."""
    return 0.5 + C0 * sh[:, 0]


def base_coefficients(colors: np.ndarray | torch.Tensor) -> np.ndarray | torch.Tensor:
    """Return the degree-0 coefficients that give colours [..., 3], in the same shape."""
    return (colors - 0.5) / C0
