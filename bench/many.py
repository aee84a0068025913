"""Ten million Gaussians at 3840x2160: does it train, in what memory, at what speed?

usage: python -m bench.many GARDEN.npz [--count 10000000] [--width 3840] [--height 2160] [--steps 100] [--out FILE.json]
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import time
from pathlib import Path

import torch

from bench.against_gsplat import first_camera
from bench.garden import garden_inputs
from warpgs.pipeline.train.loss import LossConfig
from warpgs.pipeline.train.schedule import OptimizerConfig
from warpgs.pipeline.train.step import STEPS_PER_BATCH, StepBuffers, StepGraph, Views
from warpgs.scene import Gaussians


def smooth_image(width: int, height: int, device: torch.device) -> torch.Tensor:
    """A picture to train towards: three slow waves, shape [H, W, 3]."""
    y, x = torch.meshgrid(
        torch.linspace(0, 6, height, device=device), torch.linspace(0, 9, width, device=device), indexing="ij"
    )
    return torch.stack([0.5 + 0.4 * torch.sin(x), 0.5 + 0.4 * torch.sin(y), 0.5 + 0.4 * torch.sin(x + y)], -1)


def train(path: str, count: int, width: int, height: int, steps: int) -> dict:
    """Recorded steps on one view; losses, memory and time."""
    device = torch.device("cuda", torch.cuda.current_device())
    cells = math.ceil(math.sqrt(count / 111_000))
    gaussians, cameras = garden_inputs(path, tiles=cells, sh_degree=3, width=width, height=height)
    gaussians = Gaussians(**{n: t.detach()[:count].clone() for n, t in gaussians.tensors().items()})
    camera, buffers = first_camera(cameras), StepBuffers(device)
    optimizer = Optimizer(gaussians, OptimizerConfig(), 1.0)
    views = Views(camera.viewmat, camera.K, smooth_image(width, height, device)[None], None)
    graph = StepGraph(
        views, optimizer, None, buffers, degree=3, rule="exact", loss=LossConfig(), background=torch.zeros(3, device=device)
    )
    losses, begin = [], time.perf_counter()
    while len(losses) < steps:
        wanted = min(STEPS_PER_BATCH, steps - len(losses))
        numbers = range(len(losses) + 1, len(losses) + wanted + 1)
        buffers.load([0] * wanted, [optimizer.schedule(0.0, n) for n in numbers], [(0.0, n) for n in numbers])
        for _ in range(wanted):
            graph.replay()
        done, stop, history = buffers.result()
        if stop:
            raise RuntimeError(f"stopped after {len(losses) + done} steps")
        losses += [loss for loss, _ in history[:done]]
    seconds = time.perf_counter() - begin
    return {
        "device": torch.cuda.get_device_name(), "gaussians": len(gaussians), "width": width, "height": height, "steps": steps,
        "capacity": graph.capacity, "loss_first": losses[0], "loss_last": losses[-1],
        "falling_pairs": sum(a > b for a, b in itertools.pairwise(losses)), "ms_per_step": 1000 * seconds / steps,
        "peak_gib": torch.cuda.max_memory_allocated() / 2**30, "reserved_gib": torch.cuda.max_memory_reserved() / 2**30,
    }  # fmt: skip


def main() -> None:
    """Parse, train, print, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("garden")
    for name, value in (("count", 10_000_000), ("width", 3840), ("height", 2160), ("steps", 100)):
        parser.add_argument(f"--{name}", type=int, default=value)
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    result = train(a.garden, a.count, a.width, a.height, a.steps)
    print(json.dumps(result, indent=1))
    if a.out:
        a.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
