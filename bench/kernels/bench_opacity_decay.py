"""Time of the decay of N opacities."""

import torch

from bench.lib import roofline
from bench.lib.timing import OURS, Task
from warpgs.kernels.update import opacity_decay

AXES = ("count",)
PROGRAMS = {OURS: ("forward",)}


def tasks(point, device, wanted):
    logits = torch.randn(point.count, device=device)
    yield Task(OURS, "forward", lambda: opacity_decay(logits, 0.999), roofline.opacity_decay(point.count))
