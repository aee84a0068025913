"""Time of drawing the opacity factors of N Gaussians."""

import torch

from bench.lib import roofline
from bench.lib.timing import OURS, Task
from warpgs.kernels.dropout import opacity_dropout

AXES = ("count",)
PROGRAMS = {OURS: ("forward",)}


def tasks(point, device, wanted):
    settings = torch.tensor([0.2, 1.0, 0.0, 0.0, 0.0, 0.0], device=device)
    yield Task(OURS, "forward", lambda: opacity_dropout(point.count, settings, 0), roofline.dropout(point.count))
