"""Order of near and far in a run: rendered depth of held-out views against a reconstruction's points.

SCENE is a COLMAP folder of the same photographs, usually the one that was fitted. For each held-out view of the run, depths of
the reconstruction's points in that view are compared with rendered depths at these points. Spearman's rank correlation is
printed: 1 if all pairs of points are in the right order, 0 for a random order. Ranks have no unit, so the run may have another
    format, unit
and size; views are matched by name. The fit does not use the points unless it starts from them (``--init.source points``).
"""

from __future__ import annotations

import math
import statistics
import sys
from collections.abc import Iterator
from pathlib import Path

import torch

from bench.lib.arguments import parse
from bench.lib.depth_order import depth_order
from bench.lib.tables import named
from warpgs.errors import DataError, WarpgsError
from warpgs.io.load import load_scene
from warpgs.pipeline.run.folder import open_run
from warpgs.render.rasterize import rasterize


@torch.no_grad()
def run_order(run: Path, scene: Path, device: torch.device) -> Iterator[dict]:
    """Yield the order of each held-out view of a run.

    Raises:
        DataError: The folder is not a run, the run has no held-out view, or the scene has no points with tracks, or lacks a
            view.
    """
    stored = open_run(run, device)
    if not stored.record["test"]:
        raise DataError(f"{run}: no view is held out; fit with --split")
    source = load_scene(str(scene), downscale=stored.record["scene"]["downscale"])
    if source.points is None or source.points.tracks is None:
        raise DataError(f"{scene}: has no points with tracks; give a COLMAP folder")
    gaussians, cameras = stored.gaussians(), stored.cameras()
    options = stored.options()
    for name in stored.record["test"]:
        if name not in {v.name for v in source.views}:
            raise DataError(f"{scene}: held-out view {name} of {run} is missing; give a reconstruction of the same photographs")
        render = rasterize(gaussians, cameras[name], options)
        depth, alpha = render.depth.cpu().numpy(), render.alpha.cpu().numpy()
        yield {"view": name} | depth_order(depth, alpha, source.view(name).camera, source.points.seen_by({name}))


def main(arguments: list[str] | None = None) -> int:
    """Print a line per held-out view and the mean; returns the exit code."""
    a, known = parse(__doc__, arguments, {"run": Path, "scene": Path}, device="cpu"), []
    try:
        for row in run_order(a.run, a.scene, torch.device(a.device)):
            print(named(row))
            known += [] if math.isnan(row["correlation"]) else [row["correlation"]]
    except WarpgsError as e:
        print(f"depth_order: {e}", file=sys.stderr)
        return e.exit_code
    print(f"mean of {len(known)} views: {statistics.mean(known):.4f}" if known else "no view has enough points")
    return 0


if __name__ == "__main__":
    sys.exit(main())
