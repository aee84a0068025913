"""Time of one Adam step over the colour coefficients of N Gaussians, degree 3."""

import torch

from bench.lib import roofline
from bench.lib.timing import OURS, Task
from warpgs.kernels.update import adam_step

AXES = ("count",)
PROGRAMS = {OURS: ("forward",)}


def tasks(point, device, wanted):
    state = [torch.rand(point.count, 16, 3, device=device) for _ in range(4)]

    def work():
        adam_step(*state, lr=1e-3, step=10, head_lr=1e-2, head=3)

    yield Task(OURS, "forward", work, roofline.adam(state[0].numel()))
