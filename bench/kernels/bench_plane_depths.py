"""Time of choosing the best plane of each pixel, on a CPU."""

import numpy as np
import torch

from bench.lib.timing import OURS, Task
from warpgs.kernels.sweep import best_inverses

AXES = ("image",)
PROGRAMS = {OURS: ("forward",)}
PLANES = 64


def tasks(point, device, wanted):
    costs = torch.randint(0, 9999, (point.height, point.width, PLANES), dtype=torch.int16)
    inverses = np.linspace(0.1, 1, PLANES)
    yield Task(OURS, "forward", lambda: best_inverses(costs, inverses))
