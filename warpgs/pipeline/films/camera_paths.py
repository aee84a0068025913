"""Camera paths for films, from the arrangement of the training cameras."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from warpgs.errors import UsageError
from warpgs.geometry import look_at, matmul, pinhole_of
from warpgs.pipeline.films.rig import MIN_SWING, Rig
from warpgs.scene import Camera

BY_KIND = {"forward": "spiral", "ring": "turntable", "room": "turntable", "free": "interpolate"}
"""Default path for each kind of rig."""
WIDE_ARC = math.radians(75)
"""Largest range of azimuths [rad] of cameras on one side for a spiral; for wider ranges, a film goes from photograph to
photograph, because a spiral would leave the captured area."""
SWING = 0.9
"""Fraction of the cameras' range that a film swings through: coverage is lower at the ends of the range."""
MAX_ELEVATION = math.radians(80)
"""Largest elevation of a film's cameras: near the zenith, the upward direction is ambiguous."""
LIMITS = {"width": (16, 8192), "fov": (1.0, 170.0)}
"""Smallest and largest value of a film's sides [px], and of its vertical field of view [deg]."""


def framed(camera: Camera, size: tuple[int, int] | None = None, fov_y: float | None = None, turned: bool = False) -> Camera:
    """Return a camera with the size and field of view of a film.

    Args:
        camera: Camera of a photograph; its pose is kept, and a lens is replaced by the pinhole of the same K.
        size: Width and height [px]; None for those of the photograph.
        fov_y: Vertical field of view [rad] for a centred principal point; None for the field of view of the photograph.
        turned: True if the photograph is rotated by a quarter turn, so that width and height are swapped.

    Raises:
        UsageError: The camera has no pinhole of the same K, such as an orthographic one.
    """
    camera = pinhole_of(camera)
    K, width, height = camera.K, camera.width, camera.height
    if turned:
        K, width, height = K[[1, 0, 2]][:, [1, 0, 2]], height, width
    if size is None and fov_y is None:
        return replace(camera, K=K, width=width, height=height)
    new_width, new_height = size or (width, height)
    if fov_y is not None:
        fy = 0.5 * new_height / math.tan(0.5 * fov_y)
    else:
        fy = K[1, 1] * new_height / height
    fx, zoom = fy * K[0, 0] / K[1, 1], fy / K[1, 1]
    cx, cy = (
        0.5 * new + zoom * (K[i, 2] - 0.5 * old) for i, (new, old) in enumerate(((new_width, width), (new_height, height)))
    )
    return replace(camera, K=np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), width=new_width, height=new_height)


def path_of(rig: Rig) -> str:
    """Return the default path of a rig."""
    wide = rig.kind == "forward" and rig.span is not None and rig.span[1] - rig.span[0] > WIDE_ARC
    return "interpolate" if wide else BY_KIND[rig.kind]


def upright(rig: Rig, camera: Camera) -> Camera:
    """Return an upright camera with the same centre and axis, for rotated photographs."""
    if not rig.turned:
        return camera
    pose = look_at(camera.center, camera.center + camera.viewmat[2, :3], rig.up)
    return replace(framed(camera, turned=True), viewmat=pose)


def _spiral_to_one_side(rig: Rig, cameras: list[Camera], frames: int) -> list[np.ndarray]:
    """Return poses along two turns that widen and narrow again among the cameras, all looking at the rig's centre."""
    center = np.mean([c.center for c in cameras], axis=0)
    forward = rig.center - center
    depth = math.sqrt((forward * forward).sum())
    forward = forward / depth
    side = np.cross(forward, rig.up)
    side /= math.sqrt((side * side).sum())
    up = np.cross(side, forward)
    offsets = np.array([c.center for c in cameras]) - center
    spans = [max(0.7 * float(np.abs(matmul(offsets, axis)).max()), 0.03 * depth) for axis in (side, up)]
    poses = []
    for t in np.arange(frames) / frames:
        # not nearer, where Gaussians look like needles; not farther, where the image border shows unobserved areas
        angle, radius = 4 * np.pi * t, np.sin(np.pi * t)
        eye = center + radius * (spans[0] * np.cos(angle) * side + spans[1] * np.sin(angle) * up)
        poses.append(look_at(eye, rig.center, up))
    return poses


def _turn(rig: Rig, frames: int, turns: int, rise: float) -> list[np.ndarray]:
    """Return poses on a circle about the rig's centre, or looking around from it.

    If the cameras do not cover all sides, the path swings there and back.

    Args:
        rig: The rig.
        frames: Number of poses.
        turns: Number of times around.
        rise: Amplitude of the elevation, one wave over the film [rad].
    """
    poses = []
    for t in np.arange(frames) / frames:
        azimuth = 2 * np.pi * turns * t
        if rig.span is not None:
            reach = SWING * max(rig.span[1] - rig.span[0], MIN_SWING)
            azimuth = 0.5 * (rig.span[0] + rig.span[1]) + 0.5 * reach * math.sin(azimuth)
        elevation = float(np.clip(rig.elevation + rise * math.sin(2 * np.pi * t), -MAX_ELEVATION, MAX_ELEVATION))
        direction = rig.direction(azimuth, elevation)
        if rig.kind == "room":
            poses.append(look_at(rig.center, rig.center + direction, rig.up))
        else:
            poses.append(look_at(rig.center + rig.distance * direction, rig.center, rig.up))
    return poses


def camera_path(kind: str, rig: Rig, cameras: list[Camera], frames: int) -> list[Camera]:
    """Return cameras along a path, closed to a loop, with the size and intrinsics of the first camera.

    Args:
        kind: ``turntable``: a level circle at the cameras' distance and elevation; for cameras on one side, a swing through
            their range and back; in a room, a turn on the spot. ``spiral``: two turns that rise and fall; for cameras that look
            to one side, two turns that widen and narrow again.
        rig: Arrangement of the training cameras.
        cameras: Training cameras, at least one.
        frames: Number of cameras.

    Returns:
        The cameras; all but those in a room look at the rig's centre.

    Raises:
        UsageError: The kind is unknown, or there are no frames.
    """
    if kind not in ("turntable", "spiral"):
        raise UsageError(f"path {kind!r} is neither turntable nor spiral")
    if frames < 1:
        raise UsageError(f"a film needs at least 1 frame, not {frames}")
    if kind == "turntable":
        poses = _turn(rig, frames, 1, 0.0)
    elif rig.kind == "forward":
        poses = _spiral_to_one_side(rig, cameras, frames)
    else:
        poses = _turn(rig, frames, 2, rig.rise)
    template = framed(cameras[0], turned=rig.turned)
    return [replace(template, viewmat=pose) for pose in poses]
