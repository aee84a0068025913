"""The fastest rule within a given error, measured on the scene itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace
from numbers import Real

import torch

from warpgs.errors import UsageError
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

FASTEST_FIRST = ("fast", "balanced", "exact")
"""Rules to choose from; each skips all that the next one skips, and more."""
DEFAULTS = RasterizeOptions()
"""Default options."""
MEASURES: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {"mean": torch.mean, "max": torch.amax}
"""Reductions over the pixels of a view, by name."""


@torch.no_grad()
def select_rule(
    gaussians: Gaussians, cameras: Iterable[Camera], *, max_error: float, measure: str = "mean",
    options: RasterizeOptions = DEFAULTS,
) -> tuple[str, float]:  # fmt: skip
    """Return the fastest of the rules `fast`, `balanced` and `exact` whose error is at most ``max_error`` in every given view.

    Each view is rendered with `RasterizeOptions.error_bound`, so the limit covers cut-offs and float32, and holds only for
    these Gaussians, cameras and options. Each view takes up to three renders in float32 and three in float64.

    Args:
        gaussians: The scene, N Gaussians.
        cameras: Views to measure.
        max_error: Largest error against rule `exact`, in units of the colours, usually [0, 1].
        measure: ``mean`` or ``max`` over the pixels of a view; the error of a pixel is the largest of its channels.
        options: Options of the renders, such as the background; their rule is not used.

    Returns:
        The name of the rule, and its largest measured error over the views.

    Raises:
        UsageError: No rule keeps the limit, ``cameras`` is empty or a single camera, ``max_error`` is not a positive number, or
            the measure is unknown.
    """
    if not (isinstance(max_error, Real) and 0 < max_error < math.inf):
        raise UsageError(f"max_error must be a positive number, such as 0.002, not {max_error!r}")
    if measure not in MEASURES:
        raise UsageError(f"measure {measure!r} is not one of {', '.join(MEASURES)}")
    if isinstance(cameras, Camera):
        raise UsageError("select_rule takes a list of cameras, not one: give [camera]")
    views, error = list(cameras), 0.0
    if not views:
        raise UsageError("select_rule measures errors in views: give at least one camera")
    for rule in FASTEST_FIRST:
        error, own = 0.0, replace(options, rule=rule, error_bound=True)
        for camera in views:
            bound = rasterize(gaussians, camera, own).error_bound
            assert bound is not None
            error = max(error, float(MEASURES[measure](bound)))
            if error > max_error:
                break
        else:
            return rule, error
    raise UsageError(
        f"no rule keeps the {measure} error within {max_error:g}: with rule exact, rounding alone gives {error:.1e}; raise "
        "max_error, or give the Gaussians as float64"
    )
