"""Files that the viewer saves: a crop box and the keyframes of a path, both in the units of the scene's files."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from warpgs.coordinates import convert_camera
from warpgs.scene import Camera, Normalization
from warpgs.viewer.camera_conventions import fov_y

CROP, PATH = "crop.json", "path.json"
"""Names of the files in a run folder."""
MAX_KEYFRAMES = 1000
"""Largest number of keyframes of a path: half an hour at the default of 2 s between them."""


@dataclass(frozen=True)
class CropBox:
    """A box in scene units [u], turned about its centre."""

    center: np.ndarray
    """Centre [u], shape [3]."""
    size: np.ndarray
    """Lengths of the box's sides [u], shape [3]."""
    rotation: np.ndarray
    """Rotation from the box's axes to the world's, shape [3, 3]."""

    def contains(self, means: torch.Tensor) -> torch.Tensor:
        """Return which points [N, 3] are inside, bool, shape [N]."""
        offsets = means.detach().cpu().double() - torch.from_numpy(self.center)
        inside = ((offsets[:, :, None] * torch.from_numpy(self.rotation)).sum(1).abs() <= torch.from_numpy(self.size / 2)).all(
            1
        )
        return inside.to(means.device)

    def to_json(self, normalization: Normalization) -> dict[str, Any]:
        """Return the box in file units: ``center`` [3], ``size`` [3], and ``rotation`` [3, 3] from its axes to the world's."""
        return {
            "center": (self.center / normalization.scale + normalization.offset).tolist(),
            "size": (self.size / normalization.scale).tolist(), "rotation": self.rotation.tolist(),
        }  # fmt: skip


def keyframe(camera: Camera, seconds: float, normalization: Normalization) -> dict[str, Any]:
    """Return a camera of a path as JSON.

    Args:
        camera: Camera in scene units.
        seconds: Time at which the path reaches the camera [s].
        normalization: Similarity from file to scene units.

    Returns:
        ``c2w``, camera-to-world in OpenCV axes and file units, 4 rows of 4; ``fov_y``, the vertical field of view [rad]; and
        ``seconds``.
    """
    viewmat = convert_camera(camera, normalization, "scene", "file").viewmat
    c2w = np.eye(4)
    c2w[:3, :3] = viewmat[:3, :3].T
    c2w[:3, 3] = -(viewmat[:3, :3] * viewmat[:3, 3:]).sum(0)
    return {"c2w": c2w.tolist(), "fov_y": fov_y(camera), "seconds": seconds}
