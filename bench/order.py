"""Time of a training step with Gaussians in the order in which they came, and along a Morton curve, in turns.

usage: python -m bench.order SCENE [--split llff:3] [--gaussians 20000 300000] [--device auto] [--threads 1] [--out FILE.json]
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from pathlib import Path

import torch

from bench.machine import describe
from warpgs import load_scene
from warpgs.io.splits import split_views
from warpgs.pipeline.model.init import InitConfig
from warpgs.pipeline.runs.folder import choose_device
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer, train_views

REPEATS = 15
STEPS_PER_BATCH = 100
"""Steps of a repeat on CUDA, where they are recorded; on a CPU a repeat is one step."""


def step_ms(fit: Trainer) -> float:
    """Time of a step: wall time on CUDA, CPU time elsewhere, which other programs disturb less."""
    clock, steps = (time.perf_counter, STEPS_PER_BATCH) if fit.device.type == "cuda" else (time.process_time, 1)
    began, done = clock(), 0
    while done < steps:
        done += len(fit.buffers(steps - done))
    return 1e3 * (clock() - began) / done


def main() -> None:
    """Parse, measure, print, and write JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene")
    parser.add_argument("--split", default="llff:3")
    parser.add_argument("--gaussians", type=int, nargs="+", default=[20_000, 300_000])
    parser.add_argument("--device", default="auto")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    torch.set_num_threads(a.threads)
    device, where = choose_device(a.device)
    scene = load_scene(a.scene)
    views = train_views(scene, split_views(scene, a.split).train)
    rows = []
    for count in a.gaussians:
        init = InitConfig(source="random", random_count=count)
        config = FitConfig(steps=10**6, init=init, density=DensityConfig(start=10**6))
        fits = {"as they came": Trainer(views, None, config, device), "morton": Trainer(views, None, config, device)}
        fits["morton"].optimizer.sort_along_curve()
        for fit in fits.values():
            step_ms(fit), step_ms(fit)
        times = {name: [] for name in fits}
        for _ in range(REPEATS):
            for name, fit in fits.items():
                times[name].append(step_ms(fit))
        row = {"gaussians": count} | {f"{n} [ms]": round(statistics.median(t), 3) for n, t in times.items()}
        rows.append(row)
        print(where, row, flush=True)
    if a.out:
        record = {"scene": Path(a.scene).name, "split": a.split, "threads": a.threads, "repeats": REPEATS, "rows": rows}
        a.out.write_text(json.dumps({"machine": describe(device), **record}, indent=1) + "\n")


if __name__ == "__main__":
    main()
