"""Cameras from files without images: cameras.json of the INRIA 3DGS code, transforms.json, and COLMAP reconstructions."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.errors import DataError
from warpgs.input_files import read_input, unread_reason
from warpgs.io import colmap, transforms
from warpgs.io.images import Lens
from warpgs.io.pose_matrices import from_camera_to_world, quat_rotation, rigid
from warpgs.scene import Camera
from warpgs.schema import check_parts

MAX_BYTES = 2**25
"""Largest file of cameras that is read [bytes]."""


def read_cameras(path: Path) -> tuple[dict[str, Camera], list[str]]:
    """Return the cameras of a file or of a COLMAP folder by name, in file units, and notes for the user.

    Lenses become pinholes, because renders have no distortion; a note reports lenses with distortion.

    Args:
        path: A cameras.json, a transforms.json, or a folder with a COLMAP reconstruction, binary or text.

    Raises:
        DataError: The file is missing, malformed or holds no camera; a pose is not rigid, or a lens has impossible values.
    """
    if path.is_dir():
        found = _colmap(path)
    else:
        values = _json(path)
        found = _inria(path, values) if isinstance(values, list) else _transforms(path)
    if not found:
        raise DataError(f"{path}: holds no camera. Give cameras.json, transforms.json, or the folder of a scene")
    bent = sum(any(lens.distortion) for _, lens in found.values())
    notes = [f"the lens distortion of {bent} of {len(found)} cameras is not rendered"] if bent else []
    return {name: Camera(viewmat, lens.K, lens.width, lens.height) for name, (viewmat, lens) in found.items()}, notes


def _json(path: Path) -> Any:
    """Return the values of a JSON file of bounded size."""
    try:
        text = read_input(path, MAX_BYTES).decode("utf-8-sig", "surrogateescape")
        check_parts(text)
        return json.loads(text)
    except OSError as e:
        raise DataError(f"{path}: cannot be read ({unread_reason(e)}). Check the path, or write the file again") from e
    except (ValueError, RecursionError) as e:
        raise DataError(f"{path}: cannot be read as JSON ({str(e)[:80]}). Check the path, or write the file again") from e


def _inria(path: Path, rows: list[Any]) -> dict[str, tuple[np.ndarray, Lens]]:
    """Return pose and lens of each row; a row has a camera-to-world rotation in OpenCV axes and the camera centre."""
    found = _Names()
    for i, row in enumerate(rows):
        where = f"{path}, camera {i}"
        try:
            pose = np.eye(4)
            pose[:3, :3] = np.array(row["rotation"], np.float64).reshape(3, 3)
            pose[:3, 3] = np.array(row["position"], np.float64).reshape(3)
            width, height, fx, fy = (float(row[key]) for key in ("width", "height", "fx", "fy"))
            K = np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]])
            lens = Lens(K, int(width), int(height))
            name = str(row.get("img_name", i))
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as e:
            raise DataError(f"{where}: needs rotation, position, width, height, fx and fy as numbers; correct the entry") from e
        found.add(name, from_camera_to_world(pose, where, opengl=False), lens.checked(where))
    return found


def _transforms(path: Path) -> dict[str, tuple[np.ndarray, Lens]]:
    """Return pose and lens of each frame; the file must give its image size."""
    shared = transforms.read_json(path)
    found = _Names()
    for i, frame in enumerate(shared["frames"]):
        where = f"{path}, frame {i}"
        if not isinstance(frame, dict):
            raise DataError(f"{where}: expected an object with file_path and transform_matrix. Write the file again")
        if any(frame.get(key, shared.get(key)) is None for key in ("w", "h")):
            raise DataError(f"{where}: gives no w and h, so the image size is unknown. Add them, or give the scene's folder")
        lens = transforms.lens_of(frame, shared, 0, 0, where)
        viewmat = from_camera_to_world(transforms.matrix_of(frame, where), where, opengl=True)
        found.add(str(frame.get("file_path", i)), viewmat, lens)
    return found


def colmap_folder(folder: Path) -> Path | None:
    """Return the folder of the reconstruction in a scene folder, sparse or sparse/0; None without one."""
    found = colmap.model_folder(folder)
    return colmap.model_folder(folder / "0") if found is None else found


def _colmap(folder: Path) -> dict[str, tuple[np.ndarray, Lens]]:
    """Return pose and lens of each image of a reconstruction, sorted by name."""
    model = colmap_folder(folder)
    kind = None if model is None else colmap.complete_kind(model)
    if model is None or kind is None:
        raise DataError(f"{folder}: lacks COLMAP's files cameras and images. Give cameras.json, transforms.json or a scene")
    lenses = colmap.read_cameras(model / f"cameras.{kind}")
    found = _Names()
    for pose in sorted(colmap.read_poses(model / f"images.{kind}").values(), key=lambda p: p.name):
        where = f"{model}, image {pose.name!r}"
        if pose.camera_id not in lenses:
            raise DataError(f"{where}: camera {pose.camera_id} is missing from cameras.{kind}; export the cameras again")
        viewmat = np.eye(4)
        viewmat[:3, :3] = quat_rotation(pose.quat, where)
        viewmat[:3, 3] = pose.translation
        found.add(pose.name, rigid(viewmat, where), lenses[pose.camera_id])
    return found


class _Names(dict[str, tuple[np.ndarray, Lens]]):
    """Poses and lenses by unique names: a repeated name gets a number."""

    def __init__(self) -> None:
        super().__init__()
        self._next: dict[str, int] = {}

    def add(self, name: str, viewmat: np.ndarray, lens: Lens) -> None:
        free, number = name, self._next.get(name, 2)
        while free in self:  # each number of a name is tried once
            free, number = f"{name}-{number}", number + 1
        self._next[name] = number
        self[free] = viewmat, lens
