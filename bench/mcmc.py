"""Preset `mcmc` beside preset `3dgs` and gsplat's own MCMC: held-out PSNR from the same images, cameras, split and points.

usage: python -m bench.mcmc SCENE [--seeds 3] [--steps 7000] [--split every:8] [--downscale 1] [--device cuda] --out FILE.json

For each seed preset `3dgs` is fitted first; the number of Gaussians that it ends with is the cap of the others. gsplat is
trained with the settings of its example trainer (bench/gsplat_trainer.py), once in our normalisation and once with the world
scaled as its own parser does: its noise and its regularizer of scales depend on the unit. All start from the points of the
first fit, and all images are scored by the same code. Rows that FILE.json holds are not measured again.
"""

from __future__ import annotations

import argparse
import dataclasses
import statistics
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from bench import gsplat_trainer, result_file
from bench.training import Trainer, finish, make_trainer, with_cap
from warpgs import load_scene
from warpgs.io.splits import split_views
from warpgs.pipeline.metrics.evaluate import render_view, score
from warpgs.pipeline.runs.request import choose_device
from warpgs.pipeline.runs.results import options_for
from warpgs.pipeline.train.config import PRESETS, FitConfig
from warpgs.scene import Scene, View

WHAT = "held-out PSNR of preset 3dgs, of preset mcmc and of gsplat's MCMC under the same cap, by seed"
BASE, OURS, PEER, PEER_OWN = "warpgs 3dgs", "warpgs mcmc", "gsplat mcmc", "gsplat mcmc, own units"
PROGRAMS = (BASE, OURS, PEER, PEER_OWN)


@dataclass(frozen=True)
class Study:
    """Inputs that all programs share."""

    scene: Scene
    train: list[View]
    test: list[View]
    steps: int
    device: torch.device

    def config(self, seed: int) -> FitConfig:
        """Return the settings of preset 3dgs."""
        return dataclasses.replace(PRESETS["3dgs"], steps=self.steps, seed=seed)

    def trainer(self, config: FitConfig) -> Trainer:
        """Return a trainer at step 0."""
        return make_trainer(self.train, self.scene.points, config, self.device, self.scene.background)


def scores(images: Iterator[np.ndarray], views: list[View]) -> dict:
    """Return mean PSNR [dB] and SSIM of images against their views, and the PSNR of each."""
    rows = [score(view, image) for view, image in zip(views, images, strict=True)]
    by_view = {row.name: row.psnr for row in rows}
    return {"psnr": statistics.mean(by_view.values()), "ssim": statistics.mean(r.ssim for r in rows), "views": by_view}


def our_row(study: Study, config: FitConfig) -> dict:
    """Train and score one of our fits."""
    trainer = study.trainer(config)
    points, begin = len(trainer.gaussians), time.perf_counter()
    finish(trainer)
    seconds, gaussians = time.perf_counter() - begin, trainer.gaussians
    options = options_for(config.rule, study.scene.background, gaussians)
    images = (render_view(gaussians, view, options)[0] for view in study.test)
    return {"points": points, "gaussians": len(gaussians), "seconds": seconds} | scores(images, study.test)


def peer_row(study: Study, seed: int, cap: int, own_units: bool) -> dict:
    """Train and score gsplat from the points of our first Gaussians.

    Raises:
        ValueError: The scene has a background, which gsplat's trainer does not know.
    """
    if any(study.scene.background):
        raise ValueError(f"{study.scene.path}: its background is {study.scene.background}; gsplat's trainer knows black alone")
    first = study.trainer(study.config(seed)).gaussians
    cameras = [view.camera for view in study.scene.views]
    scale = gsplat_trainer.own_scale(cameras, study.scene.normalization) if own_units else 1.0
    size = gsplat_trainer.scene_scale(cameras, scale)
    settings = gsplat_trainer.Settings(steps=study.steps, cap=cap)
    begin = time.perf_counter()
    params = gsplat_trainer.train(study.train, first, settings, seed=seed, scale=scale, size=size)
    if study.device.type == "cuda":
        torch.cuda.synchronize(study.device)
    row = {"points": len(first), "gaussians": len(params["means"]), "seconds": time.perf_counter() - begin}
    images = (gsplat_trainer.image_of(params, view, scale).clip(0, 1) for view in study.test)
    return row | {"unit": scale, "scene_scale": size} | scores(images, study.test)


def measure(study: Study, program: str, seed: int, cap: int | None) -> dict:
    """Train one program with one seed; ``cap`` is None for the fit that sets it."""
    config = study.config(seed)
    if program == BASE:
        return our_row(study, config)
    if program == OURS:
        ours = dataclasses.replace(PRESETS["mcmc"], steps=study.steps, seed=seed)
        return our_row(study, with_cap(ours, cap))
    return peer_row(study, seed, cap, program == PEER_OWN)


def table(rows: list[dict]) -> str:
    """Return mean and standard deviation over seeds as a Markdown table, and the paired difference to preset 3dgs."""
    base = {r["seed"]: r["psnr"] for r in rows if r["program"] == BASE}
    lines = ["| program | seeds | PSNR [dB] | to 3dgs, paired [dB] | SSIM | Gaussians | training [s] |", "|---" * 7 + "|"]
    for program in PROGRAMS:
        own = [r for r in rows if r["program"] == program]
        if not own:
            continue

        def spread(values: list[float], sign: str = "") -> str:
            deviation = f" ± {statistics.stdev(values):.2f}" if len(values) > 1 else ""
            return f"{statistics.mean(values):{sign}.2f}{deviation}"

        gains = [r["psnr"] - base[r["seed"]] for r in own]
        means = {k: statistics.mean(r[k] for r in own) for k in ("ssim", "gaussians", "seconds")}
        lines.append(
            f"| {program} | {len(own)} | {spread([r['psnr'] for r in own])} | {spread(gains, '+')} | {means['ssim']:.4f} | "
            f"{means['gaussians']:,.0f} | {means['seconds']:.1f} |"
        )
    return "\n".join(lines)


def run(study: Study, seeds: range, programs: tuple[str, ...], facts: dict, out: Path) -> list[dict]:
    """Measure what the file lacks, seed by seed, and write it after each row.

    Raises:
        ValueError: The file holds another study.
    """
    stored = result_file.read(out) if out.is_file() else facts | {"rows": []}
    if any(stored.get(k) != v for k, v in facts.items()):
        raise ValueError(f"{out}: holds a study of { ({k: stored.get(k) for k in facts}) }, not {facts}; choose another --out")
    rows = stored["rows"]
    for seed in seeds:
        for program in (BASE, *(p for p in programs if p != BASE)):
            if any((r["program"], r["seed"]) == (program, seed) for r in rows):
                continue
            cap = next((r["gaussians"] for r in rows if (r["program"], r["seed"]) == (BASE, seed)), None)
            rows.append({"program": program, "seed": seed, "cap": cap} | measure(study, program, seed, cap))
            result_file.write(out, result_file.result(WHAT, study.device, rows, **facts))
            r = rows[-1]
            print(
                f"seed {seed}  {program:<24} {r['psnr']:.2f} dB  {r['gaussians']:,} Gaussians  {r['seconds']:.1f} s", flush=True
            )
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Parse, measure, print the table; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first-seed", type=int, default=0, help="so that several processes can share the work")
    parser.add_argument("--steps", type=int, default=7000)
    parser.add_argument("--split", default="every:8")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--only", nargs="+", choices=PROGRAMS, default=PROGRAMS, metavar="PROGRAM", help=", ".join(PROGRAMS))
    parser.add_argument("--out", type=Path, required=True)
    a = parser.parse_args(arguments)
    scene = load_scene(a.scene, downscale=a.downscale)
    split = split_views(scene, a.split)
    train, test = ([scene.view(name) for name in names] for names in (split.train, split.test))
    study = Study(scene, train, test, a.steps, choose_device(a.device)[0])
    camera = train[0].camera
    print(f"{len(train)} training and {len(test)} held-out views, {camera.width} x {camera.height} px")
    facts = {"scene": Path(a.scene).resolve().name, "split": a.split, "downscale": a.downscale, "steps": a.steps}
    print(table(run(study, range(a.first_seed, a.first_seed + a.seeds), tuple(a.only), facts, a.out)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
