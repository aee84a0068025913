"""Numbers of the rasterizer, and the rules that choose among them."""

import math
from dataclasses import dataclass
from numbers import Real

from warpgs.errors import UsageError, document_fields, expect, explained

ALPHA_CUT = 1.0 / 255.0
"""Smallest alpha that is blended: one step of an 8-bit channel (renderer of Kerbl et al. 2023)."""

TRANSMITTANCE_STOP = 1e-4
"""Transmittance below which a pixel is finished: the transmittance behind two layers of the largest alpha, (1 - 0.99)^2 =
1e-4."""

ALPHA_MAX = 0.99
"""Largest alpha of one Gaussian, so that 1 / (1 - alpha) in the backward pass stays below 100."""

LARGEST_ALPHA = 1 - 2.0**-24
"""Largest value of ``Rule.alpha_max``: the largest float32 below 1. The backward pass divides by 1 - alpha."""

LOW_PASS = 0.3
"""Variance added to a projected Gaussian along both image axes [px^2]: the variance of a pixel's box filter, 1/12, plus a
margin against aliasing."""

TILE_SIZE = 16
"""Default side of a tile [px], also in fits."""

K_TOLERANCE = 1e-5
"""Largest accepted error of the fixed entries of K, the zeros and the 1. Such an error moves the pixels of an image of 2000 px
by 0.02 px."""

POSE_TOLERANCE = 1e-3
"""Largest accepted error of an entry of R R^T - 1 and of a pose's last row. The product of a thousand rotations in
float32 is off by at most 1000 x 3 x 2^-23 = 4e-4. An error as large as the tolerance changes lengths by 0.05 %."""

NEAR = 0.01
"""Nearest depth that is rendered [u]."""

FAR = 1e10
"""Farthest depth that is rendered [u]. This limit, `FARTHEST_PIXEL`, `LARGEST_AXIS`, `SMALLEST_DETERMINANT`, `SHORTEST_QUAT`
and `LARGEST_COEFFICIENT` are far beyond any usual scene. They are narrow enough that no product in the backward pass overflows
float32 (docs/numerics.md). So every rendered Gaussian has finite gradients, and float64 renders the same Gaussians."""

FARTHEST_PIXEL = 1e9
"""Largest coordinate of a projected mean [px]. Beyond it, neighbouring floats are 64 px and more apart."""

LARGEST_AXIS = 1e30
"""Largest component of a projected axis [px]."""

SMALLEST_DETERMINANT = 1e-36
"""Smallest determinant, and smallest yy entry, of a scaled-down projected covariance (docs/project.md, section 4)."""

SHORTEST_QUAT = 1e-15
"""Length of the shortest quaternion that gives a rotation; the longest has the length 1 / SHORTEST_QUAT. The gradient of a
quaternion is divided by its length."""

COVARIANCE_TOLERANCE = 1e-5
"""Largest magnitude of a negative eigenvalue that counts as 0, as a fraction of the covariance's largest variance: 80 roundings
of float32. The eigenvalue is that of the remainder S in docs/project.md, section 9; if it is lower, the Gaussian is culled."""

LARGEST_COEFFICIENT = 1e6
"""Largest magnitude of a spherical-harmonics coefficient that is read."""

LARGEST_HALF = 65504.0
"""Largest number in half precision."""

SMALLEST_WEIGHT = 1e-20
"""Smallest sum of blending weights at which a pixel has a depth. The gradient of depth is multiplied by depths up to `FAR` and
divided by this sum: the factor is at most 1e30, within float32. Smaller sums occur only with an alpha cut of 0."""

FRUSTUM_MARGIN = 0.15
"""Margin around the image, as a fraction of its size on every side. The Jacobian is taken at the projected mean, clamped to the
image with this margin. For a centred principal point, that is the factor 1.3 on tan(fov / 2) of Kerbl et al. 2023."""

RIM_SAMPLES = 16
"""Number of points, from the axis to a position, at which a lens is tested for folding back; the position is the last."""


@document_fields
@dataclass(frozen=True)
class Rule:
    """A consistent set of cut-offs for projection and blending.

    Lengths [u] are in the unit of the Gaussians.
    """

    name: str
    """Name in options and reports."""
    alpha_cut: float = ALPHA_CUT
    """Smallest alpha that is blended, 1/255 by default. With 0 all are blended, and every Gaussian touches every tile."""
    alpha_max: float = ALPHA_MAX
    """Largest alpha, at most 1 - 2^-24; larger values are clamped to it and have no gradient."""
    transmittance_stop: float = TRANSMITTANCE_STOP
    """Transmittance below which a pixel is finished."""
    inclusive_stop: bool = True
    """True to blend the Gaussian at which transmittance falls below the stop. With the default stop, at most 1e-4 of the pixel
    is then lost, and alpha is monotone in every opacity up to that amount. False to drop this Gaussian, which loses up to
    ``transmittance_stop`` / (1 - ``alpha_max``): 1e-2, or 0.1 for rule gsplat-1.5."""
    near: float = NEAR
    """Nearest depth rendered [u], at least 0."""
    far: float = FAR
    """Farthest depth rendered [u], at most 1e10."""
    low_pass: float = LOW_PASS
    """Variance added to a projected Gaussian along both image axes [px^2]."""
    square_sigma: float = 0.0
    """0 to render a Gaussian exactly where alpha >= alpha_cut. Otherwise it is rendered in all tiles that a square of half side
    ceil(square_sigma * longest axis) touches, as in the first 3DGS renderer."""

    def __post_init__(self) -> None:
        """Check types and ranges; the ranges of ``near`` and ``far`` are checked where they are used.

        Raises:
            UsageError: A cut-off is not a number, or is outside its range.
        """
        with explained("a Rule is impossible", "give another value", ValueError, UsageError):
            for name in ("alpha_cut", "alpha_max", "transmittance_stop", "near", "far", "low_pass", "square_sigma"):
                expect(isinstance(value := getattr(self, name), Real), f"{name} must be a number, not {value!r}")
            for name in ("alpha_cut", "transmittance_stop"):
                expect(0 <= (value := getattr(self, name)) < 1, f"{name} must be at least 0 and below 1, not {value}")
            expect(0 < self.alpha_max <= LARGEST_ALPHA, f"alpha_max must be in (0, 1) as float32, not {self.alpha_max}")
            for name in ("low_pass", "square_sigma"):
                expect(0 <= (value := getattr(self, name)) < math.inf, f"{name} must be finite and at least 0, not {value}")
            expect(isinstance(self.inclusive_stop, bool), f"inclusive_stop must be True or False, not {self.inclusive_stop!r}")


RULES = {
    "exact": Rule("exact"),
    # Faster and less accurate, as measured in docs/numerics.md. A stop of 1e-2 would save more time in front of opaque
    # surfaces, but gradients there would be wrong by a third.
    "balanced": Rule("balanced", alpha_cut=2.0 / 255.0, transmittance_stop=1e-3),
    "fast": Rule("fast", alpha_cut=4.0 / 255.0, transmittance_stop=1e-3),
    # gsplat: exclusive stop. Its extent of 3.33 sigma never binds: sqrt(2 ln 255) = 3.329. The clamp of
    # alpha was 0.999 up to 1.5.3.
    "gsplat-1.6": Rule("gsplat-1.6", inclusive_stop=False),
    "gsplat-1.5": Rule("gsplat-1.5", alpha_max=0.999, inclusive_stop=False),
    # diff-gaussian-rasterization (2023): near plane 0.2, square of 3 sigma.
    "inria": Rule("inria", inclusive_stop=False, near=0.2, square_sigma=3.0),
}
"""Rules by name."""


def rule_named(name: str) -> Rule:
    """Return the rule of a name.

    Raises:
        UsageError: The name is unknown.
    """
    if name in RULES:
        return RULES[name]
    if versions := [known for known in RULES if known.startswith(f"{name}-")]:
        raise UsageError(f"rule {name!r} needs a version, because its cut-offs changed: choose {' or '.join(versions)}")
    raise UsageError(f"unknown rule {name!r}: choose one of {', '.join(RULES)}")
