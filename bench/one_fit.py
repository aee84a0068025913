"""One fit of one row, ours or gsplat's, and what is kept of it."""

from __future__ import annotations

import dataclasses
import gc
import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import torch

import warpgs
from bench import gsplat_trainer
from bench.experiments import left_out_view  # noqa: F401 (registers its strategy)
from bench.experiments.leave_one_out import trial_config
from bench.mcmc import scores
from bench.rows import folds, scene_at
from bench.training import compile_kernels, full_bytes, make_trainer
from warpgs.errors import UsageError
from warpgs.io.splits import split_views
from warpgs.pipeline.runs.prune import prune
from warpgs.pipeline.runs.request import SceneRequest
from warpgs.pipeline.train.config import FitConfig, preset_config
from warpgs.scene import Scene, View

PEER, PEER_POINTS = "gsplat", "gsplat-points"
PEERS = (PEER, PEER_POINTS)
"""gsplat's default strategy from the points of our default's start, and from the points of the reconstruction."""
PRUNED = "pruned/"
"""Before a preset: the model is pruned after its fit by `KEEP_PSNR`."""
KEEP_PSNR = 0.1
"""Loss of training PSNR that pruning may cost [dB]."""
PEER_STEPS = 7000


@dataclass(frozen=True)
class Fit:
    """One fit to run."""

    row: str
    """Name of the row."""
    preset: str
    """``default``, a preset, ``PRESET:GROUP.KEY=VALUE,...``, one of `PEERS`, or any of ours after ``pruned/``."""
    seed: int
    folder: str
    split: str
    left_out: str
    """Training views that are scored instead of the held-out ones, with commas; empty for none."""
    downscale: int
    device: str
    peer_steps: int = PEER_STEPS
    """Steps of gsplat."""

    @property
    def key(self) -> dict:
        """What tells one result from another."""
        return {k: getattr(self, k) for k in ("row", "preset", "seed", "left_out", "downscale")}


def config_of(preset: str, device: torch.device) -> FitConfig:
    """Return the settings of one of our presets; ``default`` is that of a user who names none.

    Raises:
        UsageError: A name is unknown, or a value is out of range.
    """
    name, sep, changes = preset.removeprefix(PRUNED).partition(":")
    name = preset_config(None).preset if name == "default" else name
    return trial_config(f"{name}{sep}{changes}")


def compile_all(presets: tuple[str, ...], device: str) -> None:
    """Compile what fits of these presets use, gsplat's own kernels too."""
    for preset in presets:
        if preset in PEERS:
            gsplat_trainer.compile_kernels(torch.device(device))
        else:
            compile_kernels(config_of(preset, torch.device(device)), torch.device(device))


def plan(
    row: str, preset: str, seed: int, folder: str, place: tuple[str, int], count: int, device: str, peer_steps: int = PEER_STEPS
) -> list[Fit]:  # fmt: skip
    """Return the fits of a row, a preset and a seed: one, or one for each set of training views that is left out.

    Args:
        row: Name of the row.
        preset: As in `Fit`.
        seed: Seed of the fit.
        folder: Folder of the scene.
        place: Split and downscale.
        count: Training views to leave out, 0 for none.
        device: cpu or cuda.
        peer_steps: Steps of gsplat.
    """
    split, downscale = place
    cut = folds(scene_at(folder, downscale), split, count)
    return [Fit(row, preset, seed, folder, part, names, downscale, device, peer_steps) for part, names in cut]


def measure(fit: Fit) -> dict:
    """Fit, score, and return what is kept: scores, sizes, times, steps, and why the fit ended."""
    scene = scene_at(fit.folder, fit.downscale)
    try:
        if fit.preset in PEERS:
            return peer_figures(fit, scene)
        config = dataclasses.replace(config_of(fit.preset, torch.device(fit.device)), seed=fit.seed)
        return pruned_figures(fit, config) if fit.preset.startswith(PRUNED) else our_figures(fit, scene, config)
    finally:
        gc.collect()  # a fit and its recorded steps refer to each other: without this their device memory piles up


def our_figures(fit: Fit, scene: Scene, config: FitConfig) -> dict:
    """Return the figures of one of our fits, as its metrics have them."""
    m = warpgs.fit(scene, config, split=fit.split, device=fit.device, verbose=False).metrics
    return figures_of(m) | {"threads": torch.get_num_threads()}


def figures_of(m: dict) -> dict:
    """Return what is kept of a fit's metrics; ``ended`` and ``shape`` where they tell it."""
    row = {"psnr": m["test"]["psnr"], "ssim": m["test"]["ssim"], "region": m["views"][0]["region"]}
    row |= {"gaussians": m["gaussians"], "bytes": m["complexity"]["bytes"], "steps": m["steps"], "resolved": m["preset"]}
    row |= {k: m["seconds"][k] for k in ("setup", "training")}
    row |= {"ended": m.get("ended"), "why": m["complexity"]["why"], "config_hash": m["config_hash"]}
    return row | {k: m[k] for k in ("shape", "peak_torch_bytes") if k in m}


def pruned_figures(fit: Fit, config: FitConfig) -> dict:
    """Return the figures of one of our fits after its model was pruned; SSIM is not measured."""
    with tempfile.TemporaryDirectory() as place:
        run, out = Path(place, "run"), Path(place, "pruned")
        request = SceneRequest(fit.folder, fit.split, fit.downscale)
        row = figures_of(warpgs.fit(request, config, out=run, device=fit.device, verbose=False).metrics)
        prune(run, KEEP_PSNR, out, fit.device)
        told = json.loads((out / "config.json").read_text("utf-8"))["pruned"]
    return row | {"psnr": told["test_psnr"][1], "ssim": None, "bytes": told["bytes"][1], "gaussians": told["count"][1]}


def peer_figures(fit: Fit, scene: Scene) -> dict:
    """Train gsplat with its default strategy on the same views, in the units of its own parser, and score it as ours.

    Raises:
        UsageError: The scene is not over black, which is all that gsplat's trainer knows.
    """
    if any(scene.background):
        raise UsageError(f"{scene.path}: its background is {scene.background}; gsplat's trainer knows black alone")
    device, split = torch.device(fit.device), split_views(scene, fit.split)
    train, test = ([scene.view(name) for name in names] for names in (split.train, split.test))
    began = time.perf_counter()
    first = start_of(fit, scene, train)
    cameras = [view.camera for view in scene.views]
    unit = gsplat_trainer.own_scale(cameras, scene.normalization)
    size = gsplat_trainer.scene_scale(cameras, unit)
    settings = gsplat_trainer.default_settings(fit.peer_steps)
    setup = time.perf_counter() - began
    params = gsplat_trainer.train(train, first, settings, seed=fit.seed, scale=unit, size=size)
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    training, count = time.perf_counter() - began - setup, len(params["means"])
    images = (gsplat_trainer.image_of(params, view, unit).clip(0, 1) for view in test)
    scored = {k: v for k, v in scores(images, test).items() if k != "views"}
    return scored | {
        "points": len(first), "gaussians": count, "bytes": full_bytes(count), "steps": fit.peer_steps, "setup": setup,
        "training": training, "ended": "steps", "unit": unit, "scene_scale": size,
    }  # fmt: skip


def start_of(fit: Fit, scene: Scene, train: list[View]) -> warpgs.Gaussians:
    """Return the first Gaussians of our default with this seed, or those on the reconstruction's points."""
    config = dataclasses.replace(config_of("default", torch.device(fit.device)), seed=fit.seed)
    if fit.preset == PEER_POINTS:
        config = dataclasses.replace(config_of("3dgs", torch.device(fit.device)), seed=fit.seed)
        config = dataclasses.replace(config, init=dataclasses.replace(config.init, source="points"))
    return make_trainer(train, scene.points, config, torch.device(fit.device), scene.background).gaussians
