"""The price of determinism: ordered against atomic sums of gradients, time and memory, and how far atomic ones spread.

On a CPU both modes are the same code, and so is what they measure; the program then runs and says so.
"""

from __future__ import annotations

from pathlib import Path

import torch

from bench.lib import inputs, result_file
from bench.lib.arguments import parse
from bench.lib.atomic_sums import atomic_spread, gradients_of
from bench.lib.tables import named
from bench.lib.timing import Task, measure_in_turn, peak_bytes
from warpgs.pipeline.runs.request import choose_device
from warpgs.scene import Camera, Gaussians

MODES = {"deterministic": True, "atomic": False}


def cost(g: Gaussians, cam: Camera, repeats: int, device: torch.device) -> dict[str, dict]:
    """Time [ms] of forward and backward in both modes, in turns, and on CUDA the memory that a run takes [bytes]."""
    tasks = [
        Task("warpgs", "both", lambda d=d: gradients_of(g, cam, deterministic=d), facts={"mode": name})
        for name, d in MODES.items()
    ]
    rows = measure_in_turn([t.run for t in tasks], device, repeats)
    result = {}
    for task, row in zip(tasks, rows):
        result[task.facts["mode"]] = row | ({"peak_bytes": peak_bytes(task, device)} if device.type == "cuda" else {})
    return result


def main() -> None:
    """Parse, measure, print, and write JSON where asked."""
    a = parse(__doc__, gaussians=[20_000, 300_000], size=[1920, 1080], repeats=50, device="auto", out=Path)
    device, where = choose_device(a.device)
    if device.type == "cpu":
        print("on a CPU sums are always ordered: both modes run the same code, and no gradient can spread")
    rows = []
    for count in a.gaussians:
        g, cam = inputs.gaussians(count, device), inputs.camera(*a.size, device)
        row = {"gaussians": count, "width": a.size[0], "height": a.size[1]}
        row |= {"price": cost(g, cam, a.repeats, device), "spread": atomic_spread(g, cam, a.repeats)}
        rows.append(row)
        print(f"{count:,} Gaussians, {a.size[0]} x {a.size[1]} px, {where}")
        for mode, figures in row["price"].items():
            memory = f", {figures['peak_bytes'] / 2**20:.1f} MiB" if "peak_bytes" in figures else ""
            print(f"  {mode:<14} {figures['median_ms']:.3f} ms {figures['quartiles_ms']}{memory}")
        for name, figures in row["spread"].items():
            print(f"  {name:<16} {named(figures, 3)}")
    what = "forward and backward with ordered and with atomic sums of gradients: time, memory and spread"
    result_file.keep(a.out, what, device, rows, repeats=a.repeats)


if __name__ == "__main__":
    main()
