"""Walks along the rays: the median depth, and the Gaussian with the largest weight."""

import functools

import torch
import warp as wp

from warpgs.constants import Rule
from warpgs.kernels import launch
from warpgs.kernels.blend import check_tiles, is_native, tile_inputs
from warpgs.kernels.blend_cuda import SCALE
from warpgs.kernels.ellipse import PROJECTED_SIZE
from warpgs.kernels.falloff import STRIP, Pass, make_functions, make_struct
from warpgs.kernels.native import ROLLED, source
from warpgs.kernels.tiles import Tiles

# Median depth of binned Gaussians: where the transmittance of a pixel falls to one half.
#
# This is a separate pass, so that `blend` does not become slower. The pass over a tile ends as soon as each pixel is
# half covered. It computes alpha by the same operations as `blend`, so that both agree exactly on the Gaussian at which
# a pixel becomes half covered.


@functools.cache
def make_median_kernel(real, tile_size: int):
    """Make the generic kernel, one task per tile, for one scalar type and tile size."""
    f = make_functions(real)
    tile_reals = wp.types.vector(tile_size * tile_size, real)
    strip_reals = wp.types.vector(STRIP, real)
    side = wp.constant(tile_size)
    strip = wp.constant(STRIP)
    parts = wp.constant(tile_size // STRIP)
    half = wp.constant(real(0.5))

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def median(
        begin: int, settings: f.Blending, projected: wp.array2d(dtype=real), ranges: wp.array2d(dtype=int),
        gaussian_ids: wp.array(dtype=int),
        # outputs
        depths: wp.array(dtype=real),
    ):  # fmt: skip
        tile = begin + wp.tid()
        place = f.place_of(tile, side, settings)
        camera = place[0]
        left = place[1]
        top = place[2]
        rows = wp.min(side, settings.height - top)
        lanes = wp.min(side, settings.width - left)
        ramp = strip_reals()
        found = tile_reals()
        t = tile_reals()  # transmittance; 0 once a pixel is finished, and outside the image
        for row in range(rows):
            for lane in range(lanes):
                t[row * side + lane] = real(1.0)
        unfinished = rows * lanes
        instance = ranges[tile, 0]
        while instance < ranges[tile, 1] and unfinished > 0:
            i = gaussian_ids[instance]
            instance += 1
            u11 = projected[i, 2]
            bounds = f.bounds_of(
                projected[i, 0], projected[i, 1], u11, projected[i, 4], projected[i, 10], projected[i, 11], settings.whole_tiles
            )
            for lane in range(strip):
                ramp[lane] = f.apart(u11 * real(lane))
            for row in range(side):
                dy = real(settings.origin_y + top + row) + real(0.5) - projected[i, 1]
                e2 = projected[i, 4] * dy
                e12 = f.apart(projected[i, 3] * dy)
                e22 = f.apart(e2 * e2)
                for part in range(parts):
                    x = real(settings.origin_x + left + part * strip) + real(0.5)
                    start = f.apart(u11 * (x - projected[i, 0])) + e12
                    if f.reaches(start, u11, e22, bounds[0], bounds[1]):
                        for lane in range(strip):
                            p = row * side + part * strip + lane
                            e1 = start + ramp[lane]
                            alpha = wp.min(settings.alpha_max, projected[i, 5] * f.falloff(e1 * e1 + e22))
                            if alpha >= settings.alpha_cut and t[p] > real(0.0):
                                after = t[p] * (real(1.0) - alpha)
                                blended = settings.inclusive != 0 or after >= settings.stop
                                if blended and after <= half:
                                    found[p] = projected[i, 9]
                                finished = after <= half or after < settings.stop
                                t[p] = wp.where(finished, real(0.0), after)
                                unfinished -= wp.where(finished, 1, 0)
        for row in range(rows):
            for lane in range(lanes):
                depths[(camera * settings.height + top + row) * settings.width + left + lane] = found[row * side + lane]

    return median


@functools.cache
def make_median_native(tile_size: int):
    """Make the CUDA kernel in float32 for one tile size, a thread block per tile."""
    Blending = make_struct(wp.float32)

    @wp.func_native(source("median_depth.cu", SIDE=tile_size, SCALE=SCALE, STRIDE=PROJECTED_SIZE))
    def body(
        tile: int, settings: Blending, projected: wp.array(dtype=float), ranges: wp.array(dtype=int),
        gaussian_ids: wp.array(dtype=int), depths: wp.array(dtype=float),
    ): ...  # fmt: skip

    threads = wp.constant(tile_size * tile_size)

    @wp.kernel(enable_backward=False, grid_stride=False, module=f"warpgs.kernels.median_depth.{tile_size}")
    def median(
        begin: int, settings: Blending, projected: wp.array(dtype=float), ranges: wp.array(dtype=int),
        gaussian_ids: wp.array(dtype=int),
        # outputs
        depths: wp.array(dtype=float),
    ):  # fmt: skip
        body(
            wp.tid() // threads, settings, projected, ranges, gaussian_ids, depths,
        )  # fmt: skip

    return median


def median_depth(
    projected: torch.Tensor, tiles: Tiles, *, width: int, height: int, rule: Rule, origin: tuple[int, int] = (0, 0)
) -> torch.Tensor:
    """Return the depth of the Gaussian at which a pixel's transmittance falls to one half or below. Not differentiable.

    This is the weighted median of depth; the weights are those of blending, and the background has the rest. At an edge it does
    not mix both surfaces, unlike the mean depth of `blend`. A pixel has no median depth if its alpha in `blend` is below 1/2.
    Results repeat bit for bit with any number of threads.

    Args:
        projected: Projected Gaussians of `project`, shape [C, N, 12].
        tiles: Result of `bin_tiles` for the same image size.
        width: Image width [px].
        height: Image height [px].
        rule: Cut-offs.
        origin: Left and top [px] of the window that the tiles were made for.

    Returns:
        Depth of the Gaussian's mean [u] (z; the distance for a fisheye), 0 where alpha is below 1/2, shape [C, H, W].

    Raises:
        TypeError: The scalar type is neither float32 nor float64.
        ValueError: A shape disagrees, or the tiles belong to another image size.
    """
    check_tiles(projected, tiles, width, height)
    projected = projected.detach().contiguous()
    real, device = launch.real_of(projected), projected.device
    settings, count = Pass((width, height), (*origin, width, height), rule), len(tiles.ranges)
    depths = projected.new_empty(len(projected), height, width)
    own, output = settings.struct(tiles.size, real), launch.flat(depths, real)
    native = projected.is_cuda and projected.dtype == torch.float32
    if native:
        lists = [launch.flat(t, wp.int32) for t in (tiles.ranges, tiles.gaussian_ids)]
        inputs, pixels = [own, launch.flat(projected, real), *lists, output], tiles.size * tiles.size
        launch.launch(make_median_native(tiles.size), count * pixels, inputs, device, block_dim=pixels)
        return depths
    inputs = [own, *tile_inputs(projected, tiles, real), output]
    launch.launch(make_median_kernel(real, tiles.size), count, inputs, device, cost=10_000, block_dim=32)
    return depths


# The k heaviest Gaussians of each pixel with their blending weights, and the number of Gaussians that were blended.
#
# This is a separate pass, so that `blend` does not become slower. It computes alpha by the same operations as `blend`.
# The list of a pixel is kept sorted in the result itself. A Gaussian is inserted if it is heavier than the k-th entry
# of the list.


@functools.cache
def make_heaviest_kernel(real, tile_size: int):
    """Make the generic kernel, one task per tile, for one scalar type and tile size."""
    f = make_functions(real)
    tile_reals = wp.types.vector(tile_size * tile_size, real)
    strip_reals = wp.types.vector(STRIP, real)
    side = wp.constant(tile_size)
    strip = wp.constant(STRIP)
    parts = wp.constant(tile_size // STRIP)

    @wp.func
    def insert(
        weight: real, i: wp.int32, first: wp.int32, k: wp.int32, weights: wp.array(dtype=real), ids: wp.array(dtype=wp.int32)
    ):
        """Put a Gaussian into the list of k that begins at ``first``, behind those of equal weight."""
        if weight > weights[first + k - 1]:
            j = first + k - 1
            while j > first and weights[j - 1] < weight:
                weights[j] = weights[j - 1]
                ids[j] = ids[j - 1]
                j -= 1
            weights[j] = weight
            ids[j] = i

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def heaviest(
        begin: int, settings: f.Blending, projected: wp.array2d(dtype=real), ranges: wp.array2d(dtype=int),
        gaussian_ids: wp.array(dtype=int), per_camera: int, k: int,
        # outputs
        weights: wp.array(dtype=real), ids: wp.array(dtype=int), counts: wp.array(dtype=int),
    ):  # fmt: skip
        tile = begin + wp.tid()
        place = f.place_of(tile, side, settings)
        camera = place[0]
        left = place[1]
        top = place[2]
        rows = wp.min(side, settings.height - top)
        lanes = wp.min(side, settings.width - left)
        ramp = strip_reals()
        t = tile_reals()  # transmittance; 0 once a pixel is finished, and outside the image
        for row in range(rows):
            for lane in range(lanes):
                t[row * side + lane] = real(1.0)
        unfinished = rows * lanes
        instance = ranges[tile, 0]
        while instance < ranges[tile, 1] and unfinished > 0:
            i = gaussian_ids[instance]
            instance += 1
            u11 = projected[i, 2]
            bounds = f.bounds_of(
                projected[i, 0], projected[i, 1], u11, projected[i, 4], projected[i, 10], projected[i, 11], settings.whole_tiles
            )
            for lane in range(strip):
                ramp[lane] = f.apart(u11 * real(lane))
            for row in range(side):
                dy = real(settings.origin_y + top + row) + real(0.5) - projected[i, 1]
                e2 = projected[i, 4] * dy
                e12 = f.apart(projected[i, 3] * dy)
                e22 = f.apart(e2 * e2)
                for part in range(parts):
                    x = real(settings.origin_x + left + part * strip) + real(0.5)
                    start = f.apart(u11 * (x - projected[i, 0])) + e12
                    if f.reaches(start, u11, e22, bounds[0], bounds[1]):
                        for lane in range(strip):
                            p = row * side + part * strip + lane
                            e1 = start + ramp[lane]
                            alpha = wp.min(settings.alpha_max, projected[i, 5] * f.falloff(e1 * e1 + e22))
                            if alpha >= settings.alpha_cut and t[p] > real(0.0):
                                after = t[p] * (real(1.0) - alpha)
                                if settings.inclusive != 0 or after >= settings.stop:
                                    pixel = (camera * settings.height + top + row) * settings.width + left + part * strip + lane
                                    counts[pixel] += 1
                                    insert(alpha * t[p], i - camera * per_camera, pixel * k, k, weights, ids)
                                finished = after < settings.stop
                                t[p] = wp.where(finished, real(0.0), after)
                                unfinished -= wp.where(finished, 1, 0)

    return heaviest


@functools.cache
def make_heaviest_native(tile_size: int):
    """Make the CUDA kernel in float32 for one tile size, a thread block per tile."""
    Blending = make_struct(wp.float32)

    @wp.func_native(source("heaviest.cu", SIDE=tile_size, SCALE=SCALE, STRIDE=PROJECTED_SIZE))
    def body(
        tile: int, settings: Blending, projected: wp.array(dtype=float), ranges: wp.array(dtype=int),
        gaussian_ids: wp.array(dtype=int), per_camera: int, k: int, weights: wp.array(dtype=float), ids: wp.array(dtype=int),
        counts: wp.array(dtype=int),
    ): ...  # fmt: skip

    threads = wp.constant(tile_size * tile_size)

    @wp.kernel(enable_backward=False, grid_stride=False, module=f"warpgs.kernels.heaviest.{tile_size}")
    def heaviest(
        begin: int, settings: Blending, projected: wp.array(dtype=float), ranges: wp.array(dtype=int),
        gaussian_ids: wp.array(dtype=int), per_camera: int, k: int,
        # outputs
        weights: wp.array(dtype=float), ids: wp.array(dtype=int), counts: wp.array(dtype=int),
    ):  # fmt: skip
        body(
            wp.tid() // threads, settings, projected, ranges, gaussian_ids, per_camera, k, weights, ids, counts,
        )  # fmt: skip

    return heaviest


def heaviest(
    projected: torch.Tensor, tiles: Tiles, k: int, *, width: int, height: int, rule: Rule, origin: tuple[int, int] = (0, 0)
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return the k Gaussians of largest blending weight alpha * T in each pixel, heaviest first; equal weights nearest first.

    Not differentiable. Results repeat bit for bit with any number of threads.

    Args:
        projected: Projected Gaussians of `project`, shape [C, N, 12].
        tiles: Result of `bin_tiles` for the same image size.
        k: Number of Gaussians, at least 1.
        width: Image width [px].
        height: Image height [px].
        rule: Cut-offs.
        origin: Left and top [px] of the window that the tiles were made for.

    Returns:
        Ids of Gaussians from 0 to N - 1, int32, shape [C, H, W, k]; weights, shape [C, H, W, k]; and the number of blended
        Gaussians, int32, shape [C, H, W]. If fewer than k Gaussians have a weight above 0, the other ids are -1, with weight 0.

    Raises:
        TypeError: The scalar type is neither float32 nor float64.
        ValueError: A shape disagrees, the tiles belong to another image size, or ``k`` is below 1.
    """
    check_tiles(projected, tiles, width, height)
    if k < 1:
        raise ValueError(f"the number of heaviest Gaussians must be at least 1, not {k}")
    projected = projected.detach().contiguous()
    real, device, (cameras, per_camera) = launch.real_of(projected), projected.device, projected.shape[:2]
    settings, shape = Pass((width, height), (*origin, width, height), rule), (cameras, height, width)
    weights = projected.new_zeros(*shape, k)
    ids = torch.full((*shape, k), -1, dtype=torch.int32, device=device)
    counts = torch.zeros(shape, dtype=torch.int32, device=device)
    outputs = [launch.flat(weights, real), *(launch.flat(t, wp.int32) for t in (ids, counts))]
    own, rest = settings.struct(tiles.size, real), [per_camera, k, *outputs]
    if is_native(projected):
        lists = [launch.flat(t, wp.int32) for t in (tiles.ranges, tiles.gaussian_ids)]
        inputs, pixels = [own, launch.flat(projected, real), *lists, *rest], tiles.size * tiles.size
        launch.launch(make_heaviest_native(tiles.size), len(tiles.ranges) * pixels, inputs, device, block_dim=pixels)
    else:
        inputs = [own, *tile_inputs(projected, tiles, real), *rest]
        launch.launch(make_heaviest_kernel(real, tiles.size), len(tiles.ranges), inputs, device, cost=10_000, block_dim=32)
    return ids, weights, counts
