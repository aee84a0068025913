"""Order of near and far in a run: rendered depth of held-out views against a reconstruction's points.

SCENE is a COLMAP folder of the same photographs, usually the one that was fitted. For each held-out view of the run the points
that the reconstruction saw in it are looked up in the rendering, and Spearman's rank correlation of the two depths is printed:
1 where all pairs of points are in the right order, 0 where the order is chance. Ranks know no unit, so the run may have been
made from another format, in other units and at another size; views are matched by name. The points were not seen by the fit
unless it started from them (``--init.source points``).
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
from warpgs.pipeline.runs.folder import open_run
from warpgs.render.rasterize import rasterize


@torch.no_grad()
def run_order(run: Path, scene: Path, device: torch.device) -> Iterator[dict]:
    """Yield the order of each held-out view of a run.

    Raises:
        DataError: The folder is no run, it holds no view out, the scene has no points with tracks, or lacks a view.
    """
    stored = open_run(run, device)
    if not stored.record["test"]:
        raise DataError(f"{run}: holds no view out, so there is none to look at; fit with --split")
    source = load_scene(str(scene), downscale=stored.record["scene"]["downscale"])
    if source.points is None or source.points.tracks is None:
        raise DataError(f"{scene}: has no points that name the views which saw them; give a COLMAP folder")
    gaussians, cameras = stored.gaussians(), stored.cameras()
    options = stored.options()
    for name in stored.record["test"]:
        if name not in {v.name for v in source.views}:
            raise DataError(f"{scene}: lacks {name}, which {run} holds out; give the reconstruction of the same photographs")
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
