"""Order of near and far in a run: rendered depth of held-out views against a reconstruction's points.

    python -m bench.experiments.depth_order RUN SCENE

SCENE is a COLMAP folder of the same photographs, usually the one that was fitted. For each held-out view of the run the points
that the reconstruction saw in it are looked up in the rendering, and Spearman's rank correlation of the two depths is printed:
1 where all pairs of points are in the right order, 0 where the order is chance. Ranks know no unit, so the run may have been
made from another format, in other units and at another size; views are matched by name. The points were not seen by the fit
unless it started from them (``--init.source points``).
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from warpgs import geometry
from warpgs.errors import DataError, WarpgsError
from warpgs.io.load import load_scene
from warpgs.pipeline.runs.folder import open_run
from warpgs.pipeline.runs.results import options_for
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians, PointCloud

MIN_POINTS = 10
"""Points on which something must be drawn; a correlation of fewer says little."""
MIN_ALPHA = 0.5
"""A pixel that is covered less has no depth."""


@dataclass(frozen=True)
class Order:
    """Agreement of one view's depths with the points in order."""

    name: str
    points: int
    """Points that the view sees."""
    drawn: int
    """Number of those points on which something is rendered."""
    correlation: float
    """Spearman's rank correlation, in [-1, 1]; NaN where fewer than 10 points are drawn, or depth is constant."""


def depth_order(name: str, depth: np.ndarray, alpha: np.ndarray, camera: Camera, seen: PointCloud) -> Order:
    """Compare a rendering with the points that its view saw.

    Args:
        name: Of the view.
        depth: Rendered z-depth, any unit, shape [H, W].
        alpha: Rendered opacity, shape [H, W].
        camera: Of the view in the points' coordinates, any size of the same image.
        seen: Points whose track holds the view.
    """
    from scipy.stats import spearmanr

    inside = geometry.in_image(camera, seen.points)
    pixels, wanted = geometry.project_points(camera, seen.points[inside])
    height, width = depth.shape
    columns, rows = np.floor(pixels * (np.array([width, height]) / [camera.width, camera.height])).astype(int).T
    drawn = (alpha[rows, columns] > MIN_ALPHA) & (depth[rows, columns] > 0)
    found, wanted = depth[rows, columns][drawn], wanted[drawn]
    correlation = float("nan")
    if len(found) >= MIN_POINTS and np.ptp(found) > 0 and np.ptp(wanted) > 0:
        correlation = float(spearmanr(found, wanted).statistic)
    return Order(name, int(inside.sum()), len(found), correlation)


@torch.no_grad()
def run_order(run: Path, scene: Path, device: torch.device) -> list[Order]:
    """The order of each held-out view of a run, in their order.

    Raises:
        DataError: The folder is no run, it holds no view out, the scene has no points with tracks, or lacks a view.
    """
    stored = open_run(run, device)
    names = stored.record["test"]
    if not names:
        raise DataError(f"{run}: holds no view out, so there is none to look at; fit with --split")
    source = load_scene(str(scene), downscale=stored.record["scene"]["downscale"])
    if source.points is None or source.points.tracks is None:
        raise DataError(f"{scene}: has no points that name the views which saw them; give a COLMAP folder")
    known = {v.name for v in source.views}
    missing = [n for n in names if n not in known]
    if missing:
        raise DataError(f"{scene}: lacks {missing[0]}, which {run} holds out; give the reconstruction of the same photographs")
    return [_of_view(n, stored.gaussians(), stored.cameras()[n], source, stored.record) for n in names]


def _of_view(name: str, gaussians: Gaussians, camera: Camera, source, record: dict) -> Order:
    options = options_for(record["config"]["rule"], tuple(record["background"]), gaussians)
    render = rasterize(gaussians, camera, options)
    depth, alpha = render.depth.cpu().numpy(), render.alpha.cpu().numpy()
    return depth_order(name, depth, alpha, source.view(name).camera, source.points.seen_by({name}))


def main(arguments: list[str] | None = None) -> int:
    """Print a line per held-out view and the mean; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m bench.experiments.depth_order", description=__doc__.split("\n\n", maxsplit=1)[0]
    )
    parser.add_argument("run", type=Path, help="run folder of `warpgs fit`")
    parser.add_argument("scene", type=Path, help="COLMAP folder of the same photographs")
    parser.add_argument("--device", default="cpu", help="where to render")
    a = parser.parse_args(arguments)
    try:
        orders = run_order(a.run, a.scene, torch.device(a.device))
    except WarpgsError as e:
        print(f"depth_order: {e}", file=sys.stderr)
        return e.exit_code
    for o in orders:
        print(f"{o.name}: rank correlation {o.correlation:.4f} over {o.drawn:,} of {o.points:,} points")
    known = [o.correlation for o in orders if o.correlation == o.correlation]
    print(f"mean of {len(known)} views: {np.mean(known):.4f}" if known else "no view has enough points")
    return 0


if __name__ == "__main__":
    sys.exit(main())
