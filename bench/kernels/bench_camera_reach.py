"""Time of computing the largest sizes at which N Gaussians reach none of 32 cameras."""

import torch

from bench.lib import roofline
from bench.lib.timing import OURS, Task
from warpgs.kernels.neighbours import camera_reach

AXES = ("count",)
PROGRAMS = {OURS: ("forward",)}
CAMERAS = 32


def tasks(point, device, wanted):
    means, centers = torch.randn(point.count, 3, device=device), torch.randn(CAMERAS, 3, device=device)
    yield Task(OURS, "forward", lambda: camera_reach(means, centers, 1 / 3), roofline.camera_reach(point.count, CAMERAS))
