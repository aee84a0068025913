"""How far an op may be from its float64 twin: one table by scalar type, each with the value that was measured."""

import torch

RELATIVE_L2 = {
    # quantity: (float32, float64); measured on the scenes of tests/splats.py, CPU, times about 4
    "projection": (2e-6, 1e-13),  # measured 3.8e-7, 3.5e-16
    "image": (2e-6, 1e-13),  # measured 2.9e-7, 1.5e-16
    "gradient": (2e-5, 1e-12),  # measured 2.6e-6 (quats), 1.5e-14
    "ssim": (1e-5, 1e-12),  # measured 1.5e-6, 1e-15
    "sh": (1e-6, 1e-14),  # measured 1.5e-7, 2e-16
}


def close(quantity: str, found: torch.Tensor, wanted: torch.Tensor) -> None:
    """Assert that the relative L2 distance keeps the table's limit and that both are finite and of one shape."""
    limit = RELATIVE_L2[quantity][0 if found.dtype == torch.float32 else 1]
    found, wanted = found.detach().cpu().double(), wanted.detach().cpu().double()
    assert found.shape == wanted.shape, f"{quantity}: shape {tuple(found.shape)}, wanted {tuple(wanted.shape)}"
    assert bool(torch.isfinite(found).all()), f"{quantity}: not finite"
    scale = max(float(wanted.norm()), 1e-30)
    error = float((found - wanted).norm()) / scale
    assert error <= limit, f"{quantity}: relative L2 distance {error:.2e} exceeds {limit:.0e}"
