"""Time of compositing N binned Gaussians."""

import torch

from bench.lib import roofline
from bench.lib.pairs import binned, instances_and_pairs
from bench.lib.timing import OURS, passes
from warpgs.constants import RULES
from warpgs.kernels.blend import blend

AXES = ("count", "image", "cameras")
PROGRAMS = {OURS: ("forward", "backward")}


def tasks(point, device, wanted):
    projected, _, tiles = binned(point, device)
    leaf, backgrounds = projected.detach().requires_grad_(), torch.zeros(point.cameras, 3, device=device)
    instances, pairs = instances_and_pairs(point, device)
    costs = roofline.blend(point.count, point.cameras, point.pixels, instances, pairs)

    def work():
        return blend(leaf, tiles, backgrounds, width=point.width, height=point.height, rule=RULES["exact"])[0]

    yield from passes(OURS, work, [leaf], wanted, costs, {"instances": instances, "pairs": pairs})
