"""Real spherical harmonics from scipy's complex ones, with the sign convention of the 3DGS papers."""

import numpy as np
import torch
from scipy.special import sph_harm_y


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
