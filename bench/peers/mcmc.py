"""Preset `mcmc` beside preset `3dgs` and gsplat's own MCMC: held-out PSNR from the same images, cameras, split and points.

For each seed preset `3dgs` is fitted first; its final number of Gaussians is the cap of the other programs. gsplat is trained
with the settings of its example trainer (bench/lib/gsplat_trainer.py), once in our normalisation and once with the world scaled
as by its own parser, because its noise and its regularizer of scales depend on the unit. All programs have the initial points
of the first fit, and the same code scores all images. Rows in --out are not measured again.
"""

from __future__ import annotations

import dataclasses
import statistics
import sys
from dataclasses import dataclass
from pathlib import Path

import torch

from bench.lib import gsplat_trainer, result_file
from bench.lib.arguments import SCENE, parse
from bench.lib.one_fit import bare_fit, scores
from bench.lib.pool import stored_rows
from bench.lib.tables import markdown, mean_sd
from bench.lib.training import make_trainer, with_cap
from warpgs import load_scene
from warpgs.io.load import split_views
from warpgs.pipeline.run.request import choose_device
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.settings import FitConfig
from warpgs.scene import Scene, View

WHAT = "held-out PSNR of preset 3dgs, of preset mcmc and of gsplat's MCMC under the same cap, by seed"
BASE, OURS, PEER, PEER_OWN = "warpgs 3dgs", "warpgs mcmc", "gsplat mcmc", "gsplat mcmc, own units"
PROGRAMS = (BASE, OURS, PEER, PEER_OWN)
KEPT = ("points", "gaussians", "seconds", "psnr", "ssim", "views", "unit", "scene_scale")


@dataclass(frozen=True)
class Study:
    """Inputs that all programs share."""

    scene: Scene
    train: list[View]
    test: list[View]
    steps: int
    device: torch.device

    def config(self, preset: str, seed: int) -> FitConfig:
        """Return the settings of one of our presets."""
        return dataclasses.replace(PRESETS[preset], steps=self.steps, seed=seed)


def measure(study: Study, program: str, seed: int, cap: int) -> dict:
    """Train and score one program with one seed; preset 3dgs, which sets the cap, has no cap itself."""
    if program in (BASE, OURS):
        config = study.config("3dgs", seed) if program == BASE else with_cap(study.config("mcmc", seed), cap)
        return bare_fit(study.scene, study.train, study.test, config, study.device)
    background = study.scene.background
    first = make_trainer(study.train, study.scene.points, study.config("3dgs", seed), study.device, background).gaussians
    settings = gsplat_trainer.Settings(steps=study.steps, cap=cap)
    params, row = gsplat_trainer.fit(study.scene, study.train, first, settings, seed=seed, own_units=program == PEER_OWN)
    return row | scores((gsplat_trainer.image_of(params, view, row["unit"]) for view in study.test), study.test)


def table(rows: list[dict]) -> str:
    """Return mean and standard deviation over seeds as a Markdown table, and the paired difference to preset 3dgs."""
    base, lines = {r["seed"]: r["psnr"] for r in rows if r["program"] == BASE}, []
    for program in PROGRAMS:
        own = [r for r in rows if r["program"] == program]
        if own:
            gains = mean_sd([r["psnr"] - base[r["seed"]] for r in own], sign="+")
            ssim, gaussians, seconds = (statistics.mean(r[k] for r in own) for k in ("ssim", "gaussians", "seconds"))
            lines.append([program, len(own), mean_sd([r["psnr"] for r in own]), gains, f"{ssim:.4f}", f"{gaussians:,.0f}"])
            lines[-1].append(f"{seconds:.1f}")
    return markdown(["program", "seeds", "PSNR [dB]", "to 3dgs, paired [dB]", "SSIM", "Gaussians", "training [s]"], lines)


def main(arguments: list[str] | None = None) -> int:
    """Measure what the file lacks, seed by seed, and print the table; return the exit code."""
    a = parse(
        __doc__, arguments, SCENE, need=("out",), seeds=3, first_seed=0, steps=7000, split="every:8", downscale=1,
        device="cuda", out=Path,
    )  # fmt: skip
    scene = load_scene(a.scene, downscale=a.downscale)
    split = split_views(scene, a.split)
    train, test = ([scene.view(name) for name in names] for names in (split.train, split.test))
    study = Study(scene, train, test, a.steps, choose_device(a.device)[0])
    facts = {"scene": a.scene.resolve().name, "split": a.split, "downscale": a.downscale, "steps": a.steps}
    rows, caps = stored_rows(a.out, **facts), {}
    for seed in range(a.first_seed, a.first_seed + a.seeds):
        for program in PROGRAMS:
            row = next((r for r in rows if (r["program"], r["seed"]) == (program, seed)), None)
            if row is None:
                cap = None if program == BASE else caps[seed]
                figures = measure(study, program, seed, cap)
                row = {"program": program, "seed": seed, "cap": cap} | {k: figures[k] for k in KEPT if k in figures}
                rows.append(row)
                result_file.keep(a.out, WHAT, study.device, rows, **facts)
                print(f"seed {seed}  {program:<24} {row['psnr']:.2f} dB  {row['gaussians']:,} Gaussians", flush=True)
            caps.setdefault(seed, row["gaussians"])
    print(table(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
