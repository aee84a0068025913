"""Fits and their stored figures: ours, through the public function or without files, and gsplat's."""

from __future__ import annotations

import dataclasses
import gc
import json
import os
import re
import statistics
import tempfile
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

import warpgs
from bench.lib import gsplat_trainer
from bench.lib.scenes import folds, scene_at
from bench.lib.training import full_bytes, make_trainer
from warpgs.errors import UsageError
from warpgs.io.load import split_views
from warpgs.pipeline.metrics.scores import score
from warpgs.pipeline.paper.strategy import UNIFORM
from warpgs.pipeline.run.commands import prune
from warpgs.pipeline.run.precompile import precompile_kernels
from warpgs.pipeline.run.request import SceneRequest
from warpgs.pipeline.train.presets import PRESETS, preset_settings
from warpgs.pipeline.train.schedule import mean_color
from warpgs.pipeline.train.settings import DEGREES, FitConfig
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.plugins import flag_group
from warpgs.scene import Scene, View

PEER, PEER_POINTS = "gsplat", "gsplat-points"
PEERS = (PEER, PEER_POINTS)
"""gsplat's default strategy with the initial points of our default, and with the points of the reconstruction."""
PRUNED = "pruned/"
"""Prefix of a preset: the model is pruned by `KEEP_PSNR` after its fit."""
KEEP_PSNR = 0.1
"""Loss of training PSNR that pruning may cost [dB]."""
PEER_STEPS = 7000
"""Default number of steps of gsplat."""


def is_peer(preset: str) -> bool:
    """Return whether a preset is gsplat's trainer."""
    return preset.partition(":")[0] in PEERS


@dataclass(frozen=True)
class Fit:
    """One fit to run."""

    row: str
    """Name of the row."""
    preset: str
    """``default``, a preset, ``PRESET:GROUP.KEY=VALUE,...``, or any of ours after ``pruned/``; or one of `PEERS`, whose
    settings are those of `gsplat_trainer.Settings`."""
    seed: int
    folder: str
    split: str
    left_out: str
    """Training views that are scored instead of the held-out ones, with commas; empty for none."""
    downscale: int
    device: str

    @property
    def key(self) -> dict:
        """Values that tell one result from another."""
        return {k: getattr(self, k) for k in ("row", "preset", "seed", "left_out", "downscale")}


def config_of(preset: str, seed: int = 0) -> FitConfig:
    """Return the settings of one of our presets with a seed; ``default`` is the preset of a user who gives none.

    ``PRESET:a.b=value,c=value`` changes the named settings; values are JSON, or text without quotes. A strategy may be
    ``FILE.py:CLASS``; its own settings come after it, by the names of their flags, as in ``lottery.growth=0.2``. The preset
    may be ``FILE.py:NAME``.
    """
    file, name, changes = re.fullmatch(r"(.+?\.py:(?=\w+(?::|$)))?([^:]*):?(.*)", preset.removeprefix(PRUNED)).groups()
    if not file and name not in PRESETS:
        raise UsageError(f"preset {name!r} is not one of {', '.join(PRESETS)}")
    values = preset_settings(f"{file or ''}{name}")[0].to_json() | {"seed": seed}
    _change(values, preset, _present(changes))
    return FitConfig.from_json(values)


def _present(changes: str) -> str:
    """Return changes by the present names of settings; stored rows of `default` have some of version 0.2.0."""
    parts = changes.replace("method.events=false", "strategy=clone_split").split(",")
    renamed = [re.sub(r"^method\.(s_\w+|ra|agp|pm)=", r"paper.\1=", part) for part in parts]
    if renamed == parts:
        return ",".join(parts)
    uniform = [f"paper.{n}={json.dumps(v)}" for n, v in dataclasses.asdict(UNIFORM).items()]
    return ",".join(["strategy=paper", *uniform, *renamed])


def peer_settings(preset: str, train: list[View]) -> gsplat_trainer.Settings:
    """Return the settings of gsplat's trainer: ``gsplat:steps=1000,sh_degree=auto,background=mean``; auto as in `default`."""
    changes = preset.partition(":")[2]
    given: dict = {f.name: None for f in dataclasses.fields(gsplat_trainer.Settings)}
    _change(given, preset, changes)
    given = {n: v for n, v in given.items() if v is not None}
    if given.get("sh_degree") == "auto":
        given["sh_degree"] = sum(len(train) >= n for n in DEGREES)
    if given.get("background") == "mean":
        given["background"] = mean_color(train)
    settings = gsplat_trainer.default_settings(given.get("steps", PEER_STEPS))
    return dataclasses.replace(settings, **given)


def _change(values: dict, preset: str, changes: str) -> None:
    """Change nested values as a preset says after its colon; settings of a strategy stand in the group of its flags."""
    for change in filter(None, changes.split(",")):
        key, sep, value = change.partition("=")
        *groups, last = key.replace("-", "_").split(".")
        place = values
        for group in groups:
            if place is values and values.get("strategy_config") is not None and group == flag_group(values["strategy"]):
                group = "strategy_config"
            place = place.get(group) if isinstance(place, dict) else None
        if not sep or not isinstance(place, dict) or last not in place:
            raise UsageError(f"{preset!r}: {change!r} sets nothing; write GROUP.NAME=VALUE as in optimizer.scales_lr=0.1")
        try:
            place[last] = json.loads(value)
        except json.JSONDecodeError:
            place[last] = os.path.expandvars(value)  # a path of this machine: $NAME
        if key == "strategy":
            kind = STRATEGIES.load(value).Config
            values["strategy_config"] = None if kind is None else dataclasses.asdict(kind())


def compile_all(presets: tuple[str, ...], device: str) -> None:
    """Compile the kernels of fits on a device, and those of gsplat if one of the presets is gsplat's."""
    for _ in precompile_kernels([torch.device(device)]):
        pass
    if any(map(is_peer, presets)):
        gsplat_trainer.compile_kernels(torch.device(device))


def plan(row: str, preset: str, seed: int, folder: str, place: tuple[str, int], count: int, device: str) -> list[Fit]:
    """Return the fits of a row, a preset and a seed: one, or one for each set of training views that is left out."""
    split, downscale = place
    cut = folds(scene_at(folder, downscale), split, count)
    return [Fit(row, preset, seed, folder, part, names, downscale, device) for part, names in cut]


def measure(fit: Fit) -> dict:
    """Fit, score, and return the figures to store: scores, sizes, times, steps, and why the fit ended."""
    scene = scene_at(fit.folder, fit.downscale)
    try:
        if is_peer(fit.preset):
            return peer_figures(fit, scene)
        config = config_of(fit.preset, fit.seed)
        if fit.preset.startswith(PRUNED):
            return pruned_figures(fit, config)
        fitted = warpgs.fit(scene, config, split=fit.split, device=fit.device, verbose=False)
        return figures_of(fitted.metrics) | {"threads": torch.get_num_threads()}
    finally:
        gc.collect()  # a fit and its recorded steps refer to each other: without this their device memory piles up


def figures_of(m: dict) -> dict:
    """Return the figures to store of a fit's metrics; ``ended`` and ``shape`` if the metrics have them."""
    row = {"psnr": m["test"]["psnr"], "ssim": m["test"]["ssim"], "region": m["views"][0]["region"]}
    row |= {"gaussians": m["gaussians"], "bytes": m["complexity"]["bytes"], "steps": m["steps"], "resolved": m["preset"]}
    row |= {k: m["seconds"][k] for k in ("setup", "training")}
    row |= {"ended": m.get("ended"), "why": m["complexity"]["why"], "config_hash": m["config_hash"]}
    return row | {k: m[k] for k in ("shape", "peak_torch_bytes") if k in m}


def pruned_figures(fit: Fit, config: FitConfig) -> dict:
    """Return the figures of one of our fits after its model was pruned; SSIM is not measured."""
    with tempfile.TemporaryDirectory() as place:
        run, out = Path(place, "run"), Path(place, "pruned")
        request = SceneRequest(fit.folder, fit.split, downscale=fit.downscale)
        row = figures_of(warpgs.fit(request, config, out=run, device=fit.device, verbose=False).metrics)
        prune(run, KEEP_PSNR, out, fit.device)
        told = json.loads((out / "config.json").read_text("utf-8"))["pruned"]
    return row | {"psnr": told["test_psnr"][1], "ssim": None, "bytes": told["bytes"][1], "gaussians": told["count"][1]}


def peer_figures(fit: Fit, scene: Scene) -> dict:
    """Train gsplat with its default strategy on the same views, in the units of its own parser, and score it like our fits."""
    split, began = split_views(scene, fit.split), time.perf_counter()
    train, test = ([scene.view(name) for name in names] for names in (split.train, split.test))
    first = start_of(fit, scene, train)
    setup = time.perf_counter() - began
    settings = peer_settings(fit.preset, train)
    params, row = gsplat_trainer.fit(scene, train, first, settings, seed=fit.seed)
    row |= {"setup": setup, "training": row.pop("seconds"), "bytes": full_bytes(row["gaussians"])}
    scored = scores((gsplat_trainer.image_of(params, view, row["unit"], background=settings.background) for view in test), test)
    return {k: v for k, v in scored.items() if k != "views"} | row | {"steps": settings.steps, "ended": "steps"}


def start_of(fit: Fit, scene: Scene, train: list[View]) -> warpgs.Gaussians:
    """Return initial Gaussians: those of our default with this seed, not extrapolated, or on the reconstruction's points."""
    first = "3dgs:init.source=points" if fit.preset.startswith(PEER_POINTS) else "default:init.extrapolate=false"
    config = config_of(first, fit.seed)
    return make_trainer(train, scene.points, config, torch.device(fit.device), scene.background).gaussians


def scores(images: Iterable[np.ndarray], views: list[View]) -> dict:
    """Return mean PSNR [dB] and SSIM of images against their views, and the PSNR of each."""
    rows = [score(view, image) for view, image in zip(views, images, strict=True)]
    by_view = {row.name: row.psnr for row in rows}
    return {"psnr": statistics.mean(by_view.values()), "ssim": statistics.mean(r.ssim for r in rows), "views": by_view}
