"""Time of binning N Gaussians into tiles, both sorts included."""

from bench.lib import roofline
from bench.lib.pairs import binned
from bench.lib.timing import OURS, Task
from warpgs.constants import RULES
from warpgs.kernels.tiles import bin_tiles

AXES = ("count", "image", "cameras")
PROGRAMS = {OURS: ("forward",)}


def tasks(point, device, wanted):
    projected, counts, tiles = binned(point, device)
    cost = roofline.tiles(point.count, point.cameras, len(tiles.slots), len(tiles.ranges))

    def work():
        return bin_tiles(projected, counts, width=point.width, height=point.height, rule=RULES["exact"])

    yield Task(OURS, "forward", work, cost, {"instances": len(tiles.slots)})
