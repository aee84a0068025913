"""Time of adding a depth map to a grid of N points."""

import torch

from bench.lib import inputs
from bench.lib.timing import OURS, Task
from warpgs.kernels.tsdf import empty_grid, integrate
from warpgs.scene import Camera

AXES = ("count", "image")
PROGRAMS = {OURS: ("forward",)}


def tasks(point, device, wanted):
    camera = inputs.camera(point.width, point.height, device, 1)
    one = Camera(*(t[0].double().cpu().numpy() for t in (camera.viewmat, camera.K)), point.width, point.height)
    side = max(2, round(point.count ** (1 / 3)))
    depth = torch.full((point.height, point.width), 4.0, device=device)
    grid = empty_grid((-2.0, -2.0, 2.0), 4.0 / side, (side,) * 3, 16.0 / side, depth)
    weights = torch.ones_like(depth)
    yield Task(OURS, "forward", lambda: integrate(grid, one, depth, weights))
