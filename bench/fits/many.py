"""Training of ten million Gaussians at 3840x2160: loss, memory and time of a step.

usage: python -m bench.fits.many GARDEN.npz [--count 10000000] [--width 3840] [--height 2160] [--steps 100] [--out FILE.json]
"""

from __future__ import annotations

import itertools
import math
import time
from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.inputs import first_camera, garden_inputs
from bench.lib.tables import named
from bench.lib.training import Steps
from warpgs.scene import Gaussians


def smooth_image(width: int, height: int, device: torch.device) -> torch.Tensor:
    """Return an image to train towards: three slow waves, shape [H, W, 3]."""
    y, x = torch.meshgrid(
        torch.linspace(0, 6, height, device=device), torch.linspace(0, 9, width, device=device), indexing="ij"
    )
    return torch.stack([0.5 + 0.4 * torch.sin(x), 0.5 + 0.4 * torch.sin(y), 0.5 + 0.4 * torch.sin(x + y)], -1)


def train(path: Path, count: int, width: int, height: int, steps: int) -> dict:
    """Train on one view with recorded steps; return losses, memory and time."""
    device = torch.device("cuda", torch.cuda.current_device())
    cells = math.ceil(math.sqrt(count / 111_000))
    gaussians, cameras = garden_inputs(path, tiles=cells, sh_degree=3, width=width, height=height)
    gaussians = Gaussians(**{n: t.detach()[:count].clone() for n, t in gaussians.tensors().items()})
    target = smooth_image(width, height, device)
    trainer = Steps(gaussians, first_camera(cameras), target, "exact")
    begin = time.perf_counter()
    losses = trainer.train(steps)
    seconds = time.perf_counter() - begin
    return {
        "gaussians": len(gaussians), "width": width, "height": height, "steps": steps,
        "loss_first": losses[0], "loss_last": losses[-1],
        "falling_pairs": sum(a > b for a, b in itertools.pairwise(losses)), "ms_per_step": 1000 * seconds / steps,
        "peak_gib": torch.cuda.max_memory_allocated() / 2**30, "reserved_gib": torch.cuda.max_memory_reserved() / 2**30,
    }  # fmt: skip


def main() -> None:
    """Train, print, write."""
    a = parse(__doc__, None, {"garden": Path}, count=10_000_000, width=3840, height=2160, steps=100, out=Path)
    made = train(a.garden, a.count, a.width, a.height, a.steps)
    print(named(made))
    what = "many Gaussians trained on one image by recorded steps: loss, memory and time"
    result_file.keep(a.out, what, torch.device("cuda"), [made])


if __name__ == "__main__":
    main()
