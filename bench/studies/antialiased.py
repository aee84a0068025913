"""Scores of held-out views at half, full and double size, by the filters of a fit.

Photos are fitted at --downscale D. Views are scored at downscale 2 D, D and D / 2, each against photos of that size: the stored
ones, or means over their pixels. Double size requires an even D, because photos larger than the stored ones do not exist.
"""

from __future__ import annotations

import functools
import gc
import math
import statistics
import sys
from dataclasses import dataclass
from pathlib import Path

import warpgs
from bench.lib.arguments import SCENE, parse
from bench.lib.one_fit import compile_all, config_of
from bench.lib.pool import measure_all
from bench.lib.scenes import scene_at
from bench.lib.tables import named
from warpgs.errors import WarpgsError
from warpgs.io.load import split_views
from warpgs.pipeline.run.request import choose_device

FILTERS = {"none": "", "2D": "antialiased=true,limits.min_pixels=0", "2D and 3D": "antialiased=true"}
"""Settings of each row."""
SIZES = ("half", "full", "double")


@dataclass(frozen=True)
class Task:
    """One fit, scored at each size."""

    filters: str
    split: str
    seed: int
    folder: str
    preset: str
    downscale: int
    device: str

    @property
    def key(self) -> dict:
        """Values that tell one result from another."""
        return {k: getattr(self, k) for k in ("filters", "split", "seed", "preset", "downscale")}


def changed(preset: str, filters: str) -> str:
    """Return a preset, which may have settings, with the settings of filters added."""
    return f"{preset}{',' if ':' in preset else ':'}{FILTERS[filters]}"


def measure(task: Task) -> dict:
    """Fit, and return the mean PSNR and SSIM of held-out views at each size."""
    config = config_of(changed(task.preset, task.filters), task.seed)
    fitted = warpgs.fit(scene_at(task.folder, task.downscale), config, split=task.split, device=task.device, verbose=False)
    row = {"gaussians": fitted.metrics["gaussians"], "training": fitted.metrics["seconds"]["training"]}
    for size, downscale in zip(SIZES, (2 * task.downscale, task.downscale, task.downscale / 2), strict=True):
        if downscale == int(downscale):
            scene = scene_at(task.folder, int(downscale))
            views = [scene.view(name) for name in split_views(scene, task.split).test]
            scores = warpgs.evaluate(fitted.gaussians(), views, fitted.options())
            row |= {f"{k}_{size}": statistics.mean(getattr(s, k) for s in scores) for k in ("psnr", "ssim")}
    gc.collect()  # a fit and its recorded steps refer to each other: without this their device memory piles up
    return row


def line(row: dict) -> str:
    """Return a result in words."""
    return "  ".join(f"{size} {row[f'psnr_{size}']:.2f} dB" for size in SIZES if f"psnr_{size}" in row)


def table(rows: list[dict]) -> list[dict]:
    """Return the means over seeds, and of PSNR the standard error of the difference to the first row of the split."""
    found = []
    for split in dict.fromkeys(r["split"] for r in rows):
        own = [r for r in rows if r["split"] == split and "error" not in r]
        base = {r["seed"]: r for r in own if r["filters"] == "none"}
        for name in FILTERS:
            of = [r for r in own if r["filters"] == name]
            mean = {k: statistics.mean(r[k] for r in of) for k in (of[0] if of else {}) if k.startswith(("psnr", "ssim"))}
            for k in [k for k in mean if k.startswith("psnr")]:
                differences = [r[k] - base[r["seed"]][k] for r in of if r["seed"] in base]
                if name != "none" and len(differences) > 1:
                    mean[f"{k}_gain"] = statistics.mean(differences)
                    mean[f"{k}_error"] = statistics.stdev(differences) / math.sqrt(len(differences))
            found.append({"split": split, "filters": name, "fits": len(of)} | mean)
    return found


def main(arguments: list[str] | None = None) -> int:
    """Print a line per fit and the means; return the exit code."""
    a = parse(
        __doc__, arguments, SCENE, splits=["llff:3", "llff:9"], preset="default", downscale=2, seeds=4, first_seed=0, jobs=1,
        seconds=math.inf, device="auto", out=Path,
    )  # fmt: skip
    device = choose_device(a.device)[0]
    seeds = range(a.first_seed, a.first_seed + a.seeds)
    places = [(s, split, f) for s in seeds for split in a.splits for f in FILTERS]
    tasks = [Task(f, split, s, str(a.scene), a.preset, a.downscale, str(device)) for s, split, f in places]
    presets = tuple(changed(a.preset, name) for name in FILTERS)
    try:
        first = functools.partial(compile_all, presets, str(device))
        rows = measure_all(measure, tasks, first, a, "scores at other sizes by filter", device, line)
    except WarpgsError as e:
        print(f"bench.studies.antialiased: {e}", file=sys.stderr)
        return e.exit_code
    for row in table(rows):
        print(named(row))
    return int(any("error" in row for row in rows))


if __name__ == "__main__":
    sys.exit(main())
