"""Simulated maps of sensors, laser scanners and networks for the demo scene, from its true depth and normals."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bench.lib.surfaces import true_depth
from warpgs.geometry import matmul
from warpgs.scene import Camera
from warpgs.synthetic import raycast

KINDS = {"none": "", "exact": "metric", "noise": "metric", "sparse": "metric", "relative": "disparity", "bent": "disparity"}
"""Kind of the depth maps by name: none; true depth; true depth with 1 % noise; the same at 2 % of the pixels; inverse depth
with 1 % noise and a random scale and shift for each view; and the same with a smooth error of 5 %, as of networks."""
NOISE, SPARSE, BENT = 0.01, 0.02, 0.05
WAVES = 3
"""Periods of the smooth error across the image."""


def true_normals(shapes: list[raycast.Shape], camera: Camera) -> np.ndarray:
    """Return the unit normals at the pixel centres in the axes of the camera, towards it, float32 [H, W, 3]; 0 where none."""
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    d = raycast.pixel_rays(camera.K, camera.viewmat, np.stack([column, row], -1).reshape(-1, 2))
    t, index = raycast.cast(shapes, camera.center, d)
    normals = np.zeros((len(d), 3))
    for i, shape in enumerate(shapes):
        x = camera.center + (t[:, None] * d)[index == i]
        normals[index == i] = matmul(shape.normal(shape.local(x)), shape.rotation.T)
    normals *= -np.sign((normals * d).sum(-1, keepdims=True))
    return matmul(normals, camera.viewmat[:3, :3].T).reshape(camera.height, camera.width, 3).astype(np.float32)


def depth_map(name: str, z: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the map of a name in `KINDS` that a true depth [H, W] [u] gives, float32 [H, W]; 0 where there is none."""
    known = np.isfinite(z)
    z = np.where(known, z, 1)
    if name != "exact":
        z = z * (1 + NOISE * rng.standard_normal(z.shape))
    if name == "sparse":
        known &= rng.random(z.shape) < SPARSE
    if name == "bent":
        y, x = (np.linspace(0, 2 * np.pi * WAVES, n) for n in z.shape)
        phase = rng.uniform(0, 2 * np.pi, 2)
        z = z * (1 + BENT * np.sin(x[None] + phase[0]) * np.sin(y[:, None] + phase[1]))
    if KINDS[name] == "disparity":
        z = rng.uniform(1, 20) / z + rng.uniform(0.2, 5)
    return np.where(known, z, 0).astype(np.float32)


def write_maps(folder: Path, name: str, normals: bool, shapes: list[raycast.Shape], cameras: dict[str, Camera]) -> None:
    """Write the maps of all views to `depths` and `normals` of a folder, as NPY named as the images are."""
    rng = np.random.default_rng(0)
    for image, camera in cameras.items():
        if KINDS[name]:
            (folder / "depths").mkdir(exist_ok=True)
            np.save(folder / "depths" / f"{Path(image).stem}.npy", depth_map(name, true_depth(shapes, camera), rng))
        if normals:
            (folder / "normals").mkdir(exist_ok=True)
            np.save(folder / "normals" / f"{Path(image).stem}.npy", true_normals(shapes, camera))
