"""Cameras as files for other programs: cameras.json of the INRIA 3DGS code, which splat editors read, and transforms.json.

Images are named by number: no name or path of the user's leaves in them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpgs.errors import UsageError
from warpgs.files import write_json
from warpgs.scene import Camera

NAMES = ("cameras.json", "transforms.json")
"""Names of files that say their format."""


def write_cameras(path: Path, cameras: list[Camera]) -> None:
    """Write cameras in the format that the file's name says.

    Args:
        path: cameras.json or transforms.json, in any folder; an existing file is replaced.
        cameras: Pinhole cameras in file units, numpy arrays.

    Raises:
        ResourceError: The folder or the disk does not take the file.
        UsageError: The name says no format.
    """
    if path.name == "cameras.json":
        write_json(path, [_inria(i, c) for i, c in enumerate(cameras)])
    elif path.name == "transforms.json":
        write_json(path, {"camera_model": "PINHOLE", "frames": [_frame(i, c) for i, c in enumerate(cameras)]})
    else:
        raise UsageError(f"{path}: cameras go to a file named {' or '.join(NAMES)}")


def _world_from_camera(camera: Camera) -> np.ndarray:
    """Return the pose [4, 4] from the camera's axes to the world's."""
    pose = np.eye(4)
    pose[:3, :3] = camera.viewmat[:3, :3].T
    pose[:3, 3] = camera.center
    return pose


def _inria(number: int, camera: Camera) -> dict[str, object]:
    """Return the row of a camera; the format has no principal point."""
    pose = _world_from_camera(camera)
    return {
        "id": number, "img_name": f"{number:04d}", "width": camera.width, "height": camera.height,
        "position": pose[:3, 3].tolist(), "rotation": pose[:3, :3].tolist(),
        "fy": float(camera.K[1, 1]), "fx": float(camera.K[0, 0]),
    }  # fmt: skip


def _frame(number: int, camera: Camera) -> dict[str, object]:
    """Return the frame of a camera, whose axes are those of OpenGL."""
    pose = _world_from_camera(camera)
    pose[:3, 1:3] *= -1
    return {
        "file_path": f"images/{number:04d}.png", "w": camera.width, "h": camera.height,
        "fl_x": float(camera.K[0, 0]), "fl_y": float(camera.K[1, 1]), "cx": float(camera.K[0, 2]), "cy": float(camera.K[1, 2]),
        "transform_matrix": pose.tolist(),
    }  # fmt: skip
