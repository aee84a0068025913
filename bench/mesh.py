"""Error of the mesh of a fitted demo scene against the surfaces that its images were ray cast from, and that of rendered depth.

usage: python -m bench.mesh --run RUN [--seed SEED] [--voxels V ...] [--depths median mean] [--out bench/results/mesh_cpu2.json]

RUN is a fit of `warpgs demo`. Accuracy is the distance from the mesh to the nearest true surface; completeness is the distance
from what the training views see, a point for each of their pixels, to the mesh. Distances are in scene units; the radius of
the scene is half the diagonal of the box around what the training views see.
"""

from __future__ import annotations

import argparse
import itertools
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from bench import result_file
from warpgs.coordinates import convert_mesh
from warpgs.geometry import back_project
from warpgs.mesh.fuse import MeshOptions, fuse
from warpgs.mesh.surface_views import surface_view
from warpgs.pipeline.model.model_file import FittedModel
from warpgs.pipeline.runs.folder import open_run
from warpgs.scene import Camera, Mesh
from warpgs.synthetic import raycast
from warpgs.synthetic.demo import still_life

WHAT = "accuracy and completeness of meshes of a fitted demo scene, and errors of rendered depth, against the ray cast surfaces"
SAMPLES = 100_000
NEAR = (0.005, 0.01, 0.02)
"""Distances, over the radius of the scene, within which fractions are counted."""


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
    """Return the z-depth [u] of the surfaces at the pixel centres, infinite where there is none, shape [H, W]."""
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


def depth_rows(model: FittedModel, shapes: list[raycast.Shape], radius: float, kinds: list[str]) -> list:
    """Return a row for each kind of rendered depth: its error over all pixels of the training views that have one."""
    rows = []
    for kind in kinds:
        errors, pixels = [], 0
        for name in model.train:
            view = surface_view(model.gaussians(), model.cameras()[name], model.options(), kind)
            z = view.depth.cpu().double().numpy() / model.normalization.scale
            known, true = (z > 0) & np.isfinite(z), true_depth(shapes, model.cameras("file")[name])
            errors.append(np.abs(z - true)[known])
            pixels += z.size
        error = np.concatenate(errors)
        rows.append({"row": "depth", "depth": kind, "covered": len(error) / pixels, **summary("error", error, radius)})
    return rows


def mesh_row(model: FittedModel, options: MeshOptions, shapes: list[raycast.Shape], seen: np.ndarray, radius: float) -> dict:
    """Make a mesh of a model and return its errors; a voxel of the options is in units of the files."""
    cameras, scale, began = [model.cameras()[n] for n in model.train], model.normalization.scale, time.perf_counter()
    scaled = replace(options, voxel=None if options.voxel is None else options.voxel * scale)
    found = fuse(model.gaussians(), cameras, model.options(), scaled)
    seconds, mesh = time.perf_counter() - began, convert_mesh(found.mesh, model.normalization, "scene", "file")
    on_mesh = sample(mesh, SAMPLES)
    off = np.min([distance_to(s, on_mesh) for s in shapes], axis=0)
    some = seen[:: max(1, len(seen) // SAMPLES)]
    return {
        "row": "mesh", "depth": options.depth, "voxel": found.plan.voxel / scale, "seconds": seconds,
        "grid": list(found.plan.shape), "unseen": found.unseen, "extracted": found.extracted,
        "triangles": len(mesh.faces), "uncolored": found.uncolored,
        **summary("accuracy", off, radius), **summary("completeness", distance_to_mesh(mesh, some), radius),
    }  # fmt: skip


def main() -> int:
    """Measure, print a line for each row, and write the result."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--run", type=Path, required=True, help="a fit of `warpgs demo`")
    parser.add_argument("--seed", type=int, default=0, help="seed of that demo")
    parser.add_argument(
        "--voxels", type=float, nargs="+", default=[0.08, 0.04, 0.02, 0.0], help="sizes of a voxel; 0 for the default"
    )
    parser.add_argument("--depths", nargs="+", default=["median", "mean"], help="kinds of depth")
    parser.add_argument("--max-faces", type=int, nargs="+", default=[10**9], help="most triangles of the meshes")
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    a = parser.parse_args()
    model, shapes = open_run(a.run, a.device), still_life(a.seed)
    cameras = [model.cameras("file")[n] for n in model.train]
    seen = true_points(shapes, cameras)
    radius = float(np.linalg.norm(seen.max(0) - seen.min(0)) / 2)
    rows = depth_rows(model, shapes, radius, a.depths)
    for kind, voxel, most in itertools.product(a.depths, a.voxels, a.max_faces):
        rows.append(mesh_row(model, MeshOptions(voxel or None, None, most, kind), shapes, seen, radius))
    for r in rows:
        print("  ".join(f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in r.items()))
    device = torch.device(a.device)
    result_file.write(a.out, result_file.result(WHAT, device, rows, radius=radius, views=len(cameras), steps=model.step))
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
