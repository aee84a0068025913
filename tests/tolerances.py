"""How far an op may be from its float64 twin, and the error budget of a whole picture; each with what was measured."""

from dataclasses import dataclass

import torch

RELATIVE_L2 = {
    # quantity: (float32, float64); measured on the scenes of tests/gaussians.py, CPU, times about 4
    "projection": (2e-6, 1e-13),  # measured 3.8e-7, 3.5e-16
    "image": (2e-6, 1e-13),  # measured 2.9e-7, 1.5e-16
    "gradient": (2e-5, 1e-12),  # measured 2.6e-6 (quats), 1.5e-14
    "ssim": (1e-5, 1e-12),  # measured 1.5e-6, 1e-15
    "sh": (1e-6, 1e-14),  # measured 1.5e-7, 2e-16
}


@dataclass(frozen=True)
class ParameterBounds:
    """Largest E of one kind of scene (docs/numerics.md says what each is and what was measured where)."""

    image_mean: float
    """Of rgb, alpha, and depth over the largest depth."""
    image_max: float
    """The same, in one pixel; for ordinary scenes beside what storing means in float32 costs."""
    relative_l2: float
    """Of every gradient."""
    cosine: float
    """1 - cosine of every gradient."""
    bias: float
    """Mean of the error of a gradient over the mean of its magnitude."""
    band: float
    """Share of pixels so near a threshold that rounding decides."""
    flips: int
    """Pixels in a band whose error exceeds what is allowed outside."""


ORDINARY = ParameterBounds(
    image_mean=2e-6,  # measured 1.5e-6 (strip), 1.8e-7 (else)
    image_max=2e-6,  # measured 2.8e-5 of 1.9e-4 allowed (strip), 2.6e-6 of 8e-6 (else)
    relative_l2=1e-4,  # measured 1.8e-5 (strip), 5.1e-6 (else)
    cosine=1e-9,  # measured 1.6e-10
    bias=2e-5,  # measured 5.4e-6
    band=0.01,  # measured 0.002
    flips=1,  # measured 0
)
STRESS = ParameterBounds(
    image_mean=2e-5,  # measured 6.3e-6 (far right), 4.4e-6 (far origin)
    image_max=1e-4,  # measured 5.1e-5 (far right), 3.7e-5 (far origin), 3.0e-6 (needles)
    relative_l2=1e-3,  # measured 3.6e-4 (far right), 4.4e-5 (far origin), 1.6e-5 (needles)
    cosine=1e-7,  # measured 1.5e-8
    bias=2e-4,  # measured 9.8e-5 (far right), 2.2e-5 (else)
    band=0.06,  # measured 0.048 (far right)
    flips=1,  # measured 0
)

RATIO = 2.0
"""How many times the error of the plain float32 program is allowed, beside the floors below."""
IMAGE_ULPS = 2.0
"""Floor of a picture's error in ulps of its largest value, or of its mean for the mean; without it exact scenes would fail."""
GRADIENT_ULPS = 8.0  # measured 4.2 (blobs: the background, three numbers that are sums of 3072 of either sign)
"""Floor of a gradient's error, the same way, beside what layers add."""
LAYER_ULPS = {
    "cpu": 1.0,  # measured: fog, 893 layers, 14 ulps in all
    "cuda": 3.0,  # measured on an H200: fog, 76 ulps
}
"""What the layers of a pixel add to that floor, times the square root of their number: roundings add up like a random walk.
On a CPU the backward pass recovers transmittance by a division a layer. On CUDA ``ex2.approx`` errs by up to 2 ulps a layer
(PTX manual), and what lies behind a layer is the pixel's colour less what lies before, one more."""

GAIN = 0.01  # measured 6.4e-3
"""Error of a gain without rendering as a fraction of the largest one: the blur has no low-pass filter and ends at 3 sigma."""
OPACITY_DECAY = 1e-6
"""Relative error of a decayed opacity, 1 - 1e-6 and less, in float32 logits: 5.3e-7."""


def close(quantity: str, found: torch.Tensor, wanted: torch.Tensor) -> None:
    """Assert that the relative L2 distance keeps the table's limit and that both are finite and of one shape."""
    limit = RELATIVE_L2[quantity][0 if found.dtype == torch.float32 else 1]
    found, wanted = found.detach().cpu().double(), wanted.detach().cpu().double()
    assert found.shape == wanted.shape, f"{quantity}: shape {tuple(found.shape)}, wanted {tuple(wanted.shape)}"
    assert bool(torch.isfinite(found).all()), f"{quantity}: not finite"
    scale = max(float(wanted.norm()), 1e-30)
    error = float((found - wanted).norm()) / scale
    assert error <= limit, f"{quantity}: relative L2 distance {error:.2e} exceeds {limit:.0e}"
