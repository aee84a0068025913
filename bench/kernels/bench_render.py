"""Time of a whole image, forward and forward with backward, beside other rasterizers."""

import torch

from bench.lib import inputs, peers
from bench.lib.pairs import image_costs
from bench.lib.timing import OURS, Task
from warpgs import rasterize

AXES = ("count", "image", "degree", "cameras", "threads")
PROGRAMS = {OURS: ("forward", "both"), **dict.fromkeys(peers.RASTERIZERS, ("forward", "both"))}

LARGEST = {peers.DENSE: 1_000}
"""Largest number of Gaussians for a peer."""


def tasks(point, device, wanted):
    gaussians = inputs.gaussians(point.count, device, point.degree)
    camera = inputs.camera(point.width, point.height, device, point.cameras)
    upstream = torch.rand(point.cameras, point.height, point.width, 3, device=device)
    tensors = list(gaussians.tensors().values())
    forward_cost, backward_cost = image_costs(point, device)
    for program, draw in {OURS: lambda g, c: rasterize(g, c).rgb, **peers.RASTERIZERS}.items():

        def forward(draw=draw):
            return draw(gaussians, camera)

        def both(draw=draw):
            return torch.autograd.grad(draw(gaussians, camera), tensors, upstream)

        ours = program == OURS
        if wanted(program, "forward"):
            yield Task(program, "forward", forward, forward_cost if ours else None)
        if wanted(program, "both"):
            yield Task(program, "both", both, forward_cost + backward_cost if ours else None)
