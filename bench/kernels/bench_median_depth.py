"""Time of the median depth of N binned Gaussians."""

import torch

from bench import inputs
from bench.harness import OURS, Task
from warpgs.constants import RULES
from warpgs.kernels.median_depth import median_depth
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles

AXES = ("count", "image", "cameras")
PROGRAMS = {OURS: ("forward",)}


def tasks(point, device, wanted):
    size = {"width": point.width, "height": point.height, "rule": RULES["exact"]}
    with torch.no_grad():
        tensors = inputs.gaussians(point.count, device, 0).tensors().values()
        camera = inputs.camera(point.width, point.height, device, point.cameras)
        projected, tile_counts = project(*tensors, camera.viewmat, camera.K, degree=0, **size)
        tiles = bin_tiles(projected, tile_counts, **size)
    yield Task(OURS, "forward", lambda: median_depth(projected, tiles, **size))
