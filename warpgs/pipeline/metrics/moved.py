"""Detection of moved objects: places where one training view differs from the model while other views agree with it."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from warpgs.geometry import back_project, project_points
from warpgs.priors.epipolar import nearest_views, pixel_grid
from warpgs.scene import Camera, View

MAX_PIXELS = 20_000
"""Largest number of pixels of the reduced views that are compared."""
MIN_RESIDUAL = 0.05
"""Least residual, in [0, 1], of a pixel that differs from the model."""
MIN_FACTOR = 3.0
"""Least ratio of a differing pixel's residual to the residual of other views at the same point."""
FLOOR = 0.005
"""Lower bound, in [0, 1], of the residual of other views in the ratio for `MIN_FACTOR`."""
MIN_VIEWS = 2
"""Fewest other views that must show a point."""
MIN_TRAINING = 6
"""Fewest training views for this check: with fewer, the model can fit objects that only one view shows."""
NEIGHBORS = 8
"""Number of nearest views in which a point is looked up."""
MAX_DEPTH_ERROR = 0.1
"""Largest relative difference between the depths at which two views show the same point."""
MIN_AREA = 0.004
"""Least area of a reported region, as a fraction of the image; in static scenes regions reach 0.002 (decision 019)."""
MAX_MISFIT = 5.0
"""A view fits badly as a whole if its median residual exceeds the median over views by this factor; no region of it is
reported."""
HIGH_MISFIT = 0.002
"""The fit is too early for this check if the median over views of their median residuals exceeds this; finished fits reach
0.001."""
LOW_MISFIT = 0.0005
"""Lower bound, in [0, 1], of the median over views to which `MAX_MISFIT` is applied."""
SMOOTHING = 32
"""Image width divided by the side of the square in which residuals are averaged."""


class Rendered(NamedTuple):
    """Render of a training view."""

    rgb: np.ndarray
    """Colours, shape [H, W, 3]."""
    depth: np.ndarray
    """z-depth [u], 0 for empty pixels; shape [H, W]."""
    alpha: np.ndarray
    """Opacity in [0, 1], shape [H, W]."""


class _Small(NamedTuple):
    """A view reduced to `MAX_PIXELS`."""

    camera: Camera
    residual: np.ndarray
    depth: np.ndarray
    counts: np.ndarray


def _reduced(view: View, render: Rendered) -> _Small:
    """Return the residuals of a view beyond what a shift by one pixel explains, shape [H, W], at a small size."""
    import cv2

    c = view.camera
    shrink = min(1.0, (MAX_PIXELS / (c.width * c.height)) ** 0.5)
    width, height = max(1, int(c.width * shrink)), max(1, int(c.height * shrink))
    image, rgb = (
        cv2.resize(a.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
        for a in (view.image, np.clip(render.rgb, 0, 1))
    )
    depth, alpha = (
        cv2.resize(a.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST) for a in (render.depth, render.alpha)
    )
    around = np.ones((3, 3), np.uint8)
    beyond = np.maximum(np.maximum(cv2.erode(image, around) - rgb, rgb - cv2.dilate(image, around)), 0).mean(-1)
    side = max(3, round(width / SMOOTHING) | 1)
    counts = (alpha > 0.5) & (depth > 0)
    if view.mask is not None:
        counts &= cv2.resize(view.mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    K = np.diag([width / c.width, height / c.height, 1]) @ c.K
    return _Small(replace(c, K=K, width=width, height=height), cv2.blur(beyond, (side, side)), depth, counts)


def _residuals_elsewhere(small: Sequence[_Small], index: int, others: Sequence[int]) -> np.ndarray:
    """Return the residuals of other views at the points of one view, NaN where they do not show it, shape [others, H * W]."""
    own = small[index]
    depths = np.where(own.counts, own.depth, 1).ravel().astype(float)
    points = back_project(own.camera, pixel_grid(own.camera), depths)
    found = np.full((len(others), len(points)), np.nan)
    for row, j in enumerate(others):
        other = small[j]
        pixels, z = project_points(other.camera, points)
        size = np.array([other.camera.width, other.camera.height])
        inside = np.flatnonzero((z > 0) & (pixels >= 1).all(1) & (pixels < size - 1).all(1))
        x, y = pixels[inside].astype(int).T
        shown = np.abs(other.depth[y, x] - z[inside]) < MAX_DEPTH_ERROR * z[inside]
        found[row, inside[shown]] = other.residual[y[shown], x[shown]]
    return found


def moved_fractions(views: Sequence[View], renders: Iterable[Rendered]) -> list[float]:
    """Return for each training view the fraction of its pixels, in [0, 1], in regions that other views show differently.

    A pixel is included if the view's residual is much larger than the residuals of other views at the same point, and at least
    two other views show this point. All fractions are 0 for fewer than `MIN_TRAINING` views, and for an unconverged fit.

    Args:
        views: The training views, at least one.
        renders: Render of each by the finished model, in the same order.
    """
    import cv2

    if len(views) < MIN_TRAINING:
        return [0.0] * len(views)
    small = [_reduced(v, r) for v, r in zip(views, renders, strict=True)]
    misfits = [float(np.median(s.residual)) for s in small]
    usual = float(np.median(misfits))
    fractions = []
    for i, s in enumerate(small):
        others = nearest_views(views, i, NEIGHBORS)
        if usual > HIGH_MISFIT or misfits[i] > MAX_MISFIT * max(usual, LOW_MISFIT):
            fractions.append(0.0)
            continue
        elsewhere = _residuals_elsewhere(small, i, others)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # points that no other view shows
            typical = np.nanmedian(elsewhere, axis=0).reshape(s.residual.shape)
        shown = (np.isfinite(elsewhere).sum(0) >= MIN_VIEWS).reshape(s.residual.shape)
        differs = s.counts & shown & (s.residual > MIN_RESIDUAL)
        differs &= s.residual > MIN_FACTOR * np.maximum(np.nan_to_num(typical), FLOOR)
        _, _, statistics, _ = cv2.connectedComponentsWithStats(differs.astype(np.uint8))
        areas = statistics[1:, cv2.CC_STAT_AREA] / s.residual.size
        fractions.append(round(float(areas[areas >= MIN_AREA].sum()), 4))
    return fractions


def moved_notes(fractions: dict[str, float]) -> list[str]:
    """Return a note that names the views with moved regions, the largest fraction of moved pixels first; empty without any."""
    named = sorted(((f, name) for name, f in fractions.items() if f > 0), reverse=True)
    if not named:
        return []
    words = ", ".join(f"{name} ({f:.1%} of its pixels)" for f, name in named[:6])
    more = f" and {len(named) - 6} more" if len(named) > 6 else ""
    return [f"moving or changing objects in {words}{more}; mask them out"]
