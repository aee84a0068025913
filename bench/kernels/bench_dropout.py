"""Time of sampling the opacity factors of N Gaussians."""

import torch

from bench.lib import roofline
from bench.lib.timing import OURS, Task
from warpgs.kernels.update import Setting, opacity_dropout

AXES = ("count",)
PROGRAMS = {OURS: ("forward",)}


def tasks(point, device, wanted):
    row = Setting.row(dropout=0.2, number=1, step=1, means_lr=0.0, shift=(0.0, 0.0, 0.0))
    settings = torch.tensor(row, dtype=torch.float32, device=device)
    yield Task(OURS, "forward", lambda: opacity_dropout(point.count, settings, 0), roofline.dropout(point.count))
