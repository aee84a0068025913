"""Number of (Gaussian, pixel) pairs of an image: the least work of any blending."""

from __future__ import annotations

import functools

import torch
import warp as wp

from bench.lib import inputs, roofline
from bench.lib.kernel_calls import bin_tiles, blend, project
from bench.lib.points import Point
from warpgs.constants import RULES, Rule
from warpgs.kernels import launch
from warpgs.kernels.tiles import Tiles


@wp.kernel(enable_backward=False)
def count_drawn(
    begin: int, projected: wp.array2d(dtype=float), ranges: wp.array2d(dtype=int), ids: wp.array(dtype=int),
    ends: wp.array(dtype=int), width: int, height: int, columns: int, tiles: int, side: int, alpha_cut: float,
    # outputs
    drawn: wp.array(dtype=int),
):  # fmt: skip
    pixel = begin + wp.tid()
    x = pixel % width
    y = (pixel // width) % height
    tile = (pixel // (width * height)) * tiles + (y // side) * columns + x // side
    count = int(0)
    for instance in range(ranges[tile, 0], ends[pixel]):
        i = ids[instance]
        dx = float(x) + 0.5 - projected[i, 0]
        dy = float(y) + 0.5 - projected[i, 1]
        e1 = projected[i, 2] * dx + projected[i, 3] * dy
        e2 = projected[i, 4] * dy
        if projected[i, 5] * wp.exp(-0.5 * (e1 * e1 + e2 * e2)) >= alpha_cut:
            count += 1
    drawn[pixel] = count


def drawn_pairs(projected: torch.Tensor, tiles: Tiles, width: int, height: int, rule: Rule) -> int:
    """Return the pairs blended into images of records [C, N, 12]: those of alpha at or above the cut in unfinished pixels."""
    background = projected.new_zeros(len(projected), 3)
    rgb = blend(projected.detach().requires_grad_(), tiles, background, width=width, height=height, rule=rule)[0]
    # one past the last instance each pixel blended: the only whole numbers by pixel that are kept
    ends = next(t for t in rgb.grad_fn.saved_tensors if t is not None and t.dtype == torch.int32 and t.shape == rgb.shape[:3])
    columns, rows = -(-width // tiles.size), -(-height // tiles.size)
    drawn = torch.empty(ends.numel(), dtype=torch.int32, device=projected.device)
    with launch.stream_of(projected.device):
        arguments = [
            projected.reshape(-1, projected.shape[-1]), tiles.ranges,
            tiles.gaussian_ids, ends.reshape(-1),
            width, height, columns, columns * rows, tiles.size, rule.alpha_cut, drawn,
        ]  # fmt: skip
        launch.launch(count_drawn, len(drawn), arguments, projected.device, cost=100)
    return int(drawn.sum(dtype=torch.int64))


def binned(point: Point, device: torch.device) -> tuple[torch.Tensor, torch.Tensor, Tiles]:
    """Return the projected Gaussians of the bench's cloud at a point, their tile counts and their tiles, rule `exact`."""
    how = {"width": point.width, "height": point.height, "rule": RULES["exact"]}
    with torch.no_grad():
        tensors = inputs.gaussians(point.count, device, 0).tensors().values()
        camera = inputs.camera(point.width, point.height, device, point.cameras)
        projected, counts = project(*tensors, camera.viewmat, camera.K, degree=0, **how)
        return projected, counts, bin_tiles(projected, counts, **how)


@functools.lru_cache(maxsize=64)
def instances_and_pairs(point: Point, device: torch.device) -> tuple[int, int]:
    """Return (Gaussian, tile) instances and drawn pairs of the bench's cloud at a point, rule `exact`."""
    projected, _, tiles = binned(point, device)
    return len(tiles.slots), drawn_pairs(projected, tiles, point.width, point.height, RULES["exact"])


def image_costs(point: Point, device: torch.device) -> tuple[roofline.Cost, roofline.Cost]:
    """Return the cost of projection, tiles and blending together, forward and backward."""
    instances, pairs = instances_and_pairs(point, device)
    tiles_in_all = point.cameras * -(-point.width // 16) * -(-point.height // 16)
    projection = roofline.project(point.count, point.cameras, point.degree)
    blending = roofline.blend(point.count, point.cameras, point.pixels, instances, pairs)
    lists = roofline.tiles(point.count, point.cameras, instances, tiles_in_all)
    return projection[0] + lists + blending[0], projection[1] + blending[1]
