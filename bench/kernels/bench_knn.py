"""Time of finding the three nearest neighbours of N points."""

import torch

from bench.lib import roofline
from bench.lib.timing import OURS, Task
from warpgs.kernels.neighbours import mean_square_distances

AXES = ("count",)
PROGRAMS = {OURS: ("forward",)}


def tasks(point, device, wanted):
    points = torch.randn(point.count, 3, generator=torch.Generator().manual_seed(0)).to(device)
    yield Task(OURS, "forward", lambda: mean_square_distances(points), roofline.knn(point.count))
