"""Camera models outside of the kernels: from positions in camera axes to the image plane and back, for arrays or tensors.

The image plane holds points (u, v) that K takes to pixels: x / z and y / z for a pinhole. The kernels have their own formulas.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from warpgs.errors import UsageError

if TYPE_CHECKING:
    from warpgs.scene import Array

MODELS = ("pinhole", "orthographic", "opencv", "fisheye")
"""Camera models that are known here."""
CENTRAL = ("pinhole", "opencv", "fisheye")
"""Camera models with a centre of projection, which a pinhole of the same K can replace."""
NEWTON_STEPS = 30
"""Steps of Newton's method to invert the distortion. Five reach float64's precision for usual lenses. For a fisheye, a step
that leaves the bracket is replaced by a bisection."""


def check_known(model: str) -> None:
    """Check that a camera model is known here.

    Raises:
        UsageError: Only the kernels support the model.
    """
    if model not in MODELS:
        raise UsageError(
            f"outside the rasterizer only the camera models {', '.join(MODELS)} are supported, not {model!r}; undistort the "
            "images first"
        )


def _library(array: Array) -> Any:
    """Return the library of the array, numpy or torch."""
    if isinstance(array, np.ndarray):
        return np
    import torch

    return torch


def depth_of(model: str, positions: Array) -> Array:
    """Return the depths [...] [u] of positions in the camera [..., 3], as in renders: distance for a fisheye, else z."""
    if model == "fisheye":
        depth: Array = (positions**2).sum(-1) ** 0.5
        return depth
    return positions[..., 2]


def to_plane(model: str, distortion: Array | None, positions: Array) -> Array:
    """Return the points in the image plane [..., 2] of positions in the camera [..., 3].

    Points behind a pinhole or beyond the rim of a lens are meaningless: see `on_lens`.

    Raises:
        UsageError: The model is unknown here.
    """
    check_known(model)
    library, x, y, z = _library(positions), *(positions[..., i] for i in range(3))
    if model == "orthographic":
        return library.stack([x, y], -1)
    if model == "fisheye":
        r = library.hypot(x, y)
        angle = library.arctan2(r, z)
        scale = _bent(angle, distortion)[0] / library.where(r > 0, r, 1)
        scale = library.where(r > 0, scale, 1 / library.where(z == 0, 1, z))
        return library.stack([x * scale, y * scale], -1)
    a, b = x / z, y / z
    return library.stack(_distorted(a, b, distortion)[:2] if model == "opencv" else (a, b), -1)


def from_plane(model: str, distortion: Array | None, points: Array) -> Array:
    """Return the positions at depth 1 (`depth_of`) that project to points of the image plane; NaN for points off the lens.

    Shapes are [..., 2] for points and [..., 3] for positions. For an orthographic camera the result is (u, v, 1); positions
    (u, v, z) of all other depths share that point.

    Raises:
        UsageError: The model is unknown here.
    """
    check_known(model)
    library, u, v = _library(points), points[..., 0], points[..., 1]
    if model == "fisheye":
        radius = library.hypot(u, v)
        low, high = 0 * radius, 0 * radius + _rim(distortion)
        angle = library.where(radius < high, radius, high)
        for _ in range(NEWTON_STEPS):
            value, slope = _bent(angle, distortion)
            low, high = library.where(value < radius, angle, low), library.where(value < radius, high, angle)
            angle = angle - (value - radius) / library.where(slope > 0, slope, 1)
            angle = library.where((angle > low) & (angle < high), angle, 0.5 * (low + high))
        scale = library.where(radius > 0, library.sin(angle) / library.where(radius > 0, radius, 1), 1)
        found = library.stack([u * scale, v * scale, library.cos(angle)], -1)
    elif model == "opencv":
        a, b = u, v
        for _ in range(NEWTON_STEPS):
            du, dv, aa, ab, bb, _ = _distorted(a, b, distortion)
            determinant = aa * bb - ab * ab
            determinant = library.where(determinant == 0, 1, determinant)
            a, b = a - (bb * (du - u) - ab * (dv - v)) / determinant, b - (aa * (dv - v) - ab * (du - u)) / determinant
        found = library.stack([a, b, library.ones_like(a)], -1)
    else:
        return library.stack([u, v, library.ones_like(u)], -1)
    back = to_plane(model, distortion, found)
    missed = ~(library.hypot(back[..., 0] - u, back[..., 1] - v) <= 1e-4) | ~on_lens(model, distortion, found)
    return library.where(missed[..., None], np.nan, found)


def on_lens(model: str, distortion: Array | None, positions: Array, samples: int = 64) -> Array:
    """Return a mask [...], True where the lens is not folded between its axis and positions in the camera [..., 3].

    The lens is tested at ``samples`` points along the way. Positions behind a pinhole or opencv camera count as folded;
    positions in an orthographic camera never do.
    """
    library, z = _library(positions), positions[..., 2]
    if model == "orthographic":
        return z > -np.inf
    if model == "fisheye":
        angle = library.arctan2(library.hypot(positions[..., 0], positions[..., 1]), z)
        good = angle < np.pi
        for i in range(samples):
            good = good & (_bent(angle * ((i + 1) / samples), distortion)[1] > 0)
        return good
    good = z > 0
    if model == "opencv":
        a, b = (positions[..., i] / library.where(good, z, 1) for i in range(2))
        for i in range(samples):
            part = (i + 1) / samples
            s = (part / (1 + (1 - part) * (a * a + b * b))) ** 0.5  # evenly spaced in the squared sine of the angle
            _, _, aa, ab, bb, denominator = _distorted(s * a, s * b, distortion)
            good = good & (denominator > 0) & (aa + bb > 0) & (aa * bb - ab * ab > 0)
    return good


def _rim(distortion: Array) -> float:
    """Return the angle [rad] at which a fisheye folds back, at most pi."""
    angles = np.linspace(0, np.pi, 4097)[1:]
    folded = angles[_bent(angles, [float(k) for k in distortion])[1] <= 0]
    return float(folded[0]) if len(folded) else math.pi


def _bent(angle: Array, distortion: Sequence[float] | Array) -> tuple[Array, Array]:
    """Return the radius in the image plane at an angle [rad] from a fisheye's axis, and its derivative."""
    t, value, slope = angle * angle, 1.0, 1.0
    powers = t
    for i in range(4):
        value, slope = value + distortion[i] * powers, slope + (2 * i + 3) * distortion[i] * powers
        powers = powers * t
    return angle * value, slope


def _distorted(a: Array, b: Array, distortion: Array) -> tuple[Array, ...]:
    """Return the distorted point of (a, b), the three entries of its symmetric Jacobian, and the radial denominator."""
    k1, k2, p1, p2, k3, k4, k5, k6 = (distortion[i] for i in range(8))
    t = a * a + b * b
    numerator, denominator = 1 + t * (k1 + t * (k2 + t * k3)), 1 + t * (k4 + t * (k5 + t * k6))
    radial = numerator / denominator
    first = (k1 + t * (2 * k2 + 3 * t * k3) - radial * (k4 + t * (2 * k5 + 3 * t * k6))) / denominator
    return (
        a * radial + 2 * p1 * a * b + p2 * (t + 2 * a * a),
        b * radial + p1 * (t + 2 * b * b) + 2 * p2 * a * b,
        radial + 2 * a * a * first + 2 * p1 * b + 6 * p2 * a,
        2 * (a * b * first + p1 * a + p2 * b),
        radial + 2 * b * b * first + 6 * p1 * b + 2 * p2 * a,
        denominator,
    )
