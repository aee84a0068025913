"""The ops that `bench.kernels.ops` times: for each the sizes that it depends on, its programs, and the work at one point.

Inputs are made before a task is yielded, so that they are not timed. Peers come from `bench.lib.peers`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import torch

from bench.lib import inputs, peers, roofline, training
from bench.lib.kernel_calls import adam_step, bin_tiles, blend, blend_channels, heaviest, median_depth, project
from bench.lib.pairs import binned, image_costs, instances_and_pairs
from bench.lib.points import Point
from bench.lib.timing import OURS, Task, passes
from warpgs import rasterize
from warpgs.constants import RULES
from warpgs.kernels.neighbours import camera_reach, mean_square_distances, pixel_size
from warpgs.kernels.ssim import ssim
from warpgs.kernels.sweep import best_inverses, plane_costs, scanline_costs
from warpgs.kernels.tsdf import integrate
from warpgs.kernels.update import Setting, begin_step, end_step, opacity_decay, opacity_dropout
from warpgs.priors.sweep import UNIT, step_limits
from warpgs.scene import Camera

Wanted = Callable[[str, str], bool]
"""Whether a direction of a program is measured."""
Tasks = Iterator[Task]
EXACT = RULES["exact"]
CAMERAS, PLANES = 32, 64
"""Cameras of `pixel_size` and `camera_reach`; planes of the depth sweep."""
LEARNING_RATE = 1e-12
"""Nearly zero, so that every repeat of a training step renders the same scene."""
NUMPY = "numpy"


@dataclass(frozen=True)
class Op:
    """One op of the bench."""

    tasks: Callable[[Point, torch.device, Wanted], Tasks]
    """Yields the wanted tasks at a point."""
    axes: tuple[str, ...]
    """Sizes that it depends on."""
    programs: dict[str, tuple[str, ...]] = field(default_factory=lambda: {OURS: ("forward",)})
    """Directions of each program."""
    largest: dict[str, int] = field(default_factory=dict)
    """Largest number of Gaussians for a peer."""


def _size(point: Point) -> dict[str, int]:
    return {"width": point.width, "height": point.height}


def project_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Project N Gaussians into cameras."""
    tensors = list(inputs.gaussians(point.count, device, point.degree).tensors().values())
    camera = inputs.camera(point.width, point.height, device, point.cameras)

    def work():
        return project(*tensors, camera.viewmat, camera.K, **_size(point), degree=point.degree, rule=EXACT)[0]

    yield from passes(OURS, work, tensors, wanted, roofline.project(point.count, point.cameras, point.degree))


def tiles_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Bin N Gaussians into tiles, both sorts included."""
    projected, counts, tiles = binned(point, device)
    cost = roofline.tiles(point.count, point.cameras, len(tiles.slots), len(tiles.ranges))

    def work():
        return bin_tiles(projected, counts, **_size(point), rule=EXACT)

    yield Task(OURS, "forward", work, cost, {"instances": len(tiles.slots)})


def blend_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Composite N binned Gaussians."""
    projected, _, tiles = binned(point, device)
    leaf, backgrounds = projected.detach().requires_grad_(), torch.zeros(point.cameras, 3, device=device)
    instances, pairs = instances_and_pairs(point, device)
    costs = roofline.blend(point.count, point.cameras, point.pixels, instances, pairs)

    def work():
        return blend(leaf, tiles, backgrounds, **_size(point), rule=EXACT)[0]

    yield from passes(OURS, work, [leaf], wanted, costs, {"instances": instances, "pairs": pairs})


def blend_channels_tasks(point: Point, device: torch.device, wanted: Wanted, channels: int = 32) -> Tasks:
    """Composite N binned Gaussians with 32 channels."""
    projected, _, tiles = binned(point, device)
    leaf, backgrounds = projected.detach().requires_grad_(), torch.zeros(point.cameras, channels, device=device)
    colors = torch.randn(1, point.count, channels, device=device).requires_grad_()

    def work():
        return blend_channels(leaf, tiles, colors, backgrounds, **_size(point), rule=EXACT)[0]

    yield from passes(OURS, work, [leaf, colors], wanted)


def heaviest_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Find the 8 heaviest of N binned Gaussians in each pixel."""
    projected, _, tiles = binned(point, device)
    yield Task(OURS, "forward", lambda: heaviest(projected, tiles, 8, **_size(point), rule=EXACT))


def median_depth_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Compute the median depth of N binned Gaussians."""
    projected, _, tiles = binned(point, device)
    yield Task(OURS, "forward", lambda: median_depth(projected, tiles, **_size(point), rule=EXACT))


def ssim_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Compute structural similarity, beside plain torch convolutions."""
    image = inputs.image(point.width, point.height, device).requires_grad_()
    target = inputs.image(point.width, point.height, device, seed=1)
    yield from passes(OURS, lambda: ssim(image, target), [image], wanted, roofline.ssim(point.pixels))
    yield from passes(peers.TORCH_SSIM, lambda: peers.torch_ssim(image, target), [image], wanted)


def adam_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Take one Adam step over the colour coefficients of N Gaussians, degree 3."""
    state = [torch.rand(point.count, 16, 3, device=device) for _ in range(4)]

    def work():
        adam_step(*state, lr=1e-3, step=10, head_lr=1e-2, head=3)

    yield Task(OURS, "forward", work, roofline.adam(state[0].numel()))


def step_buffers_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Read view and rates of a captured step, and store its result."""
    targets = inputs.image(point.width, point.height, device)[None]
    camera = inputs.camera(point.width, point.height, device)
    numbers = [torch.zeros(1, dtype=torch.int64, device=device), torch.zeros(100, dtype=torch.int64, device=device)]
    rows = [torch.zeros(100, n, device=device) for n in (15, 2)]
    stop, history, value = torch.ones(1, dtype=torch.int32, device=device), torch.zeros(100, 2, device=device), targets.mean()

    def work():
        step = begin_step(*numbers, *rows, camera.viewmat, camera.K, targets)
        end_step(value, value, numbers[0], stop, history)
        return step

    yield Task(OURS, "forward", work, roofline.buffers(point.pixels))


def dropout_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Sample the opacity factors of N Gaussians."""
    row = Setting.row(dropout=0.2, number=1, step=1, means_lr=0.0, shift=(0.0, 0.0, 0.0))
    settings = torch.tensor(row, dtype=torch.float32, device=device)
    yield Task(OURS, "forward", lambda: opacity_dropout(point.count, settings, 0), roofline.dropout(point.count))


def opacity_decay_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Decay N opacities."""
    logits = torch.randn(point.count, device=device)
    yield Task(OURS, "forward", lambda: opacity_decay(logits, 0.999), roofline.opacity_decay(point.count))


def pixel_size_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Compute the pixel sizes of 32 cameras at N Gaussians."""
    means, cameras = torch.randn(point.count, 3, device=device), torch.rand(CAMERAS, 9, device=device)
    yield Task(OURS, "forward", lambda: pixel_size(means, cameras, 0.4), roofline.pixel_size(point.count, CAMERAS))


def camera_reach_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Compute the largest sizes at which N Gaussians reach none of 32 cameras."""
    means, centers = torch.randn(point.count, 3, device=device), torch.randn(CAMERAS, 3, device=device)
    yield Task(OURS, "forward", lambda: camera_reach(means, centers, 1 / 3), roofline.camera_reach(point.count, CAMERAS))


def knn_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Find the three nearest neighbours of N points."""
    points = torch.randn(point.count, 3, generator=torch.Generator().manual_seed(0)).to(device)
    yield Task(OURS, "forward", lambda: mean_square_distances(points), roofline.knn(point.count))


def plane_costs_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Compute the matching costs of an image with four others, on a CPU."""
    gray = np.random.default_rng(0).random((point.height, point.width), np.float32)
    there = np.tile(np.eye(3), (PLANES, 4, 1, 1))
    there[..., 0, 2] = np.arange(PLANES)[:, None] / 2
    yield Task(OURS, "forward", lambda: plane_costs(gray, [(gray, None)] * 4, there, 7, 6e-5, 4096))


def plane_depths_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Choose the best plane of each pixel, on a CPU."""
    costs = torch.randint(0, 9999, (point.height, point.width, PLANES), dtype=torch.int16)
    inverses = np.linspace(0.1, 1, PLANES)
    yield Task(OURS, "forward", lambda: best_inverses(costs, inverses))


def numpy_path_costs(costs: np.ndarray, image: np.ndarray, small_step: float, large_step: float, *, down: bool) -> np.ndarray:
    """Return the sum of the path costs along columns or rows; numpy takes a line of pixels at a time."""
    total = np.zeros_like(costs)
    c, t, colors = (a if down else a.swapaxes(0, 1) for a in (costs, total, image))
    bounds, small = step_limits(colors, small_step, large_step), np.int16(round(small_step * UNIT))
    for order, edge in ((range(len(c)), -1), (range(len(c) - 1, -1, -1), 0)):
        path = None
        for k in order:
            if path is None:
                path = c[k].copy()
            else:
                lowest = path.min(1, keepdims=True)
                step = np.minimum(path, lowest + bounds[k + edge, :, None])
                path += small
                np.minimum(step[:, 1:], path[:, :-1], out=step[:, 1:])
                np.minimum(step[:, :-1], path[:, 1:], out=step[:, :-1])
                step -= lowest
                step += c[k]
                path = step
            t[k] += path
    return total


def scanlines_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Compute the path costs of an image's depth planes, beside numpy."""
    image = inputs.image(point.width, point.height, torch.device("cpu")).numpy()
    costs = np.random.default_rng(0).integers(0, UNIT + 1, (point.height, point.width, PLANES)).astype(np.int16)
    there = torch.from_numpy(costs).to(device)
    sides = (point.height - 1, point.width), (point.height, point.width - 1)
    bounds = [torch.full(side, UNIT // 2, dtype=torch.int32, device=device) for side in sides]
    yield Task(OURS, "forward", lambda: scanline_costs(there, *bounds, 123), roofline.scanlines(point.pixels, PLANES))
    if wanted(NUMPY, "forward"):
        yield Task(NUMPY, "forward", lambda: [numpy_path_costs(costs, image, 0.03, 0.5, down=down) for down in (True, False)])


def tsdf_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Add a depth map to a grid of N points."""
    camera = inputs.camera(point.width, point.height, device, 1)
    one = Camera(*(t[0].double().cpu().numpy() for t in (camera.viewmat, camera.K)), point.width, point.height)
    side = max(2, round(point.count ** (1 / 3)))
    depth = torch.full((point.height, point.width), 4.0, device=device)
    grid = depth.new_zeros(side, side, side), depth.new_zeros(side, side, side), (-2.0, -2.0, 2.0), 4.0 / side, 16.0 / side
    weights = torch.ones_like(depth)
    yield Task(OURS, "forward", lambda: integrate(*grid, one, depth, weights))


def render_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Render a whole image, forward and forward with backward, beside other rasterizers."""
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


def step_cost(point: Point, device: torch.device) -> roofline.Cost:
    """Return the cost of all stages together; the rest of the loss besides SSIM, a few bytes per pixel, is left out."""
    total = roofline.adam(point.count * (11 + 3 * (point.degree + 1) ** 2))
    for stage in (*image_costs(point, device), *roofline.ssim(point.pixels)):
        total += stage
    return total


def step_tasks(point: Point, device: torch.device, wanted: Wanted) -> Tasks:
    """Take a training step: rendering, photometric loss, backward pass, Adam over all parameters.

    The peer has the usual parts of trainers: gsplat's rendering, the loss in plain torch, torch's fused Adam.
    """
    gaussians = inputs.gaussians(point.count, device, point.degree)
    batch = inputs.camera(point.width, point.height, device)
    target = inputs.image(point.width, point.height, device)
    if wanted(OURS, "step"):
        steps = training.Steps(gaussians, batch, target, "exact", LEARNING_RATE)
        yield Task(OURS, "step", steps.eager, step_cost(point, device))
    if wanted(peers.GSPLAT_STEP, "step"):
        adam = torch.optim.Adam(gaussians.tensors().values(), lr=LEARNING_RATE, eps=1e-15, fused=True)

        def peer_step():
            image = peers.gsplat_rasterize(gaussians, batch)[0]
            structural = peers.torch_ssim(image, target).mean()
            ((image - target).abs().mean() * 0.8 + (1 - structural) * 0.2).backward()
            adam.step()
            adam.zero_grad(set_to_none=True)

        yield Task(peers.GSPLAT_STEP, "step", peer_step)


BOTH = {OURS: ("forward", "backward")}
BINNED = ("count", "image", "cameras")
OPS = {
    "project": Op(project_tasks, ("count", "degree", "cameras"), BOTH),
    "tiles": Op(tiles_tasks, BINNED),
    "blend": Op(blend_tasks, BINNED, BOTH),
    "ssim": Op(ssim_tasks, ("image",), BOTH | {peers.TORCH_SSIM: BOTH[OURS]}),
    "adam": Op(adam_tasks, ("count",)),
    "step_buffers": Op(step_buffers_tasks, ("image",)),
    "dropout": Op(dropout_tasks, ("count",)),
    "knn": Op(knn_tasks, ("count",)),
    "scanlines": Op(scanlines_tasks, ("image",), {OURS: ("forward",), NUMPY: ("forward",)}),
    "render": Op(
        render_tasks,
        ("count", "image", "degree", "cameras", "threads"),
        dict.fromkeys((OURS, *peers.RASTERIZERS), ("forward", "both")),
        {peers.DENSE: 1_000},
    ),
    "step": Op(step_tasks, ("count", "image", "degree", "threads"), dict.fromkeys((OURS, peers.GSPLAT_STEP), ("step",))),
    "blend_channels": Op(blend_channels_tasks, BINNED, BOTH),
    "heaviest": Op(heaviest_tasks, BINNED),
    "median_depth": Op(median_depth_tasks, BINNED),
    "opacity_decay": Op(opacity_decay_tasks, ("count",)),
    "pixel_size": Op(pixel_size_tasks, ("count",)),
    "camera_reach": Op(camera_reach_tasks, ("count",)),
    "plane_costs": Op(plane_costs_tasks, ("image",)),
    "plane_depths": Op(plane_depths_tasks, ("image",)),
    "tsdf": Op(tsdf_tasks, ("count", "image")),
}
"""All ops by name."""
DEFAULT = tuple(OPS)[: list(OPS).index("step") + 1]
"""Ops that are measured where none is named: those of docs/performance.md."""
