"""Numbers that decide what is drawn, each with its derivation, and the rules made of them."""

from __future__ import annotations

from dataclasses import dataclass

ALPHA_CUT = 1.0 / 255.0
"""Smallest alpha that is blended: half of what an 8-bit channel resolves, doubled (Kerbl et al. 2023, renderer)."""

TRANSMITTANCE_STOP = 1e-4
"""A pixel is finished below this transmittance. Tied to the clamp: (1 - 0.99)^2 = 1e-4, two opaque layers."""

ALPHA_MAX = 0.99
"""Largest alpha of one Gaussian, so that 1 / (1 - alpha) in the backward pass stays below 100."""

LOW_PASS = 0.3
"""Variance added to both image axes [px^2]: about the box filter of one pixel (1/12) plus margin against aliasing."""

NEAR = 0.01
"""Nearest depth that is drawn [u]."""

FAR = 1e10
"""Farthest depth that is drawn [u]. This and the next five are wide of anything seen, and narrow enough that no product on the
way to a gradient leaves float32 (docs/extremes.md): what is drawn has finite gradients, and float64 draws the same."""

FARTHEST_PIXEL = 1e9
"""Largest coordinate of a projected mean [px]. Beyond, floats are 64 px and more apart."""

LARGEST_AXIS = 1e30
"""Largest component of a projected axis [px]."""

SMALLEST_DETERMINANT = 1e-36
"""Smallest determinant of a shrunk covariance, and smallest of its entries (docs/project.md, section 4)."""

SHORTEST_QUAT = 1e-15
"""Shortest quaternion that gives a rotation; the longest is 1 / SHORTEST_QUAT. Its gradient is divided by the length."""

LARGEST_COEFFICIENT = 1e6
"""Largest magnitude of a spherical-harmonics coefficient that is read."""

FRUSTUM_MARGIN = 0.15
"""The Jacobian is taken at the projected mean clamped to the image grown by this share of its size on every side,
which is the factor 1.3 on tan(fov / 2) of Kerbl et al. 2023 for a centred principal point."""


@dataclass(frozen=True)
class Rule:
    """One consistent set of cut-offs for projecting and blending."""

    name: str
    """Its name in options and reports."""
    alpha_cut: float = ALPHA_CUT
    """Contributions with a smaller alpha are skipped; 0 keeps them all, and every Gaussian then spans every tile."""
    alpha_max: float = ALPHA_MAX
    """Alpha is clamped to this; where clamped, its gradient is zero."""
    transmittance_stop: float = TRANSMITTANCE_STOP
    """A pixel stops once its transmittance is below this."""
    inclusive_stop: bool = True
    """True: the Gaussian that crosses the stop is still blended, so what lies behind keeps at most 1e-4 of the pixel
    and accumulated alpha is monotone in every opacity within that. False: it is dropped, and up to 1e-2 leaks."""
    near: float = NEAR
    """Nearest depth drawn [u]."""
    low_pass: float = LOW_PASS
    """Variance added to both image axes [px^2]."""
    square_sigma: float = 0.0
    """0: a Gaussian reaches exactly where alpha >= alpha_cut. Else it reaches the tiles that the square of half side
    ceil(square_sigma * longest axis) touches, as the first 3DGS renderer did."""


RULES = {
    "exact": Rule("exact"),
    # Faster and less accurate, by measured prices: docs/trade.md. A stop of 1e-2 would save more before opaque walls, and make
    # gradients there wrong by a third.
    "balanced": Rule("balanced", alpha_cut=2.0 / 255.0, transmittance_stop=1e-3),
    "fast": Rule("fast", alpha_cut=4.0 / 255.0, transmittance_stop=1e-3),
    # gsplat 1.5.3: MAX_ALPHA 0.999, exclusive stop. Its extent of 3.33 sigma never binds: sqrt(2 ln 255) = 3.329.
    "gsplat": Rule("gsplat", alpha_max=0.999, inclusive_stop=False),
    # diff-gaussian-rasterization (2023): near plane 0.2, square of 3 sigma.
    "inria": Rule("inria", inclusive_stop=False, near=0.2, square_sigma=3.0),
}
