"""Time of computing the median depth of N binned Gaussians."""

from bench.lib.pairs import binned
from bench.lib.timing import OURS, Task
from warpgs.constants import RULES
from warpgs.kernels.walk import median_depth

AXES = ("count", "image", "cameras")
PROGRAMS = {OURS: ("forward",)}


def tasks(point, device, wanted):
    size = {"width": point.width, "height": point.height, "rule": RULES["exact"]}
    projected, _, tiles = binned(point, device)
    yield Task(OURS, "forward", lambda: median_depth(projected, tiles, **size))
