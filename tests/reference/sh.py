"""Spherical harmonics by scipy, and as harmonic polynomials that can be differentiated."""

from math import pi, sqrt

import numpy as np
import torch
from scipy.special import sph_harm_y

# Real spherical harmonics from scipy's complex ones, with the sign convention of the 3DGS papers.


def basis_reference(dirs: torch.Tensor) -> torch.Tensor:
    """Values [N, 25] at unit directions [N, 3], float64, no gradient."""
    x, y, z = dirs.detach().cpu().double().numpy().T
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    columns = []
    for degree in range(5):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth)
            if order == 0:
                columns.append(value.real)
            else:
                # with the Condon-Shortley phase inside sph_harm_y, this gives -y, z, -x for degree 1
                part = value.imag if order < 0 else value.real
                columns.append(np.sqrt(2) * part)
    return torch.from_numpy(np.stack(columns, axis=1))


# Spherical harmonics as harmonic polynomials, differentiable; checked against scipy in tests/kernels/test_sh.py.


def colors_reference(sh: torch.Tensor, dirs: torch.Tensor, degree: int) -> torch.Tensor:
    """Colours [N, 3] of coefficients [N, K, 3] at unit directions [N, 3]."""
    x, y, z = dirs.unbind(-1)
    one = torch.ones_like(x)
    rows = [
        [(1 / sqrt(4 * pi), one)],
        [(-sqrt(3 / (4 * pi)), y), (sqrt(3 / (4 * pi)), z), (-sqrt(3 / (4 * pi)), x)],
        [
            (sqrt(15 / (4 * pi)), x * y), (-sqrt(15 / (4 * pi)), y * z),
            (sqrt(5 / (16 * pi)), 2 * z**2 - x**2 - y**2),
            (-sqrt(15 / (4 * pi)), x * z), (sqrt(15 / (16 * pi)), x**2 - y**2),
        ],
        [
            (-sqrt(35 / (32 * pi)), y * (3 * x**2 - y**2)), (sqrt(105 / (4 * pi)), x * y * z),
            (-sqrt(21 / (32 * pi)), y * (4 * z**2 - x**2 - y**2)),
            (sqrt(7 / (16 * pi)), z * (2 * z**2 - 3 * x**2 - 3 * y**2)),
            (-sqrt(21 / (32 * pi)), x * (4 * z**2 - x**2 - y**2)), (sqrt(105 / (16 * pi)), z * (x**2 - y**2)),
            (-sqrt(35 / (32 * pi)), x * (x**2 - 3 * y**2)),
        ],
        [
            (sqrt(315 / (16 * pi)), x * y * (x**2 - y**2)), (-sqrt(315 / (32 * pi)), y * z * (3 * x**2 - y**2)),
            (sqrt(45 / (16 * pi)), x * y * (6 * z**2 - x**2 - y**2)),
            (-sqrt(45 / (32 * pi)), y * z * (4 * z**2 - 3 * x**2 - 3 * y**2)),
            (sqrt(9 / (256 * pi)), 8 * z**4 - 24 * z**2 * (x**2 + y**2) + 3 * (x**2 + y**2) ** 2),
            (-sqrt(45 / (32 * pi)), x * z * (4 * z**2 - 3 * x**2 - 3 * y**2)),
            (sqrt(45 / (64 * pi)), (x**2 - y**2) * (6 * z**2 - x**2 - y**2)),
            (-sqrt(315 / (32 * pi)), x * z * (x**2 - 3 * y**2)), (sqrt(315 / (256 * pi)), x**4 - 6 * x**2 * y**2 + y**4),
        ],
    ]  # fmt: skip
    values = [c * p for row in rows[: degree + 1] for c, p in row]
    # a plain sum, not einsum, whose order and roundings a library chooses by the processor
    return sum(value[:, None] * sh[:, k] for k, value in enumerate(values))
