"""Objects cut out of their surroundings: held-out scores over white, rendered opacity, and the PLY over other backgrounds.

Each object is that of `warpgs demo --object --seed N` with eight training views, for N from --first on. Choose settings on
objects that are not reported. Both formats have the same views: transforms.json with RGBA images, COLMAP with cut-out masks.
Rows in --out are kept when the command is repeated; failed rows are tried again.
"""

from __future__ import annotations

import dataclasses
import functools
import gc
import math
import sys
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

import warpgs
from bench.lib.arguments import parse
from bench.lib.backgrounds import over, ply_scores
from bench.lib.one_fit import compile_all, config_of, figures_of
from bench.lib.pool import measure_all
from bench.lib.tables import markdown
from warpgs.pipeline.metrics.scores import summarize
from warpgs.pipeline.model.edit import drop_unused_sh
from warpgs.pipeline.run.request import SceneRequest, choose_device
from warpgs.scene import Gaussians
from warpgs.synthetic.demo import FORMATS, write_object

WHAT = "fits of synthetic objects with true alpha: held-out PSNR over white, mean rendered alpha, and the PLY over backgrounds"
SCORES = ("psnr_white", "psnr_foreground", "ssim_white", "alpha_empty", "alpha_object", "ply_black", "ply_white", "ply_pattern")
"""Columns of the table, means over the held-out views; those with ``psnr`` and ``ply`` in dB."""


@dataclass(frozen=True)
class Task:
    """One fit of one object."""

    object: int
    """Seed of the object."""
    format: str
    """``transforms`` or ``colmap``."""
    preset: str
    """Preset and settings for `bench.lib.one_fit.config_of`."""
    seed: int
    """Seed of the fit."""
    views: int
    size: int
    """Both sides of the images [px]."""
    device: str

    @property
    def key(self) -> dict:
        """Values that tell one result from another."""
        return {k: v for k, v in dataclasses.asdict(self).items() if k != "device"}


def measure(task: Task) -> dict:
    """Make the object, fit it, and return the scores of its held-out views and the figures of the fit."""
    config = config_of(task.preset, task.seed)
    side = {"width": task.size, "height": task.size}
    try:
        with tempfile.TemporaryDirectory() as work:
            folder, file = Path(work, "scene"), Path(work, "model.ply")
            split = write_object(folder, form=task.format, views=task.views, seed=task.object, **side)
            masks = "cutout" if task.format == "colmap" else "ignore"
            request = SceneRequest(str(folder), split, downscale=1, masks=masks)
            fitted = warpgs.fit(request, config, device=task.device, verbose=False)
            scene = warpgs.load_scene(folder, masks=masks)
            test = [scene.view(name) for name in fitted.test]
            device = fitted.gaussians().means.device
            warpgs.write_ply(file, drop_unused_sh(fitted.gaussians()), fitted.normalization, units="scene")
            stored = warpgs.read_ply(file, fitted.normalization, units="scene").tensors()
            ply = ply_scores(Gaussians(**{k: t.to(device) for k, t in stored.items()}), test, scene.background)
            options = replace(fitted.options(), background=torch.ones(3, device=device))
            white = [replace(v, image=over(v, np.ones(3, np.float32), scene.background)) for v in test]
            means = summarize(warpgs.evaluate(fitted.gaussians(), white, options))
            # of the opacity, the numbers that are independent of the background; of colours those over white
            scores = {k: means[k] for k in ("psnr_foreground", "alpha_empty", "alpha_object")}
            row = figures_of(fitted.metrics)
            row = {("fit_" + k if k in ("psnr", "ssim") else k): v for k, v in row.items()}
            return {"psnr_white": means["psnr_whole"], "ssim_white": means["ssim"]} | scores | ply | row
    finally:
        gc.collect()  # a fit and its recorded steps refer to each other: without this their device memory piles up


def _score(name: str, values: list[float]) -> str:
    return f"{np.mean(values):.{4 if 'alpha' in name or 'ssim' in name else 2}f}"


def line(row: dict) -> str:
    """Return a result in words."""
    shown = "  ".join(f"{k} {_score(k, [row[k]])}" for k in SCORES)
    return f"{shown}  {row['gaussians']:,} Gaussians  {row['steps']} steps"


def table(rows: list[dict]) -> str:
    """Return means over objects and seeds by format and preset, with the worst object's alphas, as a Markdown table."""
    good, lines = [r for r in rows if "error" not in r], []
    for form, preset in dict.fromkeys((r["format"], r["preset"]) for r in good):
        own = [r for r in good if (r["format"], r["preset"]) == (form, preset)]
        worst = [f"{max(r['alpha_empty'] for r in own):.4f}", f"{min(r['alpha_object'] for r in own):.4f}"]
        lines.append([form, preset, len(own), *(_score(k, [r[k] for r in own]) for k in SCORES), *worst])
    return markdown(["format", "preset", "fits", *SCORES, "worst alpha_empty", "worst alpha_object"], lines)


def main(arguments: list[str] | None = None) -> int:
    """Measure, keep a row for each fit and print the table; return 1 if a fit failed."""
    a = parse(
        __doc__, arguments, need=("out",), objects=10, first=100, formats=list(FORMATS), presets=["default"], seeds=1,
        first_seed=0, views=24, size=400, jobs=1, seconds=math.inf, device="auto", out=Path,
    )  # fmt: skip
    device = choose_device(a.device)[0]
    tasks = [
        Task(a.first + i, form, preset, seed, a.views, a.size, str(device))
        for seed in range(a.first_seed, a.first_seed + a.seeds)
        for i in range(a.objects) for form in a.formats for preset in a.presets
    ]  # fmt: skip
    rows = measure_all(measure, tasks, functools.partial(compile_all, tuple(a.presets), str(device)), a, WHAT, device, line)
    print(table(rows))
    return int(any("error" in row for row in rows))


if __name__ == "__main__":
    sys.exit(main())
