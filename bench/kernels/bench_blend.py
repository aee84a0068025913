"""Time of compositing N binned Gaussians."""

import torch

from bench import inputs, roofline
from bench.harness import OURS, passes
from bench.pairs import instances_and_pairs
from warpgs.constants import RULES
from warpgs.kernels.blend import blend
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles

AXES = ("count", "image", "cameras")
PROGRAMS = {OURS: ("forward", "backward")}


def tasks(point, device, wanted):
    rule, size = RULES["exact"], {"width": point.width, "height": point.height}
    with torch.no_grad():
        tensors = inputs.gaussians(point.count, device, 0).tensors().values()
        camera = inputs.camera(point.width, point.height, device, point.cameras)
        projected, tile_counts = project(*tensors, camera.viewmat, camera.K, **size, degree=0, rule=rule)
        tiles = bin_tiles(projected, tile_counts, **size, rule=rule)
    leaf, backgrounds = projected.detach().requires_grad_(), torch.zeros(point.cameras, 3, device=device)
    instances, pairs = instances_and_pairs(point, device)
    costs = roofline.blend(point.count, point.cameras, point.pixels, instances, pairs)

    def work():
        return blend(leaf, tiles, backgrounds, **size, rule=rule)[0]

    yield from passes(OURS, work, [leaf], wanted, costs, {"instances": instances, "pairs": pairs})
