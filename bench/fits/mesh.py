"""Error of the mesh of a fitted demo scene against the surfaces that its images were ray cast from, and that of rendered depth.

RUN is a fit of `warpgs demo` with --seed; a voxel of 0 is the default size. Accuracy is the distance from the mesh to the
nearest true surface. Completeness is the distance to the mesh from the true surface points at all pixels of the training views.
Distances are in scene units; the radius of the scene is half the diagonal of the box around these points.
"""

from __future__ import annotations

import importlib.util
import itertools
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.surfaces import distance_to, distance_to_mesh, sample, summary, true_depth, true_points
from bench.lib.tables import named
from warpgs.geometry import convert_mesh
from warpgs.mesh.fuse import MeshOptions, fuse
from warpgs.mesh.views import surface_view
from warpgs.pipeline.model.table import FittedModel
from warpgs.pipeline.run.folder import open_run
from warpgs.synthetic import raycast
from warpgs.synthetic.demo import still_life

WHAT = "accuracy and completeness of meshes of a fitted demo scene, and errors of rendered depth, against the ray cast surfaces"


SAMPLES = 100_000


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
    """Make a mesh of a model and return its errors, completeness where pyvista is there; voxels are in units of the files."""
    cameras, scale, began = [model.cameras()[n] for n in model.train], model.normalization.scale, time.perf_counter()
    scaled = replace(options, voxel=None if options.voxel is None else options.voxel * scale)
    found = fuse(model.gaussians(), cameras, model.options(), scaled)
    seconds, mesh = time.perf_counter() - began, convert_mesh(found.mesh, model.normalization, "scene", "file")
    on_mesh = sample(mesh, SAMPLES)
    off = np.min([distance_to(s, on_mesh) for s in shapes], axis=0)
    some = seen[:: max(1, len(seen) // SAMPLES)]
    complete = {}
    if importlib.util.find_spec("pyvista") is not None:
        complete = summary("completeness", distance_to_mesh(mesh, some), radius)
    return {
        "row": "mesh", "depth": options.depth, "voxel": found.plan.voxel / scale, "seconds": seconds,
        "grid": list(found.plan.shape), "unseen": found.unseen, "extracted": found.extracted,
        "triangles": len(mesh.faces), "uncolored": found.uncolored,
        **summary("accuracy", off, radius), **complete,
    }  # fmt: skip


def main() -> int:
    """Measure, print a line for each row, and write the result."""
    a = parse(
        __doc__, None, need=("run",), run=Path, seed=0, voxels=[0.08, 0.04, 0.02, 0.0], depths=["median", "mean"],
        max_faces=[10**9], device="cpu", out=Path,
    )  # fmt: skip
    model, shapes = open_run(a.run, a.device), still_life(a.seed)
    cameras = [model.cameras("file")[n] for n in model.train]
    seen = true_points(shapes, cameras)
    radius = float(np.linalg.norm(seen.max(0) - seen.min(0)) / 2)
    rows = depth_rows(model, shapes, radius, a.depths)
    for kind, voxel, most in itertools.product(a.depths, a.voxels, a.max_faces):
        rows.append(mesh_row(model, MeshOptions(voxel or None, None, most, kind), shapes, seen, radius))
    print(*map(named, rows), sep="\n")
    device = torch.device(a.device)
    result_file.keep(a.out, WHAT, device, rows, radius=radius, views=len(cameras), steps=model.step)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
