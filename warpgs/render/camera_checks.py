"""Checks of the arrays of a camera before it is rendered."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from warpgs.constants import K_TOLERANCE
from warpgs.scene import Camera


def check_arrays(camera: Camera) -> None:
    """Check types, shapes and values of a camera's arrays, and the type of its size.

    Nothing is read from a GPU: poses and K in its memory are not checked.

    Raises:
        TypeError: An array is neither of numpy nor a tensor, or not of real numbers; or the size is not of integers.
        ValueError: A shape is another, a number is not finite, or K has a skew or another last row than 0, 0, 1.
    """
    for name, rows in (("viewmat", 4), ("K", 3), ("distortion", 0)):
        array: Any = getattr(camera, name)
        if name == "distortion" and array is None:
            continue
        _check_type(name, array)
        if rows and (array.ndim not in (2, 3) or tuple(array.shape[-2:]) != (rows, rows)):
            raise ValueError(f"camera.{name} must have shape [{rows}, {rows}] or [C, {rows}, {rows}], not {list(array.shape)}")
        # as numbers, which takes a third of the time of tensors
        if not (getattr(array, "is_cuda", False) or all(map(math.isfinite, array.reshape(-1).tolist()))):
            raise ValueError(f"camera.{name} holds numbers that are not finite: {array.tolist()}")
    if not getattr(camera.K, "is_cuda", False):
        _check_intrinsics(camera.K)
    for name in ("width", "height"):
        size = getattr(camera, name)
        if not isinstance(size, (int, np.integer)):
            raise TypeError(f"camera.{name} must be a whole number of pixels, not {size!r}")


def _check_type(name: str, array: Any) -> None:
    """Raise TypeError where a value is not an array of real numbers."""
    if not isinstance(array, (np.ndarray, torch.Tensor)):
        raise TypeError(
            f"camera.{name} must be a numpy array or a tensor, not {type(array).__name__}; numpy.array or torch.stack makes one"
        )
    real = not array.is_complex() if isinstance(array, torch.Tensor) else array.dtype.kind in "fiub"
    if not real:
        raise TypeError(f"camera.{name} must hold real numbers, not {array.dtype}")


def _check_intrinsics(K: Any) -> None:
    """Raise ValueError where matrices [..., 3, 3] have a skew or another last row than 0, 0, 1."""
    for m in K.reshape(-1, 3, 3).tolist():
        if not max(abs(m[0][1]), abs(m[1][0]), abs(m[2][0]), abs(m[2][1]), abs(m[2][2] - 1)) <= K_TOLERANCE:
            raise ValueError(
                "camera.K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]: skew is not rendered; divide K by K[2, 2], and "
                "undistort images with skew"
            )
