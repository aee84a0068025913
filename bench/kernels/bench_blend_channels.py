"""Time of compositing N binned Gaussians with 32 channels."""

import torch

from bench.lib.pairs import binned
from bench.lib.timing import OURS, passes
from warpgs.constants import RULES
from warpgs.kernels.blend import blend_channels

AXES = ("count", "image", "cameras")
PROGRAMS = {OURS: ("forward", "backward")}
CHANNELS = 32


def tasks(point, device, wanted):
    size = {"width": point.width, "height": point.height, "rule": RULES["exact"]}
    projected, _, tiles = binned(point, device)
    leaf, backgrounds = projected.detach().requires_grad_(), torch.zeros(point.cameras, CHANNELS, device=device)
    colors = torch.randn(1, point.count, CHANNELS, device=device).requires_grad_()
    yield from passes(OURS, lambda: blend_channels(leaf, tiles, colors, backgrounds, **size)[0], [leaf, colors], wanted)
