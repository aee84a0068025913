"""The two strategies of gsplat on its rasterizer and on ours: held-out PSNR of the same training loop, over seeds.

Our rasterizer is called through the adapter of `examples/09_gsplat_strategy.py`. Start, order of views and random numbers
depend on the seed only, so runs differ only in the rasterizer. gsplat's own sums are not repeatable; compare differences with
the spread over seeds. gsplat, built from its repository, is required. Rows in --out are not measured again.
"""

from __future__ import annotations

import functools
import sys
from dataclasses import replace
from pathlib import Path

import torch

from bench.lib import pool
from bench.lib.arguments import SCENE, parse
from bench.lib.strategy_runs import PEER, Task, measure, table

WHAT = "held-out PSNR of gsplat's strategies on gsplat's rasterizer and on ours, by seed"


def warm_up(task: Task) -> None:
    """Compile all kernels that trainings of a task's scene use, by two steps on each rasterizer."""
    for rasterizer in (task.rasterizer, "exact"):
        measure(replace(task, rasterizer=rasterizer, steps=2))


def main(arguments: list[str] | None = None) -> int:
    """Measure what the file lacks, and print the table; return the exit code."""
    a = parse(
        __doc__, arguments, SCENE, need=("out",), seeds=5, steps=3000, splits=["every:8", "llff:3"], downscale=1,
        strategies=["default", "mcmc"], rasterizers=[PEER, "gsplat-1.6", "exact"], jobs=1, seconds=600.0, device="cuda",
        out=Path,
    )  # fmt: skip
    tasks = [
        Task(str(a.scene), a.downscale, split, strategy, rasterizer, seed, a.steps, a.device)
        for seed in range(a.seeds) for split in a.splits for strategy in a.strategies for rasterizer in a.rasterizers
    ]  # fmt: skip
    first = functools.partial(warm_up, tasks[0])
    rows = pool.measure_all(measure, tasks, first, a, WHAT, torch.device(a.device), lambda row: f"{row['psnr']:.2f} dB")
    print(table([row for row in rows if "error" not in row]))
    return 0


if __name__ == "__main__":
    sys.exit(main())
