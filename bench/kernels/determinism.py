"""The cost of determinism: ordered and atomic sums of gradients, time, memory and whether bits repeat.

Measured are our kernels in both modes, and naive kernels with plain atomics or with atomics made repeatable by Warp
(`wp.DeterministicMode`). On a CPU all modes run the same code and give the same results; the program prints a note.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import torch
import warp as wp

from bench.lib import inputs, naive, result_file
from bench.lib.arguments import parse
from bench.lib.atomic_sums import atomic_spread
from bench.lib.tables import named
from bench.lib.timing import Task, measure_in_turn, peak_bytes
from warpgs.pipeline.run.request import choose_device
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

WARP = wp.DeterministicMode


def works_of(g: Gaussians, cam: Camera) -> dict[str, Callable[[], tuple[torch.Tensor, ...]]]:
    """Return the work of each mode by name: an image and its gradients."""
    leaves, layers = list(g.tensors().values()), naive.layers_of(g, cam)

    def both(draw: Callable[[], torch.Tensor]):
        return lambda: torch.autograd.grad(draw().square().sum(), leaves)

    def ours(deterministic: bool):
        return both(lambda: rasterize(g, cam, RasterizeOptions(deterministic=deterministic, record=False)).rgb)

    def naively(mode: WARP):
        return both(lambda: naive.rasterize(g, cam, mode, layers if mode else 0))

    return {
        "deterministic": ours(True),
        "atomic": ours(False),
        "naive atomic": naively(WARP.NOT_GUARANTEED),
        "naive, Warp's run to run": naively(WARP.RUN_TO_RUN),
        "naive, Warp's GPU to GPU": naively(WARP.GPU_TO_GPU),
    }


def repeats_that_differ(work: Callable[[], tuple[torch.Tensor, ...]], repeats: int) -> int:
    """Return the number of repeats that differ in bits from the first one."""
    first = work()
    return sum(not all(map(torch.equal, first, work())) for _ in range(repeats - 1))


def cost(g: Gaussians, cam: Camera, repeats: int, device: torch.device) -> dict[str, dict]:
    """Time [ms] of forward and backward by mode, in turns, repeats that differ, and on CUDA the memory of a run [bytes]."""
    works, result = works_of(g, cam), {}
    for name in list(works):
        try:
            result[name] = {"repeats_that_differ": repeats_that_differ(works[name], 10)}
        except (RuntimeError, ValueError) as e:  # too many records, or too much memory
            result[name] = {"reason": " ".join(str(e).split())[:200]}
            del works[name]
    for name, row in zip(works, measure_in_turn(list(works.values()), device, repeats), strict=True):
        result[name] |= row
        if device.type == "cuda":
            result[name]["peak_bytes"] = peak_bytes(Task("naive" if "naive" in name else "warpgs", "both", works[name]), device)
    return result


def main() -> None:
    """Parse, measure, print, and write JSON where asked."""
    a = parse(__doc__, gaussians=[20_000, 300_000], sizes=["504x378", "1920x1080"], repeats=50, device="auto", out=Path)
    device, where = choose_device(a.device)
    if device.type == "cpu":
        print("on a CPU sums are always ordered: all modes run the same code, and no gradient can spread")
    rows = []
    for width, height in (map(int, size.split("x")) for size in a.sizes):
        for count in a.gaussians:
            g, cam = inputs.gaussians(count, device), inputs.camera(width, height, device)
            row = {"gaussians": count, "width": width, "height": height, "layers": naive.layers_of(g, cam)}
            row |= {"price": cost(g, cam, a.repeats, device), "spread": atomic_spread(g, cam, a.repeats)}
            rows.append(row)
            print(f"{count:,} Gaussians, {width} x {height} px, up to {row['layers']} layers, {where}")
            for mode, figures in row["price"].items():
                if "reason" in figures:
                    print(f"  {mode:<25} {figures['reason']}")
                    continue
                memory = f", {figures['peak_bytes'] / 2**20:.1f} MiB" if "peak_bytes" in figures else ""
                differ = f"{figures['repeats_that_differ']} of 9 repeats differ"
                print(f"  {mode:<25} {figures['median_ms']:.3f} ms {figures['quartiles_ms']}{memory}, {differ}")
            for name, figures in row["spread"].items():
                print(f"  {name:<16} {named(figures, 3)}")
    what = "forward and backward with ordered and with atomic sums of gradients: time, memory and spread"
    result_file.keep(a.out, what, device, rows, repeats=a.repeats)


if __name__ == "__main__":
    main()
