"""Time of a training step: rendering, photometric loss, backward pass, Adam over all parameters.

Learning rates are nearly zero, so that every repeat renders the same scene. The peer has the usual parts of trainers: gsplat's
rendering, the loss in plain torch, torch's fused Adam.
"""

import torch

from bench.lib import inputs, peers, roofline, training
from bench.lib.pairs import image_costs
from bench.lib.timing import OURS, Task

AXES = ("count", "image", "degree", "threads")
PROGRAMS = {OURS: ("step",), peers.GSPLAT_STEP: ("step",)}
LR = 1e-12


def cost(point, device) -> roofline.Cost:
    """Return the cost of all stages together; the rest of the loss besides SSIM, a few bytes per pixel, is left out."""
    numbers = point.count * (11 + 3 * (point.degree + 1) ** 2)
    total = roofline.adam(numbers)
    for stage in (*image_costs(point, device), *roofline.ssim(point.pixels)):
        total += stage
    return total


def tasks(point, device, wanted):
    gaussians = inputs.gaussians(point.count, device, point.degree)
    batch = inputs.camera(point.width, point.height, device)
    target = inputs.image(point.width, point.height, device)

    if wanted(OURS, "step"):
        yield Task(OURS, "step", training.Steps(gaussians, batch, target, "exact", LR).eager, cost(point, device))

    if wanted(peers.GSPLAT_STEP, "step"):
        adam = torch.optim.Adam(gaussians.tensors().values(), lr=LR, eps=1e-15, fused=True)

        def peer_step():
            image = peers.gsplat_rasterize(gaussians, batch)[0]
            structural = peers.torch_ssim(image, target).mean()
            ((image - target).abs().mean() * 0.8 + (1 - structural) * 0.2).backward()
            adam.step()
            adam.zero_grad(set_to_none=True)

        yield Task(peers.GSPLAT_STEP, "step", peer_step)
