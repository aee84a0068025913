"""Options of the rasterizer."""

import math
from dataclasses import dataclass, replace
from numbers import Real
from typing import Self

import numpy as np
import torch

from warpgs.constants import FAR, Rule, rule_named
from warpgs.errors import UsageError, document_fields
from warpgs.kernels.falloff import Pass
from warpgs.kernels.tiles import MAX_INSTANCES
from warpgs.render.compose import pass_of
from warpgs.scene import Camera, RasterizedGaussians

SWITCHES = ("contributions", "median_depth", "error_bound", "deterministic", "absgrad", "antialiased", "record")
"""Options that are True or False."""
WHOLE_NUMBERS = ("sh_degree", "tile_size", "heaviest", "memory_budget", "capacity", "max_instances")
"""Options that are integers; all but ``tile_size`` and ``heaviest`` may be None."""
BEYOND_IMAGES = (
    "colors", "features", "contributions", "median_depth", "heaviest", "error_bound", "absgrad", "pixels", "max_instances",
)  # fmt: skip
"""Options that exclude ``max_error``."""
TILE_SIZES = (8, 16)
"""Supported sides of a tile [px]."""


def _is_whole(value: object) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _has_bound(rule: Rule) -> bool:
    """Return whether ``max_error`` supports a rule. The stop of rule fast, 1e-3, keeps four times the stop below 1/255."""
    return rule.inclusive_stop and rule.alpha_cut > 0 and 0 < rule.transmittance_stop <= 1e-3 and rule.square_sigma == 0


@document_fields
@dataclass(frozen=True)
class RasterizeOptions:
    """Options of `rasterize`."""

    rule: str | Rule = "exact"
    """Cut-offs: exact, balanced, fast (docs/numerics.md), gsplat-1.6, gsplat-1.5, inria, or a `Rule` of your own."""
    near: float | None = None
    """Nearest depth rendered, in the units of the Gaussians, at least 0; None for the value of the rule, 0.01 in `exact`. Whole
    Gaussians are culled by the depth of their mean: z in camera axes or, for a fisheye, the distance."""
    far: float | None = None
    """Farthest depth rendered, beyond ``near`` and at most 1e10; None for the value of the rule, 1e10."""
    sh_degree: int | None = None
    """Spherical-harmonics degree to use; None for the stored degree."""
    background: torch.Tensor | None = None
    """Background colour, shape [3] or [C, 3]; if ``colors`` has D channels, [D] or [C, D]. None for black. Differentiable."""
    colors: torch.Tensor | None = None
    """Colours that replace the spherical harmonics, shape [N, D], or [C, N, D] for different ones per camera. Any number of
    channels D and finite values of any sign and size are allowed; values are never clamped. `Render.rgb` then has D channels.
    Differentiable; ``sh`` has no gradient then. None for the spherical harmonics."""
    features: torch.Tensor | None = None
    """Channels to render besides the colours, shape [N, D] or [C, N, D], with any values as in ``colors``. `Render.features`
    has the result, blended with the same weights. Differentiable."""
    feature_background: torch.Tensor | None = None
    """Background of the features, shape [D] or [C, D]; None for zeros. Differentiable."""
    tile_size: int = 16
    """Side of a tile [px]: 8 or 16. The image depends on the tile size only under rules with ``square_sigma``, such as
    inria."""
    contributions: bool = False
    """True to also return sum and maximum of each Gaussian's blending weights over the pixels."""
    median_depth: bool = False
    """True to also render the depth at which transmittance falls to one half."""
    heaviest: int = 0
    """Number k of Gaussians of largest blending weight to return for each pixel: ``Render.heaviest_ids``, ``heaviest_weights``
    and ``blend_counts``. 0 for none."""
    error_bound: bool = False
    """True to also bound the error of ``rgb`` against rule `exact`. The bound of a pixel is its difference from a float64
    render under `exact`, plus the rounding of float64. So the bound covers both cut-offs and float32 rounding. The float64
    render takes several times as long as one in float32 (docs/numerics.md). Not with ``capacity``."""
    max_error: float | None = None
    """Largest error of ``rgb`` against the same call without this option, such as 1/255, to save time on CUDA: colours are
    rounded to 16 bits, and pixels finish at a higher transmittance. ``Render.error_bound`` is then a proven bound, one number
    for all pixels of a camera (docs/numerics.md); it exceeds ``max_error`` only below 0.001 (balanced, fast: 0.003) times the
    largest colour. Alpha and depth have no bound. Without gradients, for spherical harmonics, and for rules exact, balanced
    and fast. None for no error."""
    memory_budget: int | None = None
    """Bytes that the (Gaussian, tile) instances may take at a time; None for four fifths of the free memory. With
    ``max_instances``, the chunks keep to both limits."""
    deterministic: bool = True
    """True to sum gradients in a fixed order, so that the same inputs give the same bits. False takes less memory on CUDA."""
    absgrad: bool = False
    """True to also sum the magnitudes of each projected mean's gradient over the pixels: ``Render.means2d.absgrad``. It
    supports at most 11 channels of ``colors``, and no ``features``. Such calls are not captured as CUDA graphs."""
    antialiased: bool = False
    """True to multiply each opacity by sqrt(det(cov2d) / det(cov2d + low_pass I)), the 2D filter of Mip-Splatting. It removes
    the brightness that widening by ``Rule.low_pass`` adds to Gaussians smaller than a pixel. Use it for models trained with
    antialiasing."""
    opacity_factors: torch.Tensor | None = None
    """Factors of the opacities, at least 0, shape [N]; 0 hides a Gaussian. None for 1. Not differentiable."""
    capacity: int | None = None
    """Number of (Gaussian, tile) instances to allocate memory for; None for as many as there are. With a capacity nothing is
    read back from the device, so the call can be captured in a CUDA graph. Check `Render.overflow` before you use the
    result."""
    window: tuple[int, int, int, int] | None = None
    """Left, top, width and height [px] of the part to render. The result equals the crop of the whole image bit for bit. Edges
    must be multiples of ``tile_size`` or edges of the image. None for the whole image."""
    pixels: torch.Tensor | None = None
    """Pixels to render instead of an image: integers (column, row), shape [P, 2], or [C, P, 2] for different ones per camera.
    Images of `Render` then have P instead of H, W. Their values equal the whole image's values at these pixels, bit for bit.
    Differentiable. Only tiles with a listed pixel are blended. Not with ``window``, ``contributions`` or ``capacity``. None for
    the whole image."""
    max_instances: int | None = None
    """Largest number of (Gaussian, tile) instances at a time. An image with more is rendered in chunks, and each chunk again
    for its gradients. This gives the same image with less memory and more time. None for no limit. Not with ``capacity``."""
    record: bool = True
    """True to replay repeated calls of a loop as CUDA graphs, with the same bits in half the time. Only calls with
    ``deterministic`` are replayed, and calls without gradients only in the main thread. Calls with colors, features, opacity
    factors, contributions, median depth, heaviest, error bound, absgrad, pixels, or a limit on memory or instances are not
    replayed (docs/decisions/010-recorded-calls.md). Use False if other threads wait for the whole device, as
    torch.cuda.synchronize does."""

    def __post_init__(self) -> None:
        """Check types, ranges, and options that exclude each other; what depends on the camera is checked by `rasterize`.

        Raises:
            UsageError: An option has the wrong type or is out of range, options exclude each other, or the rule is unknown.
            ValueError: The near or the far plane is out of range.
        """
        for name in SWITCHES:
            if not isinstance(getattr(self, name), (bool, np.bool_)):
                raise UsageError(f"{name} must be True or False, not {getattr(self, name)!r}")
        for name in WHOLE_NUMBERS:
            value = getattr(self, name)
            if not (_is_whole(value) or (value is None and name not in ("tile_size", "heaviest"))):
                raise UsageError(f"{name} must be a whole number, not {value!r}")
            if (value or 0) < 0 and name not in ("tile_size", "max_instances"):
                raise UsageError(f"{name} must be at least 0, not {value}")
        for name in ("near", "far"):
            value = getattr(self, name)
            if value is not None and (isinstance(value, bool) or not isinstance(value, Real)):
                raise UsageError(f"{name} must be a number, not {value!r}")
        four = isinstance(self.window, (tuple, list)) and len(self.window) == 4 and all(map(_is_whole, self.window))
        if self.window is not None and not four:
            raise UsageError(f"window must be four whole numbers, not {self.window!r}")
        if self.tile_size not in TILE_SIZES:
            raise UsageError(f"tile size {self.tile_size} is not one of {', '.join(map(str, TILE_SIZES))}")
        if self.max_instances is not None and (self.capacity is not None or self.max_instances < 1):
            raise UsageError(f"max_instances must be at least 1 ({self.max_instances}), without capacity ({self.capacity})")
        if self.pixels is not None and (self.window or self.contributions or self.capacity is not None):
            raise UsageError("RasterizeOptions.pixels cannot be combined with window, contributions or capacity; omit pixels")
        if self.capacity is not None and self.capacity > MAX_INSTANCES:
            raise UsageError(f"capacity must be at most {MAX_INSTANCES:,}, not {self.capacity:,}")
        if self.error_bound and self.capacity is not None:
            raise UsageError("error_bound and capacity exclude each other: leave one out")
        if self.max_error is not None:
            self._check_max_error()
        if self.feature_background is not None and self.features is None:
            raise UsageError("feature_background requires features: give features=..., or leave feature_background out")
        self.cut_offs()

    def _check_max_error(self) -> None:
        """Raise UsageError where ``max_error`` is no positive number, or goes with an option or a rule that has no bound."""
        if isinstance(self.max_error, bool) or not isinstance(self.max_error, Real) or not 0 < self.max_error < math.inf:
            raise UsageError(f"max_error must be a positive number, such as 1/255, not {self.max_error!r}")
        for name in BEYOND_IMAGES:
            value = getattr(self, name)
            if value is not None and (isinstance(value, torch.Tensor) or value):
                raise UsageError(f"max_error and {name} exclude each other: leave one out")
        if not _has_bound(rule := self.cut_offs()):
            raise UsageError(f"max_error does not support rule {rule.name}: choose exact, balanced or fast")

    def cut_offs(self) -> Rule:
        """Return the rule, with the near and the far plane of the options.

        Raises:
            UsageError: The rule is unknown.
            ValueError: The near or the far plane is out of range.
        """
        rule = self.rule if isinstance(self.rule, Rule) else rule_named(self.rule)
        near, far = rule.near if self.near is None else self.near, rule.far if self.far is None else self.far
        if not 0 <= near < far <= FAR:
            raise ValueError(f"near {near} and far {far} are not a range of depths: give 0 <= near < far <= {FAR:g}")
        return rule if (near, far) == (rule.near, rule.far) else replace(rule, near=near, far=far)

    def for_display(self, gaussians: RasterizedGaussians) -> Self:
        """Return the options for images of 8 bits that are only looked at: on CUDA with ``max_error`` of one level."""
        fast = gaussians.means.is_cuda and gaussians.means.dtype == torch.float32 and _has_bound(self.cut_offs())
        return replace(self, max_error=1 / 255) if fast else self

    def repeatable(self) -> bool:
        """Return whether calls with these options may be captured as CUDA graphs."""
        others = (self.colors, self.features, self.opacity_factors, self.memory_budget, self.capacity, self.max_instances)
        extra = self.contributions or self.median_depth or self.heaviest or self.absgrad or self.error_bound
        return self.record and self.deterministic and not extra and all(o is None for o in (*others, self.pixels))


def image_settings(camera: Camera, degree: int, options: RasterizeOptions) -> Pass:
    """Return the settings of whole images; cut-offs, antialiasing and tile size are those of the options."""
    return pass_of(camera, degree, options.cut_offs(), antialiased=options.antialiased, tile_size=options.tile_size)
