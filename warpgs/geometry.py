"""Small geometry on numpy arrays: projecting and back-projecting points, the span of a set of cameras, camera paths."""

from __future__ import annotations

import numpy as np

from warpgs.scene import Camera


def matmul(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return a [..., J] times b [J] or [J, K], the same bits on every x86-64 processor.

    ``@`` calls BLAS, which takes other kernels, and so another order of its sums, on another processor.
    """
    return np.einsum("...j,j->..." if b.ndim == 1 else "...j,jk->...k", a, b)


def cofactors(m: np.ndarray) -> np.ndarray:
    """Return the cofactor matrix of m [3, 3]: that of a rotation is the rotation itself."""
    return np.stack([np.cross(m[1], m[2]), np.cross(m[2], m[0]), np.cross(m[0], m[1])])


def inverse(m: np.ndarray) -> np.ndarray:
    """Return the inverse of m [3, 3] by its cofactors, without LAPACK, whose kernels go by the processor (see `matmul`)."""
    c = cofactors(m)
    return c.T / (m[0] * c[0]).sum()


def nearest_rotation(m: np.ndarray) -> np.ndarray:
    """Return the rotation nearest to m [3, 3], whose determinant is positive: its polar factor, by Newton (Higham 1986)."""
    for _ in range(10):  # from a matrix that is orthogonal to 0.1 it takes five; more change nothing
        c = cofactors(m)
        m = 0.5 * (m + c / (m[0] * c[0]).sum())
    return m


def relative_pose(first: Camera, second: Camera) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation [3, 3] and translation [3] from the axes of the first camera to those of the second."""
    rotation = matmul(second.viewmat[:3, :3], first.viewmat[:3, :3].T)
    return rotation, second.viewmat[:3, 3] - matmul(rotation, first.viewmat[:3, 3])


def project_points(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Project world points; returns pixels [N, 2] (pixel centres at +0.5) and z-depths [N] (points [N, 3])."""
    in_camera = matmul(points, camera.viewmat[:3, :3].T) + camera.viewmat[:3, 3]
    z = in_camera[:, 2]
    safe = np.where(z == 0, np.finfo(float).tiny, z)
    pixels = matmul(in_camera / safe[:, None], camera.K.T)
    return pixels[:, :2], z


def back_project(camera: Camera, pixels: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """World points [N, 3] at pixels [N, 2] (centres at +0.5) and z-depths [N] [u]."""
    homogeneous = np.concatenate([pixels, np.ones((len(pixels), 1))], axis=1)
    in_camera = depths[:, None] * matmul(homogeneous, inverse(camera.K).T)
    return matmul(in_camera - camera.viewmat[:3, 3], camera.viewmat[:3, :3])


def in_image(camera: Camera, points: np.ndarray, near: float = 0.0) -> np.ndarray:
    """True where a world point [N, 3] lies in front of the camera, beyond ``near`` [u], and inside its image."""
    pixels, z = project_points(camera, points)
    inside = (pixels >= 0).all(1) & (pixels[:, 0] < camera.width) & (pixels[:, 1] < camera.height)
    return inside & (z > near)


def camera_extent(cameras: list[Camera]) -> float:
    """1.1 times the largest distance of a camera centre from their mean [u] (Kerbl et al. 2023); 0 for a single camera."""
    centers = np.array([c.center for c in cameras])
    return 1.1 * float(np.linalg.norm(centers - centers.mean(0), axis=1).max())


def focus_point(cameras: list[Camera]) -> np.ndarray:
    """The point nearest to all optical axes in least squares [3]; for parallel axes, the mean camera centre."""
    normal, right = np.zeros((3, 3)), np.zeros(3)
    for c in cameras:
        axis = c.viewmat[2, :3]
        m = np.eye(3) - np.outer(axis, axis)
        normal += m
        right += matmul(m, c.center)
    # a tiny pull to the mean centre keeps the system solvable when all axes are parallel
    weight = 1e-6 * len(cameras)
    mean = np.mean([c.center for c in cameras], axis=0)
    return matmul(inverse(normal + weight * np.eye(3)), right + weight * mean)


def look_at(center: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """camera_from_world [4, 4] of a camera at ``center`` that looks at ``target`` with ``up`` (all [3]) upwards."""
    z = (target - center) / np.linalg.norm(target - center)
    x = np.cross(-up, z)
    x /= np.linalg.norm(x)
    rotation = np.stack([x, np.cross(z, x), z])
    viewmat = np.eye(4)
    viewmat[:3, :3] = rotation
    viewmat[:3, 3] = -rotation @ center
    return viewmat
