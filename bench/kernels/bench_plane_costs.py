"""Time of computing the matching costs of an image with four others, on a CPU."""

import numpy as np

from bench.lib.timing import OURS, Task
from warpgs.kernels.sweep import plane_costs

AXES = ("image",)
PROGRAMS = {OURS: ("forward",)}
PLANES = 64


def tasks(point, device, wanted):
    gray = np.random.default_rng(0).random((point.height, point.width), np.float32)
    there = np.tile(np.eye(3), (PLANES, 4, 1, 1))
    there[..., 0, 2] = np.arange(PLANES)[:, None] / 2
    yield Task(OURS, "forward", lambda: plane_costs(gray, [gray] * 4, there, 7, 6e-5, 4096))
