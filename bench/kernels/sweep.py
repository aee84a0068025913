"""Time of sweeping planes for 3 to 54 views, and the fraction of pixels whose depth other views confirm.

Views are those of the demo scene at 320 x 240 px, or as many of a scene's photographs, evenly chosen. Seconds are those of
`sweep_depths` alone, wall time and processor time (the sum over threads, which other programs disturb less).
"""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import numpy as np
import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.tables import named
from warpgs.io.load import load_scene
from warpgs.pipeline.model.depth_points import depth_bounds
from warpgs.pipeline.model.start import camera_depths
from warpgs.priors.flow import triangulate_matches
from warpgs.priors.sweep import SweepConfig, sweep_depths
from warpgs.scene import View
from warpgs.synthetic import demo, raycast

WHAT = "seconds of a plane sweep by the number of views, and the fraction of pixels with consistent depth"


def demo_views(count: int, width: int = 320, height: int = 240) -> list[View]:
    """Return views along the demo's path."""
    shapes, light = demo.still_life(0), raycast.Light()
    cameras = demo.camera_path(count, width, height)
    return [View(f"{i}", c, raycast.render(shapes, light, c.K, c.viewmat, width, height)) for i, c in enumerate(cameras)]


def row(views: list[View], device: torch.device, repeats: int) -> dict:
    """Return the measurement of one number of views; the first call, which loads kernels, is not counted."""
    points = triangulate_matches(views).points
    bounds = [depth_bounds(v, points, camera_depths(views)) for v in views]
    sweep_depths(views[:2], bounds[:2], SweepConfig(max_pixels=2000), device)
    walls, processor, depths = [], [], []
    for _ in range(repeats):
        wall, cpu = time.perf_counter(), time.process_time()
        depths = sweep_depths(views, bounds, SweepConfig(), device)
        walls.append(time.perf_counter() - wall)
        processor.append(time.process_time() - cpu)
    found = [d.coverage for d in depths if d.valid.any()]
    return {
        "views": len(views), "swept": min(len(views), SweepConfig().max_views), "width": views[0].camera.width,
        "height": views[0].camera.height, "threads": torch.get_num_threads(), "wall_s": statistics.median(walls),
        "processor_s": statistics.median(processor), "wall_s_per_view": statistics.median(walls) / len(views),
        "coverage": float(np.mean(found)) if found else 0.0,
    }  # fmt: skip


def main() -> None:
    """Measure every number of views, and write the result."""
    a = parse(__doc__, None, scene=Path, views=[3, 6, 12, 24, 54], device="cpu", repeats=3, out=Path)
    device, rows = torch.device(a.device), []
    photos = [] if a.scene is None else list(load_scene(a.scene).views)
    for count in a.views:
        if a.scene is None:
            views = demo_views(count)
        else:
            views = [photos[round(i)] for i in np.linspace(0, len(photos) - 1, min(count, len(photos)))]
        rows.append(row(views, device, a.repeats))
        print(named(rows[-1]), flush=True)
    result_file.keep(a.out, WHAT, device, rows)


if __name__ == "__main__":
    main()
