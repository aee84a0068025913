"""Conversion of cameras to the viewer's conventions and back: poses as camera-to-world, fields of view."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from warpgs.geometry import look_at, matmul, quaternions, rotation_matrices
from warpgs.scene import Camera, Gaussians

FIELD_OF_VIEW = math.radians(50)
"""Vertical field of view of the camera that is made for a model without cameras [rad]."""


def wxyz_of(camera: Camera) -> np.ndarray:
    """Return the rotation from camera to world axes as a unit quaternion wxyz, float64, shape [4]."""
    return quaternions(torch.from_numpy(np.asarray(camera.viewmat)[None, :3, :3].transpose(0, 2, 1).copy()))[0].numpy()


def fov_y(camera: Camera, aspect: float = math.inf) -> float:
    """Return the vertical field of view [rad] at which a window shows a camera's whole image, centred.

    Args:
        camera: The camera.
        aspect: Width of the window over its height; by default the window is wider than the image.
    """
    return 2 * math.atan(max(0.5 * camera.height / float(camera.K[1, 1]), 0.5 * camera.width / float(camera.K[0, 0]) / aspect))


def distance_ahead(camera: Camera, gaussians: Gaussians) -> float:
    """Return the median depth [u] of the means that a camera sees, or 1 if it sees none; the view turns about this depth."""
    means = gaussians.means.detach().cpu().double().numpy()
    points = matmul(means, camera.viewmat[:3, :3].T) + camera.viewmat[:3, 3]
    z = points[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        x, y = (np.abs(points[:, i] / z * camera.K[i, i]) / size for i, size in ((0, camera.width), (1, camera.height)))
    seen = (z > 0) & (x < 0.5) & (y < 0.5)
    return float(np.median(z[seen])) if seen.any() else 1.0


def camera_at(wxyz: Any, position: Any, fov: float, width: int, height: int) -> Camera:
    """Return the pinhole camera of a camera-to-world rotation, position [u] and vertical field of view [rad]."""
    rotation = rotation_matrices(np.asarray(wxyz, np.float64)).T
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = rotation, -matmul(rotation, np.asarray(position, np.float64))
    focal = 0.5 * height / math.tan(0.5 * fov)
    return Camera(viewmat, np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1.0]]), width, height)


def camera_before(gaussians: Gaussians, width: int = 960, height: int = 720) -> Camera:
    """Return a camera at -z that sees the box between the 5th and 95th percentiles of the means, for models without cameras."""
    means = gaussians.means.detach().cpu().double().numpy()
    low, high = np.percentile(means, [5, 95], axis=0)
    middle, radius = (low + high) / 2, max(0.5 * float(np.linalg.norm(high - low)), 1e-6)
    center = middle - np.array([0, 0, radius / math.sin(0.5 * FIELD_OF_VIEW)])
    focal = 0.5 * height / math.tan(0.5 * FIELD_OF_VIEW)
    K = np.array([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1.0]])
    return Camera(look_at(center, middle, np.array([0.0, -1, 0])), K, width, height)


def stands_at(camera: Camera, other: Camera, near: float) -> bool:
    """Return whether two cameras are within ``near`` [u] of each other, and their axes within 1.8 degrees."""
    turned = float(np.trace(matmul(camera.viewmat[:3, :3], other.viewmat[:3, :3].T)))
    return bool(np.linalg.norm(camera.center - other.center) <= near) and turned > 3 - 1e-3
