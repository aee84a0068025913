"""Poses of files: checked to be rigid and finite, converted to camera_from_world with OpenCV axes."""

from __future__ import annotations

import numpy as np

from warpgs.constants import POSE_TOLERANCE
from warpgs.errors import DataError
from warpgs.geometry import matmul, nearest_rotation, rotation_matrices


def rigid(viewmat: np.ndarray, where: str) -> np.ndarray:
    """Return a pose [4, 4] with its rotation made exactly orthonormal.

    Raises:
        DataError: The pose is not finite, or its upper left 3 x 3 block is not a rotation; ``where`` is file and image.
    """
    if viewmat.shape != (4, 4) or not np.isfinite(viewmat).all():
        raise DataError(f"{where}: the pose is not finite; estimate it again, or remove the image")
    R = viewmat[:3, :3]
    # entries of a rotation are at most 1; the bound keeps the squares of wild ones from overflowing
    error = float(np.abs(R @ R.T - np.eye(3)).max()) if np.abs(R).max() < 1e3 else np.inf
    if error > POSE_TOLERANCE:
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
    """Return the rotation [3, 3] of a quaternion wxyz of any length.

    Raises:
        DataError: The quaternion is zero or not finite.
    """
    q = np.array(quat, np.float64)
    norm = float(np.linalg.norm(q)) if (np.abs(q) < 1e100).all() else np.inf
    if not 1e-12 < norm < np.inf:
        raise DataError(f"{where}: the rotation quaternion {tuple(quat)} is zero or not finite; estimate the pose again")
    return rotation_matrices(q / norm)


def from_camera_to_world(matrix: np.ndarray, where: str, *, opengl: bool) -> np.ndarray:
    """Return camera_from_world [4, 4] with OpenCV axes from a camera-to-world matrix.

    Args:
        matrix: Camera to world, shape [3, 4] or [4, 4].
        where: File and image, for errors.
        opengl: True if the camera looks along -z with +y up (OpenGL, Blender); y and z are then negated.

    Raises:
        DataError: The matrix is not rigid or not finite.
    """
    pose = np.eye(4)
    pose[: matrix.shape[0]] = matrix
    p, q, r, s = pose[3].tolist()  # numpy's allclose would take a quarter of the time of a pose
    if np.isfinite(pose).all() and not (max(abs(p), abs(q), abs(r)) <= 1e-6 and abs(s - 1) <= 1e-5):
        raise DataError(f"{where}: the last row of the pose is {pose[3].tolist()}, not 0 0 0 1; is the matrix transposed?")
    if opengl:
        pose[:3, 1:3] *= -1
    pose = rigid(pose, where)
    result = np.eye(4)
    result[:3, :3] = pose[:3, :3].T
    result[:3, 3] = -matmul(pose[:3, :3].T, pose[:3, 3])
    return result
