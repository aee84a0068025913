"""A training step on a CPU from two checkouts in turn, on a seeded cloud: wall time and processor time of a step.

OLD and NEW are folders of two checkouts. Each has a process with its own kernel cache, which waits while the other one steps.
Processor time is the sum over all threads; other programs disturb it less. ``--targets haswell`` compiles for processors
without AVX-512.
"""

from __future__ import annotations

import json
import os
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.tables import markdown

WHAT = "a training step on a CPU from two checkouts in turn, 504 x 378 px"
SIDES = ("old", "new")
WORKER = """
import json, sys, time
import warp
count, threads, target = int(sys.argv[1]), int(sys.argv[2]), sys.argv[3]
if target != "native":
    warp.config.cpu_compiler_flags = warp.config.cpu_compiler_flags.replace("-march=native", f"-target-cpu {target}")
try:
    from warpgs.kernels.launch import set_threads
except ImportError:  # before warpgs had these rooms
    from warpgs.runtime.interop import set_threads
import torch
try:
    from bench.lib import inputs, training
except ImportError:  # before bench had this folder
    from bench import inputs, training
set_threads(threads)
device = torch.device("cpu")
gaussians, camera = inputs.gaussians(count, device), inputs.camera(504, 378, device)
steps = training.Steps(gaussians, camera, inputs.image(504, 378, device), "exact", lr=0.0)
for line in sys.stdin:
    times = []
    for _ in range(int(line)):
        wall, cpu = time.perf_counter(), time.process_time()
        steps.eager()
        times.append((1000 * (time.perf_counter() - wall), 1000 * (time.process_time() - cpu)))
    print(json.dumps(times), flush=True)
"""
"""Program of a process, valid in both checkouts."""


def _process(checkout: Path, cache: Path, count: int, threads: int, target: str) -> subprocess.Popen:
    """Start the process of a checkout."""
    own = {"PYTHONPATH": str(checkout), "WARP_CACHE_PATH": str(cache), "OMP_NUM_THREADS": str(threads)}
    words = [sys.executable, "-c", WORKER, str(count), str(threads), target]
    return subprocess.Popen(words, cwd=checkout, env=os.environ | own, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def _steps(process: subprocess.Popen, count: int) -> list[list[float]]:
    """Take steps; return wall and processor time of each [ms]."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write(f"{count}\n")
    process.stdin.flush()
    line = process.stdout.readline()
    if not line:
        raise RuntimeError(f"the process of a checkout ended: {process.args}")
    return json.loads(line)


def measured(processes: dict[str, subprocess.Popen], rounds: int, each: int) -> dict[str, list[list[float]]]:
    """Return the times of all steps by side; the order changes from round to round, and the first round is not kept."""
    times: dict[str, list[list[float]]] = {side: [] for side in SIDES}
    for turn in range(rounds + 1):
        for side in SIDES if turn % 2 else SIDES[::-1]:
            found = _steps(processes[side], each)
            times[side] += found if turn else []
    return times


def main() -> None:
    """Measure, print, write."""
    a = parse(
        __doc__, None, {"old": Path, "new": Path}, counts=[500, 20_000, 171_000], thread_counts=[1, 2],
        targets=["native", "haswell"], rounds=10, steps=4, out=Path,
    )  # fmt: skip
    rows = []
    with tempfile.TemporaryDirectory() as work:
        for target, threads, count in ((t, n, c) for t in a.targets for n in a.thread_counts for c in a.counts):
            made = {s: _process(getattr(a, s).resolve(), Path(work, f"{s}_{target}"), count, threads, target) for s in SIDES}
            times = measured(made, a.rounds, a.steps)
            for process in made.values():
                process.communicate()
            for side in SIDES:
                row: dict = {"target": target, "threads": threads, "gaussians": count, "side": side, "steps": len(times[side])}
                for k, kind in enumerate(("wall", "cpu")):
                    values = [t[k] for t in times[side]]
                    row |= {f"{kind}_least_ms": round(min(values), 2), f"{kind}_median_ms": round(statistics.median(values), 2)}
                rows.append(row)
            commits = {side: result_file.commit_of(getattr(a, side)) for side in SIDES}
            result_file.keep(a.out, WHAT, torch.device("cpu"), rows, commits=commits)
            print(markdown(list(rows[0]), [list(r.values()) for r in rows[-2:]]), flush=True)


if __name__ == "__main__":
    main()
