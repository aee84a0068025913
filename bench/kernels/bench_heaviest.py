"""Time of finding the 8 heaviest of N binned Gaussians in each pixel."""

from bench.lib.pairs import binned
from bench.lib.timing import OURS, Task
from warpgs.constants import RULES
from warpgs.kernels.walk import heaviest

AXES = ("count", "image", "cameras")
PROGRAMS = {OURS: ("forward",)}
COUNT = 8


def tasks(point, device, wanted):
    size = {"width": point.width, "height": point.height, "rule": RULES["exact"]}
    projected, _, tiles = binned(point, device)
    yield Task(OURS, "forward", lambda: heaviest(projected, tiles, COUNT, **size))
