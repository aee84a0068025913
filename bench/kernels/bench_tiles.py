"""Time of binning N Gaussians into tiles, both sorts included."""

import torch

from bench import inputs, roofline
from bench.harness import OURS, Task
from warpgs.constants import RULES
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles

AXES = ("count", "image", "cameras")
PROGRAMS = {OURS: ("forward",)}


def tasks(point, device, wanted):
    rule, size = RULES["exact"], {"width": point.width, "height": point.height}
    with torch.no_grad():
        tensors = inputs.gaussians(point.count, device, 0).tensors().values()
        camera = inputs.camera(point.width, point.height, device, point.cameras)
        projected, tile_counts = project(*tensors, camera.viewmat, camera.K, **size, degree=0, rule=rule)
    tiles = bin_tiles(projected, tile_counts, **size, rule=rule)
    cost = roofline.tiles(point.count, point.cameras, len(tiles.slots), len(tiles.ranges))

    def work():
        return bin_tiles(projected, tile_counts, **size, rule=rule)

    yield Task(OURS, "forward", work, cost, {"instances": len(tiles.slots)})
