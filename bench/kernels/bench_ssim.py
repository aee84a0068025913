"""Time of structural similarity, beside plain torch convolutions."""

from bench.lib import inputs, peers, roofline
from bench.lib.timing import OURS, passes
from warpgs.kernels.ssim import ssim

AXES = ("image",)
PROGRAMS = {OURS: ("forward", "backward"), peers.TORCH_SSIM: ("forward", "backward")}


def tasks(point, device, wanted):
    image = inputs.image(point.width, point.height, device).requires_grad_()
    target = inputs.image(point.width, point.height, device, seed=1)
    yield from passes(OURS, lambda: ssim(image, target), [image], wanted, roofline.ssim(point.pixels))
    yield from passes(peers.TORCH_SSIM, lambda: peers.torch_ssim(image, target), [image], wanted)
