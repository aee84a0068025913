"""Camera paths through keyframes, and the JSON file that holds them."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from warpgs import schema
from warpgs.coordinates import convert_camera
from warpgs.errors import DataError, UsageError
from warpgs.geometry import matmul, nearest_rotation, pinhole_of, quaternions, rotation_matrices
from warpgs.input_files import read_input, unread_reason
from warpgs.pipeline.films.camera_paths import framed
from warpgs.scene import Camera, Normalization

MAX_KEYFRAMES = 10_000
MAX_BYTES = 16 * 2**20
"""Size of the largest file of keyframes [bytes]."""
MAX_SKEW = 1e-3
"""Largest entry of R R^T - I for the upper left 3 x 3 matrix R of a pose in a file."""
MIN_SECONDS, MAX_SECONDS = 1e-3, 86400.0
"""Least and largest time from one keyframe to the next [s]: slopes of the path stay finite."""
MAX_REACH = 1e12
"""Largest coordinate of a camera centre in a file."""


@dataclass(frozen=True)
class Keyframe:
    """A camera that a path passes through at a time."""

    camera: Camera
    """The camera, a pinhole."""
    seconds: float
    """Time at which the path passes through the camera [s]."""
    reach: float = 0.0
    """Distance along the optical axis to the point that the camera looks at [u]; 0 if unknown."""


def _fov_y(camera: Camera) -> float:
    return 2 * math.atan(0.5 * camera.height / camera.K[1, 1])


def _row(keyframe: Keyframe) -> np.ndarray:
    """Return a row [9]: point looked at [u], quaternion wxyz of world_from_camera, vertical field of view [rad], reach [u]."""
    camera = keyframe.camera
    rotation = torch.from_numpy(np.ascontiguousarray(camera.viewmat[:3, :3].T, dtype=np.float64))
    point = camera.center + keyframe.reach * camera.viewmat[2, :3]
    return np.concatenate([point, quaternions(rotation[None])[0].numpy(), [_fov_y(camera), keyframe.reach]])


def _spline(rows: np.ndarray, times: np.ndarray, at: np.ndarray, closed: bool) -> np.ndarray:
    """Return the values [F, 9] at times [F] of a smooth curve through rows [N, 9] at rising times [N].

    The pieces are cubic Hermite. The slope at each row is that of the parabola through this row and its two neighbours (Catmull
    and Rom 1974, for uneven times). In a closed curve, the last row repeats the first.
    """
    steps = np.diff(times)
    slopes = np.diff(rows, axis=0) / steps[:, None]
    tangents = np.empty_like(rows)
    weights = (steps[:-1] / (steps[:-1] + steps[1:]))[:, None]
    tangents[1:-1] = (1 - weights) * slopes[:-1] + weights * slopes[1:]
    tangents[0], tangents[-1] = slopes[0], slopes[-1]
    if closed:
        weight = steps[-1] / (steps[-1] + steps[0])
        sign = np.ones(rows.shape[1])  # the same rotation may end as the opposite quaternion
        sign[3:7] = 1 if (rows[0, 3:7] * rows[-1, 3:7]).sum() > 0 else -1
        tangents[-1] = (1 - weight) * slopes[-1] + weight * sign * slopes[0]
        tangents[0] = sign * tangents[-1]
    i = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(steps) - 1)
    h = steps[i][:, None]
    s = np.clip((at - times[i])[:, None] / h, 0, 1)
    return (
        (1 + 2 * s) * (1 - s) ** 2 * rows[i] + s * (1 - s) ** 2 * h * tangents[i]
        + s * s * (3 - 2 * s) * rows[i + 1] - s * s * (1 - s) * h * tangents[i + 1]
    )  # fmt: skip


def through(keyframes: list[Keyframe], frames: int, *, closed: bool = False) -> list[Camera]:
    """Return cameras on a smooth curve through keyframes, at even times from the first to the last.

    One spline interpolates the points looked at, the distances to them, rotations and fields of view. So an object that all
    cameras look at stays in place while they go around it. Rotations are quaternions, normalised at each frame: between
    neighbours they turn nearly as evenly as by spherical interpolation, and they do not jerk at a keyframe.

    Args:
        keyframes: At least one, at rising times; in a closed path the last keyframe repeats the first.
        frames: Number of cameras. If there are two or more, the path starts at the first keyframe and ends at the last; a
            closed path ends one frame before the last.
        closed: Whether the path goes through its end without a corner.

    Raises:
        UsageError: There are no frames.
    """
    if frames < 1:
        raise UsageError(f"a film needs at least 1 frame, not {frames}")
    if len(keyframes) == 1:
        return [keyframes[0].camera] * frames
    rows = np.array([_row(k) for k in keyframes])
    for before, row in itertools.pairwise(rows):  # q and -q are one rotation; neighbours take the nearer way
        if (before[3:7] * row[3:7]).sum() < 0:
            row[3:7] *= -1
    times = np.array([k.seconds for k in keyframes])
    at = times[0] + (times[-1] - times[0]) * np.arange(frames) / max(frames if closed else frames - 1, 1)
    template, cameras = keyframes[0].camera, []
    for row in _spline(rows, times, at, closed):
        rotation = rotation_matrices(row[3:7] / math.sqrt((row[3:7] ** 2).sum())).T
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -matmul(rotation, row[:3] - row[8] * rotation[2])
        camera = replace(template, viewmat=viewmat)
        same = abs(row[7] - _fov_y(template)) < 1e-9
        cameras.append(camera if same else framed(camera, None, float(np.clip(row[7], 0.01, 3.1))))
    return cameras


KEYFRAMES = schema.items(schema.fields({
    "c2w": schema.items(schema.items(schema.number(), 4), 4), "fov_y": schema.number(0.01), "seconds": schema.number(0.0),
}))  # fmt: skip


def read_keyframes(path: Path, template: Camera, normalization: Normalization) -> list[Keyframe]:
    """Read keyframes of a JSON file: a list of ``{"c2w": 4x4, "fov_y": radians, "seconds": time}``.

    ``c2w`` is camera-to-world in OpenCV axes and in the units of the scene's files; ``seconds`` rise from keyframe to keyframe.

    Args:
        path: The file.
        template: Camera that gives the image size and the shape of a pixel.
        normalization: Similarity from file to scene units.

    Returns:
        The keyframes in scene units, the first at 0 s.

    Raises:
        DataError: The file cannot be read, or one of its values is invalid; the message names the value.
    """
    try:
        values = schema.parse(read_input(path, MAX_BYTES))
        KEYFRAMES(values, "keyframes")
    except FileNotFoundError as e:
        raise DataError(f"{path}: no such file; give a .json file of keyframes, as the viewer saves it") from e
    except (OSError, schema.SchemaError) as e:
        why = unread_reason(e) if isinstance(e, OSError) else e
        raise DataError(
            f"{path}: cannot be read as keyframes ({why}); give a JSON list of objects with c2w (4 rows of 4), fov_y [rad] and "
            "seconds"
        ) from e
    if not 1 <= len(values) <= MAX_KEYFRAMES:
        raise DataError(f"{path}: holds {len(values)} keyframes; a path needs 1 to {MAX_KEYFRAMES:,}")
    K = np.array([[template.K[0, 0], 0, 0.5 * template.width], [0, template.K[1, 1], 0.5 * template.height], [0, 0, 1.0]])
    template, result = replace(pinhole_of(template), K=K), []
    for i, value in enumerate(values):
        matrix = np.array(value["c2w"], np.float64)
        rotation = np.clip(matrix[:3, :3], -2, 2)  # so that no square overflows
        square = matmul(rotation, rotation.T)
        right_handed = float((np.cross(rotation[0], rotation[1]) * rotation[2]).sum()) > 0
        rigid = np.abs(square - np.eye(3)).max() <= MAX_SKEW and right_handed and (matrix[3] == (0, 0, 0, 1)).all()
        if not rigid or np.abs(matrix[:3, 3]).max() > MAX_REACH:
            raise DataError(
                f"{path}: c2w of keyframe {i} must be a rigid camera-to-world matrix: its upper left 3 x 3 a rotation, "
                f"its last column within {MAX_REACH:g}, and its last row 0 0 0 1"
            )
        if value["fov_y"] > 3.1:
            raise DataError(f"{path}: fov_y of keyframe {i} is {value['fov_y']:g} rad; give radians, below 3.1")
        if result and not MIN_SECONDS <= value["seconds"] - values[i - 1]["seconds"] <= MAX_SECONDS:
            raise DataError(
                f"{path}: seconds of keyframe {i} must be {MIN_SECONDS:g} to {MAX_SECONDS:g} above those of keyframe {i - 1}; "
                "sort the keyframes by time"
            )
        viewmat, rotation = np.eye(4), nearest_rotation(rotation)
        viewmat[:3, :3], viewmat[:3, 3] = rotation.T, -matmul(rotation.T, matrix[:3, 3])
        camera = convert_camera(replace(template, viewmat=viewmat), normalization, "file", "scene")
        result.append(Keyframe(framed(camera, None, value["fov_y"]), value["seconds"] - values[0]["seconds"]))
    return result
