"""Time of computing the pixel sizes of 32 cameras at N Gaussians."""

import torch

from bench.lib import roofline
from bench.lib.timing import OURS, Task
from warpgs.kernels.neighbours import pixel_size

AXES = ("count",)
PROGRAMS = {OURS: ("forward",)}
CAMERAS = 32


def tasks(point, device, wanted):
    means, cameras = torch.randn(point.count, 3, device=device), torch.rand(CAMERAS, 9, device=device)
    yield Task(OURS, "forward", lambda: pixel_size(means, cameras, 0.4), roofline.pixel_size(point.count, CAMERAS))
