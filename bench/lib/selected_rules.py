"""Results of `select_rule` on frozen scenes: the rule, its time beside `exact`, and its true error."""

from __future__ import annotations

import statistics
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import torch

from bench.lib import frozen
from bench.lib.inputs import camera as bench_camera
from bench.lib.timing import measure_in_turn
from warpgs.errors import UsageError
from warpgs.pipeline.run.folder import open_run
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import FASTEST_FIRST, rasterize, select_rule
from warpgs.render.reference import reference_image
from warpgs.scene import Camera, Gaussians

LIMITS = (1e-2, 1e-3, 1e-4)
MEASURES = ("mean", "max")
CPU = torch.device("cpu")
HAZE = (1.1, 1.9, 2.1, 3.9, 4.1)
"""Alphas of the layers of haze in 255ths: just above the cut of `exact`, and on both sides of the cuts of the faster rules."""
BACKGROUND = torch.tensor([0.2, 0.5, 0.8])
REFUSED = "none"
"""Text for a limit that no rule keeps."""


@dataclass(frozen=True)
class Measured:
    """A scene with the views in which a limit must hold."""

    kind: str
    gaussians: Gaussians
    cameras: list[Camera]


def measured_scenes(width: int, count: int, seeds: int, run: Path | None) -> Iterator[Measured]:
    """Yield haze, needles and far scenes by seed, each seen by one camera, and the model of a run seen by its cameras."""
    height = 3 * width // 4
    flat = bench_camera(width, height, CPU)
    one = Camera(flat.viewmat[0].double().numpy(), flat.K[0].double().numpy(), width, height)
    for alpha in HAZE:
        yield Measured("haze", _float32(frozen.fog(1000, 0, alpha / 255)), [one])
    for seed in range(seeds):
        for make in frozen.scenes(CPU, width, height, count, None, seed):
            made = make()
            if made.name in ("needles", "far"):
                yield Measured(made.name, made.gaussians, [made.camera])
    if run is not None:
        stored = open_run(run, CPU)
        yield Measured("trained", _float32(stored.gaussians()), list(stored.cameras().values()))


def _float32(gaussians: Gaussians) -> Gaussians:
    return Gaussians(**{n: t.detach().float().contiguous() for n, t in gaussians.tensors().items()})


def true_errors(scene: Measured, rule: str, truths: list[torch.Tensor]) -> torch.Tensor:
    """Return errors [V, H, W] of the views under a rule against reference images, of each pixel the largest channel's."""
    options, found = RasterizeOptions(rule=rule, background=BACKGROUND), []
    for camera, truth in zip(scene.cameras, truths, strict=True):
        found.append((rasterize(scene.gaussians, camera, options).rgb.double() - truth).abs().amax(-1))
    return torch.stack(found)


def times(scene: Measured, repeats: int) -> dict[str, float]:
    """Return the least time of an image without gradients under each rule [ms], run in turn."""

    def work(rule: str):
        options = RasterizeOptions(rule=rule, background=BACKGROUND)
        return lambda: rasterize(scene.gaussians, scene.cameras[0], options)

    rows = measure_in_turn([work(rule) for rule in FASTEST_FIRST], CPU, repeats)
    return {rule: row["least_ms"] for rule, row in zip(FASTEST_FIRST, rows, strict=True)}


@torch.no_grad()
def measure(scene: Measured, repeats: int) -> list[dict]:
    """Return a row for each limit and measure: the rule, its time over that of `exact`, and its true error."""
    degree, options = scene.gaussians.sh_degree, RasterizeOptions(background=BACKGROUND)
    size = (0, 0, scene.cameras[0].width, scene.cameras[0].height)
    truths = [reference_image(scene.gaussians, camera, size, BACKGROUND, degree) for camera in scene.cameras]
    errors, took, rows = {rule: true_errors(scene, rule, truths) for rule in FASTEST_FIRST}, times(scene, repeats), []
    for name in MEASURES:
        for limit in LIMITS:
            began = time.perf_counter()
            try:
                rule, bound = select_rule(scene.gaussians, scene.cameras, max_error=limit, measure=name, options=options)
            except UsageError:
                rule, bound = REFUSED, None
            seconds = time.perf_counter() - began
            error = errors["exact" if rule == REFUSED else rule]
            by_view = error.mean((1, 2)) if name == "mean" else error.amax((1, 2))
            row = {"kind": scene.kind, "measure": name, "limit": limit, "rule": rule, "bound": bound}
            row |= {"time": took[rule] / took["exact"] if rule != REFUSED else None, "choice_s": seconds}
            row |= {"error": float(by_view.max()), "pixel_median": float(error.median()), "pixel_max": float(error.max())}
            rows.append(row)
    return rows


def summary(rows: list[dict]) -> list[dict]:
    """Return a row for each kind of scene, measure and limit: frequency of each rule, time, and true error over the scenes."""
    found = []
    for kind, name, limit in dict.fromkeys((r["kind"], r["measure"], r["limit"]) for r in rows):
        own = [r for r in rows if (r["kind"], r["measure"], r["limit"]) == (kind, name, limit)]
        kept = [r for r in own if r["rule"] != REFUSED]
        rules = {rule: n for rule in (*FASTEST_FIRST, REFUSED) if (n := sum(r["rule"] == rule for r in own))}
        row = {"kind": kind, "measure": name, "limit": limit, "rules": rules}
        if kept:
            errors = [r["error"] for r in kept]
            row |= {"time": statistics.median(r["time"] for r in kept)}
            row |= {"typical": statistics.median(errors), "worst": max(errors), "pixel": max(r["pixel_max"] for r in kept)}
        found.append(row)
    return found
