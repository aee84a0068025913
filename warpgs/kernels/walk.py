"""Walks along the rays over binned Gaussians: the median depth, the heaviest Gaussians, and the contributions."""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.kernels import blend_cuda, launch
from warpgs.kernels.blend import check_slots, composite, make_segments
from warpgs.kernels.ellipse import PROJECTED_SIZE
from warpgs.kernels.falloff import COLORS, STRIP, TOGETHER, Pass, make_batches, make_functions, make_struct
from warpgs.kernels.native import ROLLED, SCALE, Floats, IntRows, Ints, cuda_kernel, make_prefetch, source
from warpgs.kernels.tiles import Tiles

# These are separate passes, so that `blend` does not become slower. Alpha comes from the same operations as in `blend`, so that
# all agree exactly on what is blended.


@functools.cache
def make_walk(real, tile_size: int, make_visit):
    """Make the generic kernel, one task per tile; it calls a visitor for each blended (Gaussian, pixel)."""
    f, visit = make_functions(real), make_visit(real)
    Reals, Rows = wp.array(dtype=real), wp.array2d(dtype=real)
    tile_reals, strip_reals = (wp.types.vector(n, real) for n in (tile_size * (tile_size + 1), STRIP))
    side, strip, parts = tile_size, STRIP, tile_size // STRIP

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def walk(
        begin: int, settings: f.Blending, projected: Rows, ranges: IntRows, gaussian_ids: Ints, per_camera: int, k: int,
        # outputs of the visitor
        reals: Reals, ids: Ints, counts: Ints,
    ):  # fmt: skip
        tile = begin + wp.tid()
        camera, left, top = f.place_of(tile, side, settings)
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
            # values of its own, since the visitor's stores might change the array for all that the compiler knows
            mx = real(projected[i, 0])
            my = real(projected[i, 1])
            u11 = real(projected[i, 2])
            u12 = real(projected[i, 3])
            u22 = real(projected[i, 4])
            opacity = real(projected[i, 5])
            depth = real(projected[i, 9])
            bounds = f.bounds_of(mx, my, u11, u22, projected[i, 10], projected[i, 11], settings.whole_tiles)
            for lane in range(strip):
                ramp[lane] = f.apart(u11 * real(lane))
            for row in range(side):
                dy = real(settings.origin_y + top + row) + real(0.5) - my
                e2 = u22 * dy
                e12 = f.apart(u12 * dy)
                e22 = f.apart(e2 * e2)
                for part in range(parts):
                    x = real(settings.origin_x + left + part * strip) + real(0.5)
                    start = f.apart(u11 * (x - mx)) + e12
                    if f.reaches(start, u11, e22, bounds[0], bounds[1]):
                        for lane in range(strip):
                            p = row * side + part * strip + lane
                            e1 = start + ramp[lane]
                            alpha = wp.min(settings.alpha_max, opacity * f.falloff(e1 * e1 + e22))
                            if alpha >= settings.alpha_cut and t[p] > real(0.0):
                                after = t[p] * (real(1.0) - alpha)
                                finished = after < settings.stop
                                if settings.inclusive != 0 or not finished:
                                    pixel = (camera * settings.height + top + row) * settings.width + left + part * strip + lane
                                    ended = visit(
                                        pixel, i - camera * per_camera, alpha * t[p], after, depth, k, reals, ids, counts
                                    )
                                    finished = finished or ended
                                t[p] = wp.where(finished, real(0.0), after)
                                unfinished -= wp.where(finished, 1, 0)
            instance += 1

    return walk


@functools.cache
def make_median(real):
    """Make the visitor that writes the depth at which a pixel has lost half of its light, and finishes the pixel there."""
    Reals = wp.array(dtype=real)

    @wp.func(inline=True)
    def visit(
        pixel: int, i: int, weight: real, after: real, depth: real, k: int, depths: Reals, ids: Ints, counts: Ints
    ) -> bool:
        if after <= real(0.5):
            depths[pixel] = depth
        return after <= real(0.5)

    return visit


@functools.cache
def make_heaviest(real):
    """Make the visitor that puts a Gaussian into its pixel's sorted list of k, behind those of equal weight."""
    Reals = wp.array(dtype=real)

    @wp.func(inline=True)
    def visit(
        pixel: int, i: int, weight: real, after: real, depth: real, k: int, weights: Reals, ids: Ints, counts: Ints
    ) -> bool:
        counts[pixel] += 1
        first = pixel * k
        if weight > weights[first + k - 1]:
            j = first + k - 1
            while j > first and weights[j - 1] < weight:
                weights[j] = weights[j - 1]
                ids[j] = ids[j - 1]
                j -= 1
            weights[j] = weight
            ids[j] = i
        return False

    return visit


@functools.cache
def make_weights(real, tile_size: int):
    """Make the kernel of `contributions`, one task per tile; its loops over a strip have no branch, so that they vectorise."""
    f, b, Rows = make_functions(real), make_batches(real, tile_size, COLORS), wp.array2d(dtype=real)
    tile_reals, strip_reals = (wp.types.vector(n, real) for n in (tile_size * (tile_size + 1), STRIP))
    at, prefetch, ahead = b.at, make_prefetch(real, 2), TOGETHER
    side, strip, parts, outside = tile_size, STRIP, tile_size // STRIP, real(-1.0)

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def weigh(
        begin: int, settings: f.Blending, projected: Rows, ranges: IntRows, gaussian_ids: Ints, slots: Ints,
        # outputs: sum and maximum of each instance
        weights: Rows,
    ):  # fmt: skip
        tile = begin + wp.tid()
        _camera, left, top = f.place_of(tile, side, settings)
        t = tile_reals()  # falls below the stop once a pixel is finished
        for row in range(side):
            for column in range(side):
                inside = left + column < settings.width and top + row < settings.height
                t[row * side + column] = wp.where(inside, real(1.0), outside)
        left += settings.origin_x
        top += settings.origin_y
        sums = strip_reals()
        maxima = strip_reals()
        rows = b.Rows()
        falloffs = b.column_reals()  # of a column of strips
        left_open = int(1)
        instance = ranges[tile, 0]
        while instance < ranges[tile, 1] and left_open > 0:
            later = wp.min(instance + ahead, gaussian_ids.shape[0] - 1)
            prefetch(projected, gaussian_ids[later])
            prefetch(weights, slots[later])
            i = gaussian_ids[instance]
            mx = projected[i, 0]
            my = projected[i, 1]
            u11 = projected[i, 2]
            u12 = projected[i, 3]
            u22 = projected[i, 4]
            opacity = projected[i, 5]
            bounds = f.bounds_of(mx, my, u11, u22, projected[i, 10], projected[i, 11], settings.whole_tiles)
            for lane in range(strip):
                sums[lane] = real(0.0)
                maxima[lane] = real(0.0)
            b.find_row_values(my, u11, u12, u22, top, rows)
            for part in range(parts):
                at_left = f.apart(u11 * (real(left + part * strip) + real(0.5) - mx))
                first = int(side)
                end = int(0)
                for row in range(side):
                    hit = f.reaches(at_left + at(rows.e12[row]), u11, at(rows.e22[row]), bounds[0], bounds[1])
                    first = wp.min(first, wp.where(hit, row, side))
                    end = wp.max(end, wp.where(hit, row + 1, 0))
                b.find_falloffs(at_left, first, end, rows, falloffs)
                k = int(0)
                while k < end - first:
                    base = wp.max((first + k) * side + part * strip, 0)
                    o = wp.max(k * strip, 0)
                    k += 1
                    for lane in range(strip):
                        raw = opacity * falloffs[o + lane]
                        alpha = wp.where(settings.alpha_max < raw, settings.alpha_max, raw)
                        alpha = wp.where(alpha >= settings.alpha_cut, alpha, real(0.0))
                        before = t[base + lane]
                        after = before * (real(1.0) - alpha)
                        blended = wp.where(settings.inclusive != 0, before, after) >= settings.stop
                        weight = wp.where(blended, alpha * before, real(0.0))
                        t[base + lane] = after
                        sums[lane] = sums[lane] + weight
                        maxima[lane] = wp.max(maxima[lane], weight)
            total = real(0.0)
            largest = real(0.0)
            for lane in range(strip):
                total += sums[lane]
                largest = wp.max(largest, maxima[lane])
            slot = slots[instance]
            weights[slot, 0] = total
            weights[slot, 1] = largest
            instance += 1
            if instance % ahead == 0:
                left_open = int(0)
                for row in range(side):
                    base = wp.max(row * side, 0)
                    for column in range(side):
                        left_open += wp.where(t[base + column] >= settings.stop, 1, 0)

    return weigh


@functools.cache
def make_native(tile_size: int):
    """Make the CUDA kernels in float32 for one tile size, a thread block per tile."""
    Blending = make_struct(wp.float32)
    numbers = {"SIDE": tile_size, "SCALE": SCALE, "STRIDE": PROJECTED_SIZE}
    tile = f"wp.tid() // {tile_size * tile_size}"

    def walk(
        tile: int, settings: Blending, projected: Floats, ranges: Ints, gaussian_ids: Ints, per_camera: int, k: int,
        # outputs
        reals: Floats, ids: Ints, counts: Ints,
    ): ...  # fmt: skip

    return SimpleNamespace(
        median=cuda_kernel(source("median_depth.cu", **numbers), tile, f"warpgs.kernels.median_depth.{tile_size}")(walk),
        heaviest=cuda_kernel(source("heaviest.cu", **numbers), tile, f"warpgs.kernels.heaviest.{tile_size}")(walk),
    )


def _walk(make_visit, projected: torch.Tensor, tiles: Tiles, settings: Pass, k: int, *outputs: torch.Tensor) -> None:
    """Launch the kernel of a visitor over projected Gaussians [C, N, 12]; outputs may be fewer than its three."""
    real, device, count, pixels = launch.real_of(projected), projected.device, len(tiles.ranges), tiles.size * tiles.size
    inputs = [settings.struct(tiles.size, real), projected, tiles.ranges, tiles.gaussian_ids, projected.shape[1], k, *outputs]
    inputs += [tiles.ranges.new_empty(0)] * (3 - len(outputs))
    if launch.is_native(projected):
        kernels = make_native(tiles.size)
        launch.launch(kernels.heaviest if k else kernels.median, count * pixels, inputs, device, block_dim=pixels)
    else:
        launch.launch(make_walk(real, tiles.size, make_visit), count, inputs, device, cost=10_000, block_dim=32)


def median_depth(projected: torch.Tensor, tiles: Tiles, settings: Pass) -> torch.Tensor:
    """Return the depth [u] of the Gaussian at which a pixel's transmittance falls to 1/2 or below, else 0, [C, H, W]."""
    # This is the weighted median of depth; the background has the rest of the weight. At an edge it does not mix both surfaces,
    # unlike the mean depth of `blend`. Not differentiable. Results repeat bit for bit with any number of threads.
    projected = projected.detach().contiguous()
    depths = projected.new_zeros(len(projected), *settings.window[:1:-1])
    _walk(make_median, projected, tiles, settings, 0, depths)
    return depths


def heaviest(projected: torch.Tensor, tiles: Tiles, k: int, settings: Pass) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return ids [C, H, W, k] of the Gaussians of largest weight alpha * T in each pixel, the weights, and counts [C, H, W]."""
    # Heaviest first; equal weights nearest first; id -1 with weight 0 where fewer than k have a weight. The count is of all
    # that were blended. Not differentiable. Results repeat bit for bit with any number of threads.
    projected = projected.detach().contiguous()
    shape = len(projected), *settings.window[:1:-1]
    weights = projected.new_zeros(*shape, k)
    ids = torch.full((*shape, k), -1, dtype=torch.int32, device=projected.device)
    counts = torch.zeros(shape, dtype=torch.int32, device=projected.device)
    _walk(make_heaviest, projected, tiles, settings, k, weights, ids, counts)
    return ids, weights, counts


def contributions(projected: torch.Tensor, tiles: Tiles, settings: Pass) -> tuple[torch.Tensor, torch.Tensor]:
    """Return sum and maximum of each Gaussian's blending weights alpha * T over pixels, [C, N] each. Not differentiable."""
    check_slots(tiles)
    projected = projected.detach().contiguous()
    weights = projected.new_zeros(len(tiles.slots), 2)
    if launch.is_native(projected):
        ends = composite(projected, tiles, projected.new_zeros(len(projected), 3), settings, save=False)[5]
        blend_cuda.instance_weights(projected, tiles, settings, ends, weights)
    else:
        real = launch.real_of(projected)
        inputs = [settings.struct(tiles.size, real), projected, tiles.ranges, tiles.gaussian_ids, tiles.slots, weights]
        launch.launch(make_weights(real, tiles.size), len(tiles.ranges), inputs, projected.device, cost=10_000, block_dim=32)
    sums, maxima = projected.new_empty(projected.shape[:2]), projected.new_empty(projected.shape[:2])
    kernel = make_segments(launch.real_of(projected)).gather_weights
    launch.launch(kernel, len(tiles.counts), [weights, tiles.starts, tiles.counts, sums, maxima], projected.device)
    return sums, maxima
