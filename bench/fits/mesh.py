"""Error of the mesh of a fitted demo scene against the surfaces that its images were ray cast from, and that of rendered depth.

RUN is a fit of `warpgs demo` with --seed; a voxel of 0 is the default size. Accuracy is the distance from the mesh to the
nearest true surface. Completeness is the distance to the mesh from the true surface points at all pixels of the training views.
Distances are in scene units; the radius of the scene is half the diagonal of the box around these points.
"""

from __future__ import annotations

import itertools
from pathlib import Path

import numpy as np
import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.surface_errors import depth_rows, mesh_row
from bench.lib.surfaces import true_points
from bench.lib.tables import named
from warpgs.mesh.fuse import MeshOptions
from warpgs.pipeline.run.folder import open_run
from warpgs.synthetic.demo import still_life

WHAT = "accuracy and completeness of meshes of a fitted demo scene, and errors of rendered depth, against the ray cast surfaces"


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
