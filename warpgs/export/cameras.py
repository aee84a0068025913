"""Cameras as files for other programs: cameras.json of the INRIA 3DGS code, which splat editors read, transforms.json, COLMAP.

Images are named by number, so that the files contain no name or path of the user.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpgs.errors import UsageError
from warpgs.files import filling, is_empty, make_folder, write_json, write_text
from warpgs.geometry import pinhole_of, quaternions
from warpgs.scene import Camera

NAMES = ("cameras.json", "transforms.json", "sparse")
"""Names of files, and of a folder, that determine the format."""
MAX_OFF_CENTER = 0.01
"""Distance from the image centre [px] above which a note reports that the file does not store the principal point."""


def holds_cameras(path: Path) -> bool:
    """Return whether a file name is that of a camera format."""
    return path.name in NAMES


def write_cameras(path: Path, cameras: list[Camera]) -> list[str]:
    """Write cameras in the format of the file name; returns notes for the user.

    Args:
        path: cameras.json or transforms.json in any folder; an existing file is replaced. Or a new or empty folder named
            sparse, for COLMAP's text files in its subfolder 0.
        cameras: Cameras in file units, numpy arrays; cameras with lenses are written as pinholes of the same K, with a note.

    Raises:
        ResourceError: The file cannot be written.
        UsageError: The name has no known format, the folder exists and is not empty, or a camera has no pinhole of the same K.
    """
    if not holds_cameras(path):
        raise UsageError(f"{path}: cameras go to {' or '.join(NAMES[:2])}, or to a folder named {NAMES[2]} (COLMAP)")
    bent = sum(c.model != "pinhole" for c in cameras)
    notes = [f"{bent} of {len(cameras)} cameras are written without their lens distortion, as pinholes"] if bent else []
    cameras = [pinhole_of(c) for c in cameras]
    if path.name == "transforms.json":
        write_json(path, {"camera_model": "PINHOLE", "frames": [_frame(i, c) for i, c in enumerate(cameras)]})
    elif path.name == "sparse":
        if path.exists() and not (path.is_dir() and is_empty(path)):
            raise UsageError(f"{path}: exists already and may be a reconstruction; give another folder")
        with filling(path) as temporary:
            make_folder(temporary / "0")
            for name, text in _colmap(cameras).items():
                write_text(temporary / "0" / name, text)
    else:
        write_json(path, [_inria(i, c) for i, c in enumerate(cameras)])
        off = max((max(abs(c.K[0, 2] - c.width / 2), abs(c.K[1, 2] - c.height / 2)) for c in cameras), default=0.0)
        if off > MAX_OFF_CENTER:
            notes.append(
                "cameras.json stores no principal points, which are up to "
                f"{off:.1f} px off the image centre; write transforms.json to keep them"
            )
    return notes


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
    """Return the frame of a camera, with the axes of OpenGL."""
    pose = _world_from_camera(camera)
    pose[:3, 1:3] *= -1
    return {
        "file_path": f"images/{number:04d}.png", "w": camera.width, "h": camera.height,
        "fl_x": float(camera.K[0, 0]), "fl_y": float(camera.K[1, 1]), "cx": float(camera.K[0, 2]), "cy": float(camera.K[1, 2]),
        "transform_matrix": pose.tolist(),
    }  # fmt: skip


def _colmap(cameras: list[Camera]) -> dict[str, str]:
    """Return COLMAP's text files by name: a camera for each lens, images without points, and no points."""
    import torch

    lenses: dict[tuple, int] = {}
    rows = []
    rotations = torch.from_numpy(np.stack([np.array(c.viewmat[:3, :3], np.float64) for c in cameras]))
    for i, (c, quat) in enumerate(zip(cameras, quaternions(rotations).tolist()), 1):
        lens = (c.width, c.height, *(float(v) for v in (c.K[0, 0], c.K[1, 1], c.K[0, 2], c.K[1, 2])))
        number = lenses.setdefault(lens, len(lenses) + 1)
        values = [*quat, *(float(v) for v in c.viewmat[:3, 3])]
        rows.append(f"{i} {' '.join(map(repr, values))} {number} {i - 1:04d}.png\n\n")  # the second line would hold its points
    return {
        "cameras.txt": "".join(f"{n} PINHOLE {' '.join(map(repr, lens))}\n" for lens, n in lenses.items()),
        "images.txt": "".join(rows),
        "points3D.txt": "",
    }
