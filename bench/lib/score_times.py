"""PSNR against wall time: one fit of a rival on our first points, and the table and chart of all fits."""

from __future__ import annotations

import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from bench.lib import faster_gs_trainer, gsplat_trainer, one_fit
from bench.lib.one_fit import Fit, scores
from bench.lib.plot import Line, Panel, chart
from bench.lib.scenes import scene_at
from bench.lib.tables import markdown
from warpgs.io.load import split_views
from warpgs.scene import Gaussians, Scene, View

WHAT = "PSNR of held-out views against wall time from the start of the shell"
OURS, FASTER_GS, GSPLAT = "warpgs", "Faster-GS", {"gsplat": "default", "gsplat MCMC": "mcmc"}
RIVALS = (*GSPLAT, FASTER_GS)
MARKS = tuple(0.75**k for k in range(14, 0, -1))
"""Parts of the steps after which the longest fit of a rival is scored."""
BELOW = (3.0, 0.0)
"""Distances from a rival's last score [dB] at which times are compared."""
SHOWN = 10.0
"""Least PSNR of the chart below the best of a scene [dB]."""


def loaded(fit: Fit) -> tuple[Scene, list[View], list[View]]:
    """Return the scene of a fit, its training views and its held-out views."""
    scene = scene_at(fit.folder, fit.downscale)
    split = split_views(scene, fit.split)
    return scene, *([scene.view(name) for name in names] for names in (split.train, split.test))


def write_points(fit: Fit, path: Path) -> dict:
    """Write the first points of `default` without extrapolated ones; return the time that it took."""
    scene, train, _ = loaded(fit)
    began = time.monotonic()
    first = one_fit.start_of(fit, scene, train)
    np.savez(path, means=first.means.detach().cpu().numpy(), dc=first.sh.detach()[:, :1].cpu().numpy())
    return {"points": len(first), "points_seconds": time.monotonic() - began}


def rival(fit: Fit, program: str, steps: int, cap: int, points: Path, began: float, marks: tuple[float, ...]) -> dict:
    """Train a rival; return its time since ``began`` (of `time.monotonic`), and its scores at the end and after ``marks``."""
    (scene, train, test), cuda = loaded(fit), torch.device(fit.device).type == "cuda"
    means, dc = (torch.from_numpy(array).to(fit.device) for array in np.load(points).values())
    first = Gaussians(means, *(means.new_zeros(len(means), n) for n in (4, 3)), means.new_zeros(len(means)), dc)
    looks, curve, stopped = {round(part * steps) for part in marks}, [], 0.0

    def now() -> float:
        if cuda:
            torch.cuda.synchronize()
        return time.monotonic() - began - stopped

    def score(image: Callable[[View], np.ndarray]) -> float:
        return scores(map(image, test), test)["psnr"]

    def look(step: int, image: Callable[[View], np.ndarray]) -> None:
        nonlocal stopped
        if step in looks:
            at = now()
            curve.append({"seconds": at, "step": step, "psnr": score(image)})
            stopped += now() - at

    setup = now()
    if program == FASTER_GS:
        count, image = faster_gs_trainer.train(scene, train, first, steps, seed=fit.seed, watch=look)
    else:
        settings, cameras = gsplat_trainer.scaled_settings(GSPLAT[program], steps, cap), [v.camera for v in scene.views]
        unit = gsplat_trainer.own_scale(cameras, scene.normalization)
        size = gsplat_trainer.scene_scale(cameras, unit)

        def drawn(params: dict) -> Callable[[View], np.ndarray]:
            return lambda view: gsplat_trainer.image_of(params, view, unit)

        watch = lambda step, params: look(step, drawn(params))  # noqa: E731
        params = gsplat_trainer.train(train, first, settings, seed=fit.seed, scale=unit, size=size, watch=watch)
        count, image = len(params["means"]), drawn(params)
    row = {"seconds": now(), "setup": setup, "gaussians": count, "psnr": score(image), "curve": curve}
    return row | ({"peak_torch_bytes": torch.cuda.max_memory_allocated()} if cuda else {})


def reached(runs: list[dict], score: float, points: bool = False) -> float:
    """Return the least time at which a run had a score [s], with that of the first points if ``points``; infinite for none."""
    found = ((at, r["points_seconds"] if points else 0.0) for r in runs for at in (r, *r.get("curve", ())))
    return min((at["seconds"] + more for at, more in found if at["psnr"] >= score), default=float("inf"))


def runs_of(rows: list[dict], scene: str, program: str) -> list[dict]:
    """Return the rows of a program on a scene."""
    return [r for r in rows if (r["row"], r["program"]) == (scene, program)]


def table(rows: list[dict], marks: tuple[float, ...] = BELOW) -> str:
    """Return, for each rival and scene, the times at which it and we reach its last score, and some dB less."""
    body = []
    for scene, program in dict.fromkeys((r["row"], r["program"]) for r in rows if r["program"] in RIVALS):
        runs = runs_of(rows, scene, program)
        longest, we = max(runs, key=lambda r: r["steps"]), runs_of(rows, scene, OURS)
        body.append([scene, program, f"{longest['psnr']:.2f}"])
        for target in (longest["psnr"] - below for below in marks):
            times = [reached(runs, target), reached(runs, target, points=True), reached(we, target)]
            body[-1] += [f"{t:.1f}" for t in times]
    head = [
        f"{f'{-below:g} dB: ' if below else ''}{words} [s]" for below in marks for words in ("rival", "with points", "warpgs")
    ]
    return markdown(["scene", "rival", "PSNR [dB]", *head], body, ("scene", "rival"))


def picture(rows: list[dict]) -> str:
    """Return the chart: whole fits, and dashed the way of a rival's longest fit; rivals' times with the first points."""
    panels = []
    for scene in dict.fromkeys(r["row"] for r in rows):
        lines, least = [], max(r["psnr"] for r in rows if r["row"] == scene) - SHOWN
        for color, program in enumerate((OURS, *RIVALS)):
            runs = runs_of(rows, scene, program)
            for label, own in ((program, [[r] for r in runs]), ("", [[*r["curve"], r] for r in runs if r.get("curve")])):
                found = [(at["seconds"] + run[-1].get("points_seconds", 0.0), at["psnr"]) for run in own for at in run]
                if places := tuple(sorted(place for place in found if place[1] >= least)):
                    lines.append(Line(label, places, color, dashed=not label))
        panels.append(Panel(scene, "seconds from the start of the shell", "PSNR [dB]", tuple(lines), linear=True))
    return chart("PSNR against wall time", panels)
