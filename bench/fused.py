"""A recorded training step with projection's backward pass and Adam in one kernel, and with the two apart.

usage: python -m bench.fused GARDEN.npz [--out FILE.json] [--only NAME] [--kernels]
Needs a CUDA device. Both recordings start from the same Gaussians and are replayed in turn.
"""

from __future__ import annotations

import argparse
import gc
import json
from pathlib import Path

import torch

from bench.against_gsplat import first_camera, gpu_times, wall_times
from bench.garden import garden_inputs
from bench.machine import describe
from warpgs.pipeline.model.table import Optimizer, OptimizerConfig
from warpgs.pipeline.train.loss import LossConfig
from warpgs.pipeline.train.step import BURST, Burst, StepGraph, Views
from warpgs.pipeline.train.strategies.clone_split import DensityStats
from warpgs.scene import Camera, Gaussians

CONFIGURATIONS = {"112k at 504x378": (1, 504, 378), "2.8M at 1920x1080": (5, 1920, 1080)}
STEPS = 20
"""Steps after which the two are compared."""
REPEATS = 40


class Recording:
    """One of the two: its Gaussians, its recording, and the memory [MiB] that a step took on top of the Gaussians."""

    def __init__(self, gaussians: Gaussians, camera: Camera, target: torch.Tensor, fused: bool):
        device = target.device
        self.optimizer, self.burst = Optimizer(gaussians, OptimizerConfig(), 1.0), Burst(device)
        gc.collect()
        torch.cuda.synchronize()
        torch.cuda.empty_cache()
        loaded = torch.cuda.memory_allocated()
        torch.cuda.reset_peak_memory_stats()
        self.graph = StepGraph(
            Views(camera.viewmat, camera.K, target[None], None), self.optimizer, DensityStats(len(gaussians), device),
            self.burst, degree=gaussians.sh_degree, rule="gsplat", loss=LossConfig(),
            background=torch.zeros(3, device=device), fused=fused,
        )  # fmt: skip
        self.peak = (torch.cuda.max_memory_allocated() - loaded) / 2**20
        steps = range(1, BURST + 1)
        self.burst.load([0] * BURST, [self.optimizer.schedule(0.0, k) for k in steps], [(0.0, k) for k in steps])

    def advance(self, steps: int) -> dict[str, torch.Tensor]:
        """Take steps; parameters and moments after them."""
        self.burst.counter.zero_()
        for _ in range(steps):
            self.graph.replay()
        self.check()
        return {name: t.clone() for name, t in self.optimizer.state().items()}

    def step(self) -> None:
        """One step, always with the rates of the first."""
        self.burst.counter.zero_()
        self.graph.replay()

    def check(self) -> None:
        """RuntimeError where a step stopped: it would have been timed without its update."""
        if stop := int(self.burst.stop):
            raise RuntimeError(f"a step stopped with {stop}; nothing that was timed since holds")


def differences(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor], start: dict[str, torch.Tensor]) -> dict[str, float]:
    """Of each tensor: the norm of the difference over that of the way from the start."""
    return {n: float((a[n] - b[n]).norm() / (b[n] - start[n]).norm()) for n in a}


def compare(path: str, tiles: int, width: int, height: int, repeats: int = REPEATS) -> dict:
    """One configuration: what the two leave after some steps, times, memory, kernels."""
    gaussians, cameras = garden_inputs(path, tiles=tiles, width=width, height=height)
    camera = first_camera(cameras)
    target = torch.rand(height, width, 3, device="cuda", generator=torch.Generator("cuda").manual_seed(2))
    both = {name: Recording(gaussians, camera, target, name == "fused") for name in ("apart", "fused")}
    start = {n: t.clone() for n, t in both["apart"].optimizer.state().items()}
    ends = {name: r.advance(STEPS) for name, r in both.items()}
    row = {
        "gaussians": len(gaussians), "width": width, "height": height, "steps": STEPS,
        "same_bits": all(torch.equal(t, ends["apart"][n]) for n, t in ends["fused"].items()),
        "difference": differences(ends["fused"], ends["apart"], start),
    }  # fmt: skip
    del start, ends
    row["wall_ms"] = wall_times({name: r.step for name, r in both.items()}, repeats)
    row |= {"gpu_ms": {}, "kernels_us": {}, "peak_mib": {name: round(r.peak, 1) for name, r in both.items()}}
    for name, r in both.items():
        row["gpu_ms"][name], kernels = gpu_times(r.step, repeats // 3 * 3)
        row["kernels_us"][name] = {k: round(v, 1) for k, v in kernels.most_common(30)}
        r.check()
    return row


def lines(name: str, row: dict) -> list[str]:
    """The table of one configuration."""
    worst = max(row["difference"], key=row["difference"].get)
    same = "same bits" if row["same_bits"] else f"{worst} differs by {row['difference'][worst]:.2e} of its way"
    out = [f"{name}, {row['gaussians']:,} Gaussians; after {row['steps']} steps: {same}"]
    for who in ("apart", "fused"):
        wall, gpu = row["wall_ms"][who], row["gpu_ms"][who]
        out.append(
            f"  {who:<6} wall {wall['median']:7.3f} {wall['quartiles']} ms   GPU {gpu['median']:7.3f} {gpu['spread']} ms   "
            f"peak {row['peak_mib'][who]:8.1f} MiB   kernels {len(row['kernels_us'][who])}"
        )
    wall, gpu = (row[k]["fused"]["median"] / row[k]["apart"]["median"] for k in ("wall_ms", "gpu_ms"))
    return [*out, f"  fused / apart: wall {wall:.3f}, GPU {gpu:.3f}"]


def main() -> None:
    """Measure, write, print the table last."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("garden")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--only", help="a configuration's name, or its beginning")
    parser.add_argument("--kernels", action="store_true", help="kernels by GPU time")
    a = parser.parse_args()
    rows = {}
    for name, (tiles, width, height) in CONFIGURATIONS.items():
        if a.only and not name.startswith(a.only):
            continue
        rows[name] = compare(a.garden, tiles, width, height)
        if a.kernels:
            for who, kernels in rows[name]["kernels_us"].items():
                for kernel, microseconds in kernels.items():
                    print(f"    {who:<6} {microseconds:9.1f} us  {kernel[:90]}")
        torch.cuda.empty_cache()
    if a.out:
        a.out.write_text(json.dumps({"machine": describe(torch.device("cuda", 0)), "rows": rows}, indent=1) + "\n")
    print("\n".join(line for name, row in rows.items() for line in lines(name, row)))


if __name__ == "__main__":
    main()
