"""Time of evaluating spherical harmonics for N directions."""

import torch

from bench import inputs, roofline
from bench.harness import OURS, passes
from warpgs.kernels.sh import evaluate_sh

AXES = ("count", "degree")
PROGRAMS = {OURS: ("forward", "backward")}


def tasks(point, device, wanted):
    sh = inputs.gaussians(point.count, device, point.degree).sh
    dirs = torch.randn(point.count, 3, generator=torch.Generator().manual_seed(1))
    dirs = torch.nn.functional.normalize(dirs, dim=1).to(device).requires_grad_()

    def work():
        return evaluate_sh(sh, dirs, point.degree)

    yield from passes(OURS, work, [sh, dirs], wanted, roofline.sh(point.count, point.degree))
