"""Time of a training step with Gaussians in their original order and along a Morton curve, in turn."""

from __future__ import annotations

import statistics
import time
from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import SCENE, parse
from bench.lib.training import Trainer, make_trainer, sort_along_curve, take_steps, without_density
from warpgs import load_scene
from warpgs.io.load import split_views
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.request import choose_device
from warpgs.pipeline.train.settings import FitConfig

REPEATS = 15
STEPS_PER_BATCH = 100
"""Number of steps of a repeat on CUDA, where steps are captured; on a CPU a repeat is one step."""


def step_ms(trainer: Trainer) -> float:
    """Return the time of a step: wall time on CUDA, CPU time elsewhere, which other programs disturb less."""
    clock, steps = (time.perf_counter, STEPS_PER_BATCH) if trainer.device.type == "cuda" else (time.process_time, 1)
    began = clock()
    done = take_steps(trainer, steps)
    return 1e3 * (clock() - began) / done


def main() -> None:
    """Parse, measure, print, and write JSON where asked."""
    a = parse(__doc__, None, SCENE, split="llff:3", gaussians=[20_000, 300_000], device="auto", threads=1, out=Path)
    torch.set_num_threads(a.threads)
    device, where = choose_device(a.device)
    scene = load_scene(a.scene)
    views = [scene.view(name) for name in split_views(scene, a.split).train]
    rows = []
    for count in a.gaussians:
        init = InitConfig(source="random", random_count=count)
        config = without_density(FitConfig(steps=10**6, init=init))
        fits = {name: make_trainer(views, None, config, device) for name in ("as they came", "morton")}
        sort_along_curve(fits["morton"])
        for fit in fits.values():
            step_ms(fit), step_ms(fit)
        times = {name: [] for name in fits}
        for _ in range(REPEATS):
            for name, fit in fits.items():
                times[name].append(step_ms(fit))
        row = {"gaussians": count} | {f"{n} [ms]": round(statistics.median(t), 3) for n, t in times.items()}
        rows.append(row)
        print(where, row, flush=True)
    facts = {"scene": Path(a.scene).name, "split": a.split, "threads": a.threads, "repeats": REPEATS}
    what = "time of a training step with Gaussians as they came and along a Morton curve"
    result_file.keep(a.out, what, device, rows, **facts)


if __name__ == "__main__":
    main()
