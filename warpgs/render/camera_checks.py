"""Checks of the arrays of a camera. Values on a GPU are not checked: reading them would wait for the device."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from warpgs.constants import K_TOLERANCE, POSE_TOLERANCE
from warpgs.runtime import interop
from warpgs.scene import Camera


def check_arrays(camera: Camera) -> None:
    """Check types and shapes of a camera's arrays, the types of width and height, and the values of arrays in main memory.

    Raises:
        TypeError: An array is neither a numpy array nor a tensor, is sparse, or has values that are not real or have half
            precision; or width or height is not an integer.
        ValueError: A shape is wrong; a number is not finite; K has a focal length of 0, a skew or another last row than
            0, 0, 1; or a viewmat scales or shears, or has another last row than 0, 0, 0, 1.
    """
    for name, rows, tolerance, off, check in MATRICES:
        given: Any = getattr(camera, name)
        _check_type(name, given)
        if given.ndim not in (2, 3) or tuple(given.shape[-2:]) != (rows, rows):
            raise ValueError(f"camera.{name} must have shape [{rows}, {rows}] or [C, {rows}, {rows}], not {list(given.shape)}")
        if getattr(given, "is_cuda", False):
            continue
        listed = given.tolist()  # Python numbers take a third of the time of tensors
        for i, matrix in enumerate(listed if given.ndim == 3 else (listed,)):
            if not off(matrix) <= tolerance:  # also where a number is NaN or infinite; few matrices get further
                check(matrix, f"camera.{name}[{i}]" if given.ndim == 3 else f"camera.{name}")
    distortion: Any = camera.distortion
    if distortion is not None:
        _check_type("distortion", distortion)
        if distortion.ndim not in (1, 2):
            raise ValueError(f"camera.distortion must have shape [P] or [C, P], not {list(distortion.shape)}")
        if not (getattr(distortion, "is_cuda", False) or all(map(math.isfinite, distortion.reshape(-1).tolist()))):
            raise ValueError(f"camera.distortion has non-finite values: {distortion.tolist()}")
    for name in ("width", "height"):
        size = getattr(camera, name)
        if not isinstance(size, (int, np.integer)):
            raise TypeError(f"camera.{name} must be a whole number of pixels, not {size!r}")


def _check_type(name: str, array: Any) -> None:
    """Raise TypeError where a value is not a dense array of real numbers, and ValueError for a device without kernels."""
    if not isinstance(array, (np.ndarray, torch.Tensor)):
        raise TypeError(
            f"camera.{name} must be a numpy array or a tensor, not {type(array).__name__}; numpy.array or torch.stack makes one"
        )
    if isinstance(array, torch.Tensor):
        interop.check_device(f"camera.{name}", array)
        if array.layout != torch.strided:
            raise TypeError(f"camera.{name} must be dense, not {array.layout}; camera.{name}.to_dense() converts it")
    if str(array.dtype).removeprefix("torch.") in ("float16", "bfloat16"):
        raise TypeError(f"camera.{name} must be float32 or float64, not {array.dtype}: its rounding would shift the image")
    real = not array.is_complex() if isinstance(array, torch.Tensor) else array.dtype.kind in "fiub"
    if not real:
        raise TypeError(f"camera.{name} must hold real numbers, not {array.dtype}")


def _skew_of(matrix: list[list[float]]) -> float:
    """Return the sum of the errors of K's constant entries; non-finite if an entry of K is, or if a focal length is 0."""
    (fx, skew, cx), (below, fy, cy), (left, middle, last) = matrix
    if not (fx and fy):
        return math.inf
    return abs(skew) + abs(below) + abs(left) + abs(middle) + abs(last - 1) + 0 * (fx + cx + fy + cy)


def _check_intrinsics(matrix: list[list[float]], where: str) -> None:
    """Raise ValueError where the intrinsics are non-finite, or have a skew, a focal length of 0, or a wrong last row."""
    _check_finite(matrix, where)
    (fx, skew, _), (below, fy, _), (left, middle, last) = matrix
    if not (fx and fy):
        raise ValueError(f"{where} must have focal lengths other than 0, not {fx:g} and {fy:g}")
    if max(map(abs, (left, middle, last - 1))) > K_TOLERANCE:
        raise ValueError(f"{where} must have the last row 0, 0, 1, not {left:g}, {middle:g}, {last:g}; divide K by K[2, 2]")
    if max(abs(skew), abs(below)) > K_TOLERANCE:
        raise ValueError(
            f"{where} has a skew of {skew or below:g} px, which is not supported: K must be [[fx, 0, cx], [0, fy, cy], "
            "[0, 0, 1]]; undistort the images"
        )


def _products(matrix: list[list[float]]) -> tuple[float, ...]:
    """Return the entries of R R^T - 1."""
    (a, b, c, _), (d, e, f, _), (g, h, i, _), _ = matrix
    return (
        a * a + b * b + c * c - 1, d * d + e * e + f * f - 1, g * g + h * h + i * i - 1,
        a * d + b * e + c * f, a * g + b * h + c * i, d * g + e * h + f * i,
    )  # fmt: skip


def _stretch_of(matrix: list[list[float]]) -> float:
    """Return the sum of the errors of R R^T and of the last row of a pose; non-finite if an entry of the pose is."""
    (p, q, r, s), shift = matrix[3], matrix[0][3] + matrix[1][3] + matrix[2][3]
    return sum(map(abs, _products(matrix))) + abs(p) + abs(q) + abs(r) + abs(s - 1) + 0 * shift


def _check_pose(matrix: list[list[float]], where: str) -> None:
    """Raise ValueError where the pose is not rigid; a reflection is allowed, since the mirrored image is correct."""
    _check_finite(matrix, where)
    p, q, r, s = matrix[3]
    if max(map(abs, (p, q, r, s - 1))) > POSE_TOLERANCE:
        raise ValueError(f"{where} must have the last row 0, 0, 0, 1, not {p:g}, {q:g}, {r:g}, {s:g}; is it transposed?")
    off = max(map(abs, _products(matrix)))
    if not off <= POSE_TOLERANCE:  # products of huge numbers overflow
        raise ValueError(
            f"{where} scales or shears: R R^T is off by {off:.2g} from the identity, where R is the upper left 3 x 3 block. "
            "Give a rotation. If the pose is scaled, divide its first three rows by the scale; this also divides depths"
        )


def _check_finite(matrix: list[list[float]], where: str) -> None:
    """Raise ValueError where a number of the matrix is not finite."""
    if not all(math.isfinite(value) for row in matrix for value in row):
        raise ValueError(f"{where} has non-finite values: {matrix}")


MATRICES = (
    ("viewmat", 4, POSE_TOLERANCE, _stretch_of, _check_pose), ("K", 3, K_TOLERANCE, _skew_of, _check_intrinsics),
)  # fmt: skip
"""Matrices of a camera: name, rows, tolerance, function that computes the error, and check for matrices with a larger error."""
