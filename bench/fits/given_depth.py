"""Fits of the demo scene without and with given depth and normals: held-out scores, and errors of depth and mesh.

A map is a name of `bench.lib.demo_maps.KINDS`, with `+normals` to add true normals. Errors are mean distances divided by the
radius of the scene, as in `bench.fits.mesh`. Rows in --out are kept when the command is repeated.
"""

from __future__ import annotations

import dataclasses
import functools
import gc
import math
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import warpgs
from bench.lib.arguments import parse
from bench.lib.demo_maps import KINDS, write_maps
from bench.lib.one_fit import compile_all, config_of, figures_of
from bench.lib.pool import measure_all
from bench.lib.surface_errors import depth_rows, mesh_row
from bench.lib.surfaces import true_points
from bench.lib.tables import markdown, mean_sd
from warpgs.mesh.fuse import MeshOptions
from warpgs.pipeline.run.request import SceneRequest, choose_device
from warpgs.synthetic.demo import camera_path, split_spec, still_life, write_demo

WHAT = "fits of the demo scene without and with given depth and normals: held-out scores, errors of rendered depth and mesh"
SCORES = {
    "psnr": "PSNR [dB]",
    "ssim": "SSIM",
    "depth": "depth",
    "accuracy": "mesh to surface",
    "completeness": "surface to mesh",
}
"""Columns of the table; the last three in percent of the scene's radius."""


@dataclass(frozen=True)
class Task:
    """One fit."""

    maps: str
    """Name of the depth maps, with ``+normals`` for normals, too."""
    preset: str
    """Preset and settings for `bench.lib.one_fit.config_of`."""
    views: str
    """``few`` for the demo's six training views, ``many`` for seven of eight."""
    seed: int
    """Seed of the fit."""
    scene: int
    """Seed of the scene's patterns."""
    width: int
    """Width of the images [px]."""
    device: str

    @property
    def key(self) -> dict:
        """Values that tell one result from another."""
        return {k: v for k, v in dataclasses.asdict(self).items() if k != "device"}


def measure(task: Task) -> dict:
    """Write the scene and its maps, fit it, and return scores and errors."""
    name, _, more = task.maps.partition("+")
    height, shapes = task.width * 3 // 4, still_life(task.scene)
    try:
        with tempfile.TemporaryDirectory() as work:
            folder = Path(work, "scene")
            write_demo(folder, views=24, width=task.width, height=height, seed=task.scene)
            split = split_spec(24) if task.views == "few" else "every:8"
            cameras = {f"{i:03d}.png": c for i, c in enumerate(camera_path(24, task.width, height))}
            write_maps(Path(work), name, more == "normals", shapes, cameras)
            request = SceneRequest(
                str(folder), split, downscale=1, depths=str(Path(work, "depths")) if KINDS[name] else None,
                normals=str(Path(work, "normals")) if more else None, depth_kind=KINDS[name] or "metric",
            )  # fmt: skip
            fitted = warpgs.fit(request, config_of(task.preset, task.seed), device=task.device, verbose=False)
            row = figures_of(fitted.metrics)
            seen = true_points(shapes, [fitted.cameras("file")[n] for n in fitted.train])
            radius = float(np.linalg.norm(seen.max(0) - seen.min(0)) / 2)
            (depth,) = depth_rows(fitted, shapes, radius, ["median"])
            mesh = mesh_row(fitted, MeshOptions(None, None, 10**9, "median"), shapes, seen, radius)
            errors = {"depth": depth["error_mean_of_radius"]}
            errors |= {k: mesh.get(f"{k}_mean_of_radius", math.nan) for k in ("accuracy", "completeness")}
            return {k: row[k] for k in ("psnr", "ssim", "gaussians", "steps", "setup", "training")} | errors | {
                "notes": [n for n in fitted.notes if "given" in n or n.startswith("start")]
            }  # fmt: skip
    finally:
        gc.collect()  # a fit and its recorded steps refer to each other: without this their device memory piles up


def _cell(name: str, values: list[float]) -> str:
    if name in ("psnr", "ssim"):
        return mean_sd(values, 2 if name == "psnr" else 3)
    return mean_sd([100 * v for v in values], 2)


def line(row: dict) -> str:
    """Return a result in words."""
    shown = "  ".join(f"{k} {row[k]:.4g}" for k in SCORES)
    return f"{shown}  {row['gaussians']:,} Gaussians  {row['steps']} steps  {row['training']:.0f} s"


def table(rows: list[dict]) -> str:
    """Return means over seeds by views, preset and maps as a Markdown table."""
    good, lines = [r for r in rows if "error" not in r], []
    for key in dict.fromkeys((r["views"], r["preset"], r["maps"]) for r in good):
        own = [r for r in good if (r["views"], r["preset"], r["maps"]) == key]
        lines.append([*key, len(own), *(_cell(k, [r[k] for r in own]) for k in SCORES)])
    return markdown(["views", "preset", "maps", "fits", *SCORES.values()], lines)


def main(arguments: list[str] | None = None) -> int:
    """Measure, keep a row for each fit and print the table; return 1 if a fit failed."""
    a = parse(
        __doc__, arguments, need=("out",),
        maps=["none", "noise", "sparse", "relative", "bent", "none+normals", "noise+normals"],
        presets=["default"], views=["few", "many"], seeds=3, scene=0, width=320, jobs=1, seconds=math.inf, device="auto",
        out=Path,
    )  # fmt: skip
    device = choose_device(a.device)[0]
    tasks = [
        Task(maps, preset, views, seed, a.scene, a.width, str(device))
        for seed in range(a.seeds) for views in a.views for preset in a.presets for maps in a.maps
    ]  # fmt: skip
    rows = measure_all(measure, tasks, functools.partial(compile_all, tuple(a.presets), str(device)), a, WHAT, device, line)
    print(table(rows))
    return int(any("error" in row for row in rows))


if __name__ == "__main__":
    sys.exit(main())
