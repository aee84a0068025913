"""Errors of a model's rendered depth and of its mesh against the surfaces that its images were ray cast from."""

from __future__ import annotations

import importlib.util
import time
from dataclasses import replace

import numpy as np

from bench.lib.surfaces import distance_to, distance_to_mesh, sample, summary, true_depth
from warpgs.geometry import convert_points
from warpgs.mesh.fuse import MeshOptions, fuse
from warpgs.mesh.views import surface_view
from warpgs.pipeline.model.table import FittedModel
from warpgs.synthetic import raycast

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
    seconds, vertices = time.perf_counter() - began, convert_points(found.mesh.vertices, model.normalization, "scene", "file")
    mesh = replace(found.mesh, vertices=vertices)
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
