"""One training loop around gsplat's strategies, on gsplat's rasterizer or on ours behind the adapter of the example."""

from __future__ import annotations

import functools
import runpy
import statistics
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch

from bench.lib import gsplat_trainer
from bench.lib.one_fit import config_of, scores
from bench.lib.scenes import scene_at
from bench.lib.tables import markdown, mean_sd
from bench.lib.training import make_trainer
from warpgs.io.load import split_views
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Camera

PEER = "gsplat"
ADAPTER = Path(__file__).parents[2] / "examples" / "09_gsplat_strategy.py"
CAP = 1_000_000
"""Largest number of Gaussians of MCMC; a short training does not reach it."""


@dataclass(frozen=True)
class Task:
    """One training."""

    folder: str
    downscale: int
    split: str
    strategy: str
    """default or mcmc."""
    rasterizer: str
    """`PEER`, or a rule of ours."""
    seed: int
    steps: int
    device: str

    @property
    def key(self) -> dict:
        """Values that tell one result from another."""
        names = ("split", "strategy", "rasterizer", "seed", "steps", "downscale")
        return {"scene": Path(self.folder).name} | {k: getattr(self, k) for k in names}


@functools.cache
def drawn_by(rasterizer: str) -> Callable:
    """Return gsplat's rasterizer or, by the name of a rule, ours behind the adapter, as `gsplat_trainer.train` calls it."""
    if rasterizer == PEER:
        return gsplat_trainer.render
    adapter = runpy.run_path(str(ADAPTER))["render"]

    def draw(params, viewmat, K, width, height, degree, background):
        options = RasterizeOptions(rule=rasterizer, sh_degree=degree, background=viewmat.new_tensor(background))
        render, info = adapter(params, Camera(viewmat, K, width, height), options)
        return render.rgb, info

    return draw


def settings_of(strategy: str, steps: int) -> gsplat_trainer.Settings:
    """Return the settings of gsplat's example trainer for a strategy."""
    return gsplat_trainer.default_settings(steps) if strategy == "default" else gsplat_trainer.Settings(steps, CAP)


def measure(task: Task) -> dict:
    """Train from the points of the scene and score the held-out views, each rendered by the rasterizer that trained."""
    scene, draw = scene_at(task.folder, task.downscale), drawn_by(task.rasterizer)
    split = split_views(scene, task.split)
    train, test = ([scene.view(name) for name in names] for names in (split.train, split.test))
    device = torch.device(task.device)
    first = make_trainer(train, scene.points, config_of("3dgs:init.source=points"), device, scene.background).gaussians
    settings = settings_of(task.strategy, task.steps)
    params, row = gsplat_trainer.fit(scene, train, first, settings, seed=task.seed, draw=draw)
    images = (gsplat_trainer.image_of(params, view, row["unit"], draw) for view in test)
    found = scores(images, test)
    return {k: found[k] for k in ("psnr", "ssim")} | {k: row[k] for k in ("points", "gaussians", "seconds")}


def table(rows: list[dict]) -> str:
    """Return mean and standard deviation over seeds as a Markdown table, and the paired difference to gsplat's rasterizer."""
    lines = []
    for split, strategy in sorted({(r["split"], r["strategy"]) for r in rows}):
        own = [r for r in rows if (r["split"], r["strategy"]) == (split, strategy)]
        base = {r["seed"]: r["psnr"] for r in own if r["rasterizer"] == PEER}
        for rasterizer in sorted({r["rasterizer"] for r in own}, key=lambda name: (name != PEER, name)):
            found = [r for r in own if r["rasterizer"] == rasterizer]
            gains = [r["psnr"] - base[r["seed"]] for r in found if r["seed"] in base]
            ssim, gaussians = (statistics.mean(r[k] for r in found) for k in ("ssim", "gaussians"))
            psnr = mean_sd([r["psnr"] for r in found])
            gain = "" if rasterizer == PEER or not gains else mean_sd(gains, sign="+")
            lines.append([split, strategy, rasterizer, len(found), psnr, gain, f"{ssim:.4f}", f"{gaussians:,.0f}"])
    head = ["split", "strategy", "rasterizer", "seeds", "PSNR [dB]", "difference to gsplat's [dB]", "SSIM", "Gaussians"]
    return markdown(head, lines)
