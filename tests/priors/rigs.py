"""Rigs of cameras before a still life with exact depth, and files of flow."""

import functools
from pathlib import Path

import numpy as np

from warpgs.geometry import look_at
from warpgs.priors.flow import pixel_grid
from warpgs.scene import Camera, View
from warpgs.synthetic import demo, raycast

SIZE = (160, 120)


def exact_depth(shapes: list, camera: Camera) -> np.ndarray:
    """Return the z-depth behind every pixel centre [u], shape [H, W]."""
    rays = raycast.pixel_rays(camera.K, camera.viewmat, pixel_grid(camera))
    t, _ = raycast.cast(shapes, camera.center, rays)
    return (t * (rays @ camera.viewmat[2, :3])).reshape(camera.height, camera.width)


@functools.cache
def still_life(count: int = 3) -> tuple[list[View], list[np.ndarray]]:
    """Return every fourth view from the middle of the demo's path, and their depths."""
    shapes, light = demo.still_life(0), raycast.Light()
    views, depths = [], []
    for i, camera in enumerate(demo.camera_path(24, *SIZE)[6::4][:count]):
        image = raycast.render(shapes, light, camera.K, camera.viewmat, *SIZE)
        views.append(View(f"{i:03d}.png", camera, image))
        depths.append(exact_depth(shapes, camera))
    return views, depths


def rig(count: int = 3) -> list[Camera]:
    """Return cameras with unequal intrinsics and poses that look at the origin from about 4 u."""
    generator = np.random.default_rng(3)
    cameras = []
    for i in range(count):
        center = np.array([1.1 * (i - 1), 0.3 * i, -4.0]) + 0.2 * generator.standard_normal(3)
        K = np.array([[70 + 5 * i, 0, 31.2], [0, 73 - 2 * i, 22.9], [0, 0, 1.0]])
        cameras.append(Camera(look_at(center, 0.1 * generator.standard_normal(3), np.array([0.1, -1, 0])), K, 64, 48))
    return cameras


# Flow files as other programs write them.


def write_flo(path: Path, flow: np.ndarray) -> None:
    """Write flow [H, W, 2] in the format of Baker et al. 2011 (vision.middlebury.edu/flow); NaN becomes 1e10, unknown."""
    height, width = flow.shape[:2]
    values = np.where(np.isfinite(flow).all(2, keepdims=True), flow, 1e10)
    path.write_bytes(b"PIEH" + np.array([width, height], "<i4").tobytes() + values.astype("<f4").tobytes())
