"""Steps of several views on several GPUs: their time, the time in collectives, memory, and the SHA-256 of the model.

CASE is horns or garden. horns: PATH is a scene folder, split every:8, fitted from 112,000 random points; the set of Gaussians
changes in the first half of the steps. garden: PATH is test_garden.npz; 2.8 million Gaussians on its points, 1920 x 1080 px, 8
views, no growth. Start it with `torchrun --nproc-per-node N -m bench.fits.ranks`. Steps are taken in series of 10 (a fit takes
more at once); the time of a step is the median over the series of the last half. A row replaces the row in --out with the same
case, batch, steps and ranks. `same_model` is true if all rows of a case have the same SHA-256 of parameters, moments and
statistics; ``start_sha256`` is that of the start and of the photographs. Time in collectives is measured on the first rank by
events around them, and includes the wait for slower ranks.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from pathlib import Path

import numpy as np
import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.inputs import garden_inputs
from bench.lib.same_bits import digest
from bench.lib.training import Trainer, make_trainer, set_gaussians, state_tensors
from warpgs import load_scene
from warpgs.io.load import split_views
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.request import choose_device
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import train_views
from warpgs.ranks import Ranks, join
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, PointCloud, View

SERIES = 10
"""Steps between two time measurements."""
WHAT = "steps of several views on several GPUs: time, time in collectives, memory, and the SHA-256 of the model"
POINTS = 112_000
"""Number of random initial points for horns, about the number of Gaussians of a normal fit."""


def horns(folder: str, batch: int, steps: int, device: torch.device, ranks: Ranks) -> Trainer:
    """Return a trainer of a scene folder, whose set of Gaussians changes three times."""
    scene = load_scene(folder)
    config = dataclasses.replace(
        PRESETS["3dgs"], steps=steps, batch=batch, init=InitConfig(source="random", random_count=POINTS), sh_every=1,
        density=DensityConfig(start=1, every=max(1, steps // 6), stop_fraction=0.5, gradient=1e-4, reset_every=10**9),
    )  # fmt: skip
    train = train_views(scene, split_views(scene, "every:8").train)
    return make_trainer(train, None, config, device, scene.background, ranks)


def garden(
    path: str, batch: int, steps: int, device: torch.device, ranks: Ranks, *, tiles=5, width=1920, height=1080
) -> Trainer:
    """Return a trainer of Gaussians on photographed points; targets are renders of these with other colours."""
    gaussians, cameras = garden_inputs(path, tiles=tiles, width=width, height=height, device=device)
    other = dataclasses.replace(gaussians, sh=gaussians.sh.detach().flip(0))
    views = []
    for i in range(8):
        k = i % len(cameras.viewmat)
        viewmat = cameras.viewmat[k].clone()
        viewmat[0, 3] += 0.05 * (i // len(cameras.viewmat))
        camera = Camera(viewmat, cameras.K[k], width, height)
        with torch.no_grad():
            image = rasterize(other, camera, RasterizeOptions()).rgb.clamp(0, 1).cpu().numpy()
        arrays = (t.cpu().numpy().astype(np.float64) for t in (viewmat, camera.K))
        views.append(View(f"{i}", Camera(*arrays, width, height), image))
    config = dataclasses.replace(
        PRESETS["3dgs"], steps=steps, batch=batch, max_gaussians=10**8, sh_every=1, density=DensityConfig(start=10**9),
        init=InitConfig(source="points"),
    )  # fmt: skip
    means = gaussians.means.detach()[:1000].cpu().numpy().astype(np.float64)
    trainer = make_trainer(views, PointCloud(means, np.full((len(means), 3), 0.5, np.float32)), config, device, ranks=ranks)
    set_gaussians(trainer, gaussians)
    return trainer


class Clock:
    """Time between points of the device's work [ms], read once it is done."""

    def __init__(self, device: torch.device):
        self.device, self.marks = device, []

    def mark(self) -> None:
        """Mark this point."""
        if self.device.type != "cuda":
            self.marks.append(time.perf_counter())
            return
        event = torch.cuda.Event(enable_timing=True)
        event.record()
        self.marks.append(event)

    def total(self) -> float:
        """Return the time between pairs of marks, summed [ms], and begin anew."""
        pairs, self.marks = list(zip(self.marks[::2], self.marks[1::2])), []
        if self.device.type == "cuda":
            return sum(a.elapsed_time(b) for a, b in pairs)
        return 1000 * sum(b - a for a, b in pairs)


def clocked(ranks: Ranks, clock: Clock) -> None:
    """Have a clock time every exchange."""
    for name in ("to_each", "gather"):
        honest = getattr(ranks, name)

        def timed(*arguments, honest=honest):
            clock.mark()
            found = honest(*arguments)
            clock.mark()
            return found

        setattr(ranks, name, timed)


def measured(trainer: Trainer, ranks: Ranks, steps: int) -> dict:
    """Take the steps; return the figures of a row."""
    device, clock, times, exchanges = trainer.device, Clock(trainer.device), [], []
    if ranks.count > 1:
        clocked(ranks, clock)
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
    while trainer.step < steps:
        began, before = time.perf_counter(), trainer.step
        while trainer.step < min(before + SERIES, steps):
            trainer.advance(min(before + SERIES, steps) - trainer.step)
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        taken = trainer.step - before
        spent, exchanged = 1000 * (time.perf_counter() - began) / taken, clock.total() / taken
        if before >= steps // 2 or trainer.step == steps:
            times.append(spent)
            exchanges.append(exchanged)
    row = {"gaussians": len(trainer.table), "step_ms": round(statistics.median(times), 3), "timed_series": len(times)}
    row |= {"least_step_ms": round(min(times), 3), "collectives_ms": round(statistics.median(exchanges), 3)}
    if device.type == "cuda":
        row["peak_torch_bytes"] = torch.cuda.max_memory_allocated(device)
    return row | {"sha256": digest(*state_tensors(trainer))}


def keep(path: Path | None, device: torch.device, row: dict) -> list[dict]:
    """Put a row into a result, and return all rows with values computed from several rows."""
    rows = result_file.read(path)["rows"] if path is not None and path.is_file() else []
    key = ("case", "batch", "ranks", "steps")
    rows = [r for r in rows if [r[k] for k in key] != [row[k] for k in key]] + [row]
    rows.sort(key=lambda r: [r[k] for k in key])
    for r in rows:
        same = [o for o in rows if all(o[k] == r[k] for k in ("case", "batch", "steps"))]
        one = next((o["step_ms"] for o in same if o["ranks"] == 1), None)
        r["efficiency"] = None if one is None else round(one / r["step_ms"] / r["ranks"], 3)
        r["same_model"] = len({o["sha256"] for o in same}) == 1
    if path is not None:
        result_file.keep(path, WHAT, device, rows)
    return rows


def main(arguments: list[str] | None = None) -> int:
    """Measure one case on all ranks; return 1 if the rows of a case have different models."""
    a = parse(
        __doc__, arguments, {"case": ("horns", "garden"), "path": str}, batch=8, steps=120, tiles=5, width=1920, height=1080,
        device="auto", out=Path,
    )  # fmt: skip
    ranks = join(a.device)
    device, size = choose_device(a.device)[0], {"tiles": a.tiles, "width": a.width, "height": a.height}
    made = {"horns": horns, "garden": lambda *of: garden(*of, **size)}[a.case](a.path, a.batch, a.steps, device, ranks)
    row = {"case": a.case, "batch": a.batch, "ranks": ranks.count, "backend": ranks.backend, "steps": a.steps}
    row["start_sha256"] = digest(*state_tensors(made), *(image for stack in made.stacks.values() for image in stack.images))
    row |= measured(made, ranks, a.steps)
    ranks.part()
    good = True
    if ranks.first:
        rows = keep(a.out, device, row)
        good = all(r["same_model"] for r in rows)
        print(next(r for r in rows if all(r[k] == v for k, v in row.items())), flush=True)
    ranks.leave()
    return int(not good)


if __name__ == "__main__":
    raise SystemExit(main())
