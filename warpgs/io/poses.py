"""Poses at the door: checked to be rigid and finite, converted to camera_from_world with OpenCV axes."""

from __future__ import annotations

import numpy as np

from warpgs.errors import DataError
from warpgs.geometry import matmul, nearest_rotation

TOLERANCE = 1e-3
"""Largest entry of R R^T - 1 that is put down to rounding in the file."""


def rigid(viewmat: np.ndarray, where: str) -> np.ndarray:
    """Check a [4, 4] pose and return it with its rotation made exactly orthonormal.

    Raises:
        DataError: It is not finite, or its upper left 3 x 3 block is no rotation; ``where`` names file and image.
    """
    if viewmat.shape != (4, 4) or not np.isfinite(viewmat).all():
        raise DataError(f"{where}: the pose is not finite; estimate it again, or remove the image")
    R = viewmat[:3, :3]
    # entries of a rotation are at most 1; the bound keeps the squares of wild ones from overflowing
    error = float(np.abs(R @ R.T - np.eye(3)).max()) if np.abs(R).max() < 1e3 else np.inf
    if error > TOLERANCE:
        raise DataError(
            f"{where}: the pose is not rigid (R R^T is off by {error:.2g}): it scales or shears. Give pure rotations"
        )
    if np.linalg.det(R) < 0:
        raise DataError(f"{where}: the pose mirrors the scene (determinant -1); two axes are probably swapped")
    result = np.eye(4)
    result[:3, :3] = nearest_rotation(R)
    result[:3, 3] = viewmat[:3, 3]
    return result


def quat_rotation(quat: tuple[float, ...], where: str) -> np.ndarray:
    """Rotation [3, 3] of a quaternion wxyz; DataError where it is zero or not finite."""
    q = np.array(quat, np.float64)
    norm = float(np.linalg.norm(q)) if (np.abs(q) < 1e100).all() else np.inf
    if not 1e-12 < norm < np.inf:
        raise DataError(f"{where}: the rotation quaternion {tuple(quat)} is zero or not finite; estimate the pose again")
    w, x, y, z = q / norm
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def from_camera_to_world(matrix: np.ndarray, where: str, *, opengl: bool) -> np.ndarray:
    """camera_from_world, OpenCV axes, from a camera-to-world matrix [3 or 4, 4].

    Args:
        matrix: Camera to world.
        where: Names file and image in errors.
        opengl: The camera looks along -z with +y up (OpenGL, Blender); the two axes are turned round.

    Raises:
        DataError: The matrix is not rigid or not finite.
    """
    pose = np.eye(4)
    pose[: matrix.shape[0]] = matrix
    if np.isfinite(pose).all() and not np.allclose(pose[3], (0, 0, 0, 1), atol=1e-6):
        raise DataError(f"{where}: the last row of the pose is {pose[3].tolist()}, not 0 0 0 1; is the matrix transposed?")
    if opengl:
        pose[:3, 1:3] *= -1
    pose = rigid(pose, where)
    result = np.eye(4)
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -matmul(pose[:3, :3].T, pose[:3, 3])
    return result
