"""The price of determinism: ordered against atomic sums of gradients, time and memory, and how far atomic ones spread.

usage: python -m bench.determinism [--gaussians 20000 300000] [--size 1920 1080] [--repeats 50] [--device auto] [--out FILE]

On a CPU both modes are the same code, and so is what they measure; the program then runs and says so.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import torch

from bench import result_file
from bench.harness import Task, measure_in_turn, peak_bytes
from bench.inputs import camera, gaussians
from warpgs.pipeline.runs.request import choose_device
from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.scene import Camera, Gaussians

MODES = {"deterministic": True, "atomic": False}


def scene(count: int, width: int, height: int, device: torch.device) -> tuple[Gaussians, Camera]:
    """A cloud of ``count`` Gaussians and a batch of one camera."""
    return gaussians(count, device), camera(width, height, device)


def gradients_of(g: Gaussians, cam: Camera, *, deterministic: bool) -> list[torch.Tensor]:
    """Colour, alpha and depth, and the gradients of a fixed mix of them in the five tensors of ``g``."""
    leaves = {n: t.detach().requires_grad_() for n, t in g.tensors().items()}
    r = rasterize(Gaussians(**leaves), cam, RasterizeOptions(deterministic=deterministic, record=False))
    loss = r.rgb.square().sum() + (r.alpha * r.depth).sum()
    return [t.detach() for t in (r.rgb, r.alpha, r.depth)] + list(torch.autograd.grad(loss, list(leaves.values())))


def ulps(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
    """Return the number of float32 values between the entries of two tensors, int64."""

    def ordered(t: torch.Tensor) -> torch.Tensor:
        bits = t.contiguous().view(torch.int32).long()
        return torch.where(bits < 0, -(bits & 0x7FFFFFFF), bits)

    return (ordered(a) - ordered(b)).abs()


def atomic_spread(g: Gaussians, cam: Camera, repeats: int) -> dict[str, dict]:
    """Return the distance of the gradients of repeated atomic sums from the ordered ones, by parameter.

    ``rel_l2``: largest relative L2 distance of a repeat from the ordered sum. ``max_ulp``: largest distance of an entry that
    is at least a thousandth of its tensor's largest, in units in the last place. ``repeats_that_differ``: how many repeats
    are not the bits of the first.
    """
    wanted = gradients_of(g, cam, deterministic=True)[3:]
    names = list(g.tensors())
    rows = {n: {"rel_l2": 0.0, "max_ulp": 0, "repeats_that_differ": 0} for n in names}
    first = None
    for _ in range(repeats):
        found = gradients_of(g, cam, deterministic=False)[3:]
        first = found if first is None else first
        for name, a, b, c in zip(names, found, wanted, first):
            row = rows[name]
            row["rel_l2"] = max(row["rel_l2"], float((a.double() - b.double()).norm() / b.double().norm()))
            large = b.abs() >= 1e-3 * b.abs().max()
            row["max_ulp"] = max(row["max_ulp"], int(ulps(a, b)[large].max()))
            row["repeats_that_differ"] += int(not torch.equal(a, c))
    return rows


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
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--gaussians", type=int, nargs="+", default=[20_000, 300_000])
    parser.add_argument("--size", type=int, nargs=2, default=[1920, 1080], metavar=("WIDTH", "HEIGHT"))
    parser.add_argument("--repeats", type=int, default=50)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    device, where = choose_device(a.device)
    if device.type == "cpu":
        print("on a CPU sums are always ordered: both modes run the same code, and no gradient can spread")
    rows = []
    for count in a.gaussians:
        g, cam = scene(count, *a.size, device)
        row = {"gaussians": count, "width": a.size[0], "height": a.size[1]}
        row |= {"price": cost(g, cam, a.repeats, device), "spread": atomic_spread(g, cam, a.repeats)}
        rows.append(row)
        print(f"{count:,} Gaussians, {a.size[0]} x {a.size[1]} px, {where}")
        for mode, figures in row["price"].items():
            memory = f", {figures['peak_bytes'] / 2**20:.1f} MiB" if "peak_bytes" in figures else ""
            print(f"  {mode:<14} {figures['median_ms']:.3f} ms {figures['quartiles_ms']}{memory}")
        for name, figures in row["spread"].items():
            print(f"  {name:<16} " + "  ".join(f"{k} {v:.3g}" for k, v in figures.items()))
    what = "forward and backward with ordered and with atomic sums of gradients: time, memory and spread"
    result_file.write(a.out, result_file.result(what, device, rows, repeats=a.repeats))


if __name__ == "__main__":
    main()
