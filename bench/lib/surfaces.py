"""Distances between meshes and ray cast surfaces, and the depth and points of these surfaces."""

from __future__ import annotations

import numpy as np

from warpgs.geometry import back_project
from warpgs.scene import Camera, Mesh
from warpgs.synthetic import raycast

NEAR = (0.005, 0.01, 0.02)
"""Distances, as fractions of the scene's radius, within which points are counted."""


def distance_to(shape: raycast.Shape, x: np.ndarray) -> np.ndarray:
    """Return the distance [u] of points [N, 3] to the surface of a shape, shape [N]."""
    p = shape.local(x)
    match shape:
        case raycast.Plane():
            return np.abs(p[:, 2])
        case raycast.Sphere():
            return np.abs(np.linalg.norm(p, axis=1) - shape.size)
        case raycast.Torus():
            return np.abs(np.hypot(np.hypot(p[:, 0], p[:, 2]) - shape.ring, p[:, 1]) - shape.tube)
        case raycast.Box():
            over = np.abs(p) - np.array(shape.half)
        case raycast.Cylinder():
            over = np.stack([np.hypot(p[:, 0], p[:, 2]) - shape.size, np.abs(p[:, 1]) - shape.half_height], 1)
        case _:
            raise TypeError(f"no distance is known to a {type(shape).__name__}")
    return np.abs(np.linalg.norm(np.maximum(over, 0), axis=1) + np.minimum(over.max(1), 0))


def true_depth(shapes: list[raycast.Shape], camera: Camera) -> np.ndarray:
    """Return the z-depth [u] of the surfaces at the pixel centres, infinite without a surface, shape [H, W]."""
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    d = raycast.pixel_rays(camera.K, camera.viewmat, np.stack([column, row], -1).reshape(-1, 2))
    t, _ = raycast.cast(shapes, camera.center, d)
    return (t * (d @ camera.viewmat[2, :3])).reshape(camera.height, camera.width)


def true_points(shapes: list[raycast.Shape], cameras: list[Camera]) -> np.ndarray:
    """Return the surface point that each pixel shows [u], shape [N, 3]."""
    found = []
    for c in cameras:
        z = true_depth(shapes, c).ravel()
        pixels = np.stack(np.meshgrid(np.arange(c.width), np.arange(c.height)), -1).reshape(-1, 2) + 0.5
        found.append(back_project(c, pixels[np.isfinite(z)], z[np.isfinite(z)]))
    return np.concatenate(found)


def sample(mesh: Mesh, count: int) -> np.ndarray:
    """Return points on a mesh [u], evenly by area, shape [N, 3]."""
    rng = np.random.default_rng(0)
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    which = rng.choice(len(area), count, p=area / area.sum())
    u, v = np.sort(rng.random((2, count)), axis=0)
    return u[:, None] * a[which] + (v - u)[:, None] * b[which] + (1 - v)[:, None] * c[which]


def distance_to_mesh(mesh: Mesh, points: np.ndarray) -> np.ndarray:
    """Return the distance [u] of points [N, 3] to the nearest point of a mesh, shape [N]."""
    import pyvista

    data = pyvista.PolyData.from_regular_faces(mesh.vertices, mesh.faces)
    return np.linalg.norm(data.find_closest_cell(points, return_closest_point=True)[1] - points, axis=1)


def summary(name: str, distances: np.ndarray, radius: float) -> dict:
    """Return mean, median and 90th percentile [u], each also over the radius, and the fractions within `NEAR`."""
    values = {"mean": distances.mean(), "median": np.median(distances), "p90": np.quantile(distances, 0.9)}
    row = {f"{name}_{k}": float(v) for k, v in values.items()}
    row |= {f"{k}_of_radius": v / radius for k, v in row.items()}
    return row | {f"{name}_within_{f}_of_radius": float((distances <= f * radius).mean()) for f in NEAR}
