"""Time of a whole image, forward and forward with backward, beside other rasterizers."""

import torch

from bench import inputs, peers, roofline
from bench.harness import OURS, Task
from bench.pairs import instances_and_pairs
from warpgs import rasterize

AXES = ("count", "image", "degree", "cameras", "threads")
PROGRAMS = {OURS: ("forward", "both"), **dict.fromkeys(peers.RASTERIZERS, ("forward", "both"))}

LARGEST = {peers.DENSE: 1_000}
"""Most Gaussians that a peer is given at all."""


def costs(point, device) -> tuple[roofline.Cost, roofline.Cost]:
    """Forward and backward of projection, tiles and blending together."""
    instances, pairs = instances_and_pairs(point, device)
    tiles_in_all = point.cameras * -(-point.width // 16) * -(-point.height // 16)
    stages = (
        roofline.project(point.count, point.cameras, point.degree),
        roofline.blend(point.count, point.cameras, point.pixels, instances, pairs),
    )
    forward = stages[0][0] + roofline.tiles(point.count, point.cameras, instances, tiles_in_all) + stages[1][0]
    return forward, stages[0][1] + stages[1][1]


def tasks(point, device, wanted):
    gaussians = inputs.gaussians(point.count, device, point.degree)
    camera = inputs.camera(point.width, point.height, device, point.cameras)
    upstream = torch.rand(point.cameras, point.height, point.width, 3, device=device)
    tensors = list(gaussians.tensors().values())
    forward_cost, backward_cost = costs(point, device)
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
