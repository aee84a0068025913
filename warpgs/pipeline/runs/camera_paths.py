"""Camera paths for films, made from the training cameras."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warpgs.errors import UsageError
from warpgs.geometry import focus_point, look_at
from warpgs.scene import Camera

PATHS = ("views", "orbit", "spiral")
MAX_RING_FORWARD = 0.5
"""Length of the mean viewing direction below which cameras stand around what they look at: 0.15 for 16 about an object, 0.82
and more for scenes photographed from one side."""


def camera_path(kind: str, cameras: list[Camera], depth: float, frames: int) -> list[Camera]:
    """Return cameras along a path with the size and intrinsics of the first camera.

    Args:
        kind: ``orbit``, an ellipse through the region that the cameras span; ``spiral``, two turns that open and close
            again while moving in and out. Both look at one point.
        cameras: Training cameras, at least one.
        depth: Distance from the mean camera to the point looked at [u].
        frames: Number of cameras.

    Returns:
        The cameras, closed to a loop.

    Raises:
        UsageError: The kind is unknown, or there are no frames.
    """
    if kind not in ("orbit", "spiral"):
        raise UsageError(f"path {kind!r} is not one of {', '.join(PATHS)}")
    if frames < 1:
        raise UsageError(f"a film needs at least 1 frame, not {frames}")
    if np.linalg.norm(np.mean([c.viewmat[2, :3] for c in cameras], axis=0)) < MAX_RING_FORWARD:
        return _around(kind, cameras, frames)
    center = np.mean([c.center for c in cameras], axis=0)
    forward = np.mean([c.viewmat[2, :3] for c in cameras], axis=0)
    forward = forward / np.linalg.norm(forward)
    up = -np.mean([c.viewmat[1, :3] for c in cameras], axis=0)
    side = np.cross(forward, up)
    side /= np.linalg.norm(side)
    up = np.cross(side, forward)
    offsets = np.array([c.center for c in cameras]) - center
    spans = [max(0.7 * float(np.abs(offsets @ axis).max()), 0.03 * depth) for axis in (side, up)]
    target = center + depth * forward
    result = []
    for t in np.arange(frames) / frames:
        angle, radius, push = 2 * np.pi * t, 1.0, 0.0
        if kind == "spiral":
            angle, radius, push = 4 * np.pi * t, np.sin(np.pi * t), 0.15 * depth * np.sin(2 * np.pi * t)
        eye = center + radius * (spans[0] * np.cos(angle) * side + spans[1] * np.sin(angle) * up) + push * forward
        result.append(replace(cameras[0], viewmat=look_at(eye, target, up)))
    return result


def _around(kind: str, cameras: list[Camera], frames: int) -> list[Camera]:
    """Return cameras on a circle about what cameras all round look at; a spiral makes two turns and rises and falls."""
    target = focus_point(cameras)
    offsets = np.array([c.center for c in cameras]) - target
    up = -np.mean([c.viewmat[1, :3] for c in cameras], axis=0)
    up /= np.linalg.norm(up)
    heights = offsets @ up
    level = offsets - heights[:, None] * up
    radius = float(np.linalg.norm(level, axis=1).mean())
    first = level[0] / np.linalg.norm(level[0])
    second = np.cross(up, first)
    result = []
    for t in np.arange(frames) / frames:
        angle, height = 2 * np.pi * t, heights.mean()
        if kind == "spiral":
            angle, height = 4 * np.pi * t, height + heights.std() * np.sin(2 * np.pi * t)
        eye = target + radius * (np.cos(angle) * first + np.sin(angle) * second) + height * up
        result.append(replace(cameras[0], viewmat=look_at(eye, target, up)))
    return result
