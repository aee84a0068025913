"""Objects cut out of their surroundings: held-out scores over white, rendered opacity, and the PLY over other backgrounds.

usage: python -m bench.objects [--objects 10] [--first 100] [--formats transforms colmap] [--presets default] [--seeds 1]
           [--views 24] [--size 400] [--jobs 1] [--seconds S] [--device auto] --out FILE.json
Each object is that of `warpgs demo --object --seed N` with eight training views, for N from --first on; choose settings on
other objects than those reported. Both formats hold the same views: transforms.json with RGBA images, COLMAP with cut-out
masks.
Rows that FILE.json holds are kept when the command is given again, those that failed are tried again.
"""

from __future__ import annotations

import argparse
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
from bench import result_file
from bench.one_fit import compile_all, config_of, figures_of
from bench.pool import finished
from bench.presets import stored_rows
from warpgs.pipeline.metrics.evaluate import summarize, to_8_bit
from warpgs.pipeline.metrics.psnr import psnr
from warpgs.pipeline.model.compress import drop_unused_sh
from warpgs.pipeline.runs.request import SceneRequest, choose_device
from warpgs.scene import Gaussians, View
from warpgs.synthetic.cut_out import FORMATS, write_object

WHAT = "fits of synthetic objects with true alpha: held-out PSNR over white, mean rendered alpha, and the PLY over backgrounds"
SCORES = ("psnr_white", "psnr_foreground", "ssim_white", "alpha_empty", "alpha_object", "ply_black", "ply_white", "ply_pattern")
"""Columns of the table, means over the held-out views; those with ``psnr`` and ``ply`` in dB."""
SQUARE = 12
"""Side of a square of the pattern [px]."""
PATTERN = ((0.9, 0.75, 0.2), (0.15, 0.3, 0.6))
"""Colours of the pattern's squares."""


@dataclass(frozen=True)
class Task:
    """One fit of one object."""

    object: int
    """Seed of the object."""
    format: str
    """``transforms`` or ``colmap``."""
    preset: str
    """As in `bench.one_fit.config_of`."""
    seed: int
    """Seed of the fit."""
    views: int
    size: int
    """Both sides of the images [px]."""
    device: str

    @property
    def key(self) -> dict:
        """What tells one result from another."""
        return {k: v for k, v in dataclasses.asdict(self).items() if k != "device"}


def backgrounds(height: int, width: int) -> dict[str, np.ndarray]:
    """Return the images to put an object before by name, colours in [0, 1], float32, shape [H, W, 3] each."""
    odd = (np.indices((height, width)) // SQUARE).sum(0) % 2 == 1
    pattern = np.where(odd[..., None], *(np.array(c, np.float32) for c in PATTERN))
    plain = {name: np.full((height, width, 3), value, np.float32) for name, value in (("black", 0), ("white", 1))}
    return plain | {"pattern": pattern.astype(np.float32)}


def over(view: View, behind: np.ndarray, ours: tuple[float, float, float]) -> np.ndarray:
    """Return a view's image [H, W, 3] before another background [H, W, 3] or [3] than its own."""
    shown: np.ndarray = view.image + (1 - view.alpha[..., None]) * (behind - np.float32(ours))
    return np.clip(shown, 0, 1)


@torch.no_grad()
def ply_scores(gaussians: Gaussians, views: list[View], own: tuple[float, float, float]) -> dict[str, float]:
    """Return the mean PSNR [dB] of Gaussians that know no background, as any viewer renders them, before each background.

    Args:
        gaussians: Those of a PLY file, in scene units [u].
        views: Views with their true alpha.
        own: Background that the views' images stand over.
    """
    found: dict[str, list[float]] = {}
    for view in views:
        r = warpgs.rasterize(gaussians, view.camera)  # over black
        image, alpha = r.rgb.cpu().numpy(), r.alpha.cpu().numpy()[..., None]
        for name, behind in backgrounds(*alpha.shape[:2]).items():
            pair = (to_8_bit(image + (1 - alpha) * behind), to_8_bit(over(view, behind, own)))
            found.setdefault(f"ply_{name}", []).append(psnr(*pair))
    return {name: float(np.mean(values)) for name, values in found.items()}


def measure(task: Task) -> dict:
    """Make the object, fit it, and return the scores of its held-out views and the figures of the fit."""
    config = replace(config_of(task.preset, torch.device(task.device)), seed=task.seed)
    side = {"width": task.size, "height": task.size}
    try:
        with tempfile.TemporaryDirectory() as work:
            folder, file = Path(work, "scene"), Path(work, "model.ply")
            split = write_object(folder, form=task.format, views=task.views, seed=task.object, **side)
            masks = "cutout" if task.format == "colmap" else "ignore"
            request = SceneRequest(str(folder), split, 1, masks=masks)
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


def line(row: dict) -> str:
    """Return a result in words."""
    head = f"object {row['object']} {row['format']:<10} {row['preset']} seed {row['seed']}"
    if "error" in row:
        return f"{head}  failed: {row['error']}"
    shown = "  ".join(f"{k} {row[k]:.{4 if 'alpha' in k or 'ssim' in k else 2}f}" for k in SCORES)
    return f"{head}  {shown}  {row['gaussians']:,} Gaussians  {row['steps']} steps"


def table(rows: list[dict]) -> str:
    """Return means over objects and seeds by format and preset, with the worst object's alphas, as a Markdown table."""
    lines = ["| format | preset | fits | " + " | ".join(SCORES) + " | worst alpha_empty | worst alpha_object |"]
    lines.append("|---" * (len(SCORES) + 5) + "|")
    good = [r for r in rows if "error" not in r]
    for form, preset in dict.fromkeys((r["format"], r["preset"]) for r in good):
        own = [r for r in good if (r["format"], r["preset"]) == (form, preset)]
        means = [f"{np.mean([r[k] for r in own]):.{4 if 'alpha' in k or 'ssim' in k else 2}f}" for k in SCORES]
        worst = [f"{max(r['alpha_empty'] for r in own):.4f}", f"{min(r['alpha_object'] for r in own):.4f}"]
        lines.append(f"| {form} | {preset} | {len(own)} | " + " | ".join([*means, *worst]) + " |")
    return "\n".join(lines)


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    """Return the arguments."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("--objects", type=int, default=10)
    p.add_argument("--first", type=int, default=100, help="seed of the first object")
    p.add_argument("--formats", nargs="+", choices=FORMATS, default=list(FORMATS))
    p.add_argument("--presets", nargs="+", default=["default"], help="also with settings: default:steps=500")
    p.add_argument("--seeds", type=int, default=1, help="fits of each object")
    p.add_argument("--views", type=int, default=24, help="8 train, the others are held out")
    p.add_argument("--size", type=int, default=400, help="sides of the images [px]")
    p.add_argument("--jobs", type=int, default=1, help="fits at a time")
    p.add_argument("--seconds", type=float, default=math.inf, help="after this long no further fit is begun")
    p.add_argument("--device", default="auto")
    p.add_argument("--out", type=Path, required=True)
    return p.parse_args(arguments)


def main(arguments: list[str] | None = None) -> int:
    """Measure, keep a row for each fit and print the table; return 1 if a fit failed."""
    a = parsed(arguments)
    device = choose_device(a.device)[0]
    tasks = [
        Task(a.first + i, form, preset, seed, a.views, a.size, str(device))
        for seed in range(a.seeds) for i in range(a.objects) for form in a.formats for preset in a.presets
    ]  # fmt: skip
    rows = stored_rows(a.out)
    todo = [t for t in tasks if not any(t.key.items() <= row.items() for row in rows)]
    first, done = functools.partial(compile_all, tuple(a.presets), str(device)), 0
    for task, figures in finished(measure, todo, a.jobs, a.seconds, first):
        rows.append(task.key | {"jobs": a.jobs} | figures)
        done += 1
        print(f"{done}/{len(todo)}", line(rows[-1]), flush=True)
        result_file.write(a.out, result_file.result(WHAT, device, rows))
    if done < len(todo):
        print(
            f"{len(todo) - done} fits were not begun: --seconds {a.seconds:g} had passed; give the command again for the rest"
        )
    print(table(rows))
    return int(any("error" in row for row in rows))


if __name__ == "__main__":
    sys.exit(main())
