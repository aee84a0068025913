"""The kernel in plain Warp that sums the blending weights of each (Gaussian, tile) instance; used on CPUs, and for float64."""

import functools

import warp as wp

from warpgs.kernels.compiler import ROLLED
from warpgs.kernels.falloff import STRIP, make_functions


@functools.cache
def make_contributions(real, tile_size: int):
    """Make the contribution kernel for one scalar type and tile size."""
    f = make_functions(real)
    tile_reals = wp.types.vector(tile_size * (tile_size + 1), real)
    tile_ints = wp.types.vector(tile_size * (tile_size + 1), wp.int32)
    strip_reals = wp.types.vector(STRIP, real)
    side = wp.constant(tile_size)
    strip = wp.constant(STRIP)
    parts = wp.constant(tile_size // STRIP)

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def contributions(
        begin: int, settings: f.Blending, projected: wp.array2d(dtype=real), ranges: wp.array2d(dtype=int),
        gaussian_ids: wp.array(dtype=int), slots: wp.array(dtype=int), ends: wp.array(dtype=int),
        # outputs, zero on entry: sum and maximum of the weight of each instance
        weights: wp.array2d(dtype=real),
    ):  # fmt: skip
        tile = begin + wp.tid()
        place = f.place_of(tile, side, settings)
        camera = place[0]
        left = place[1]
        top = place[2]
        ramp = strip_reals()
        t = tile_reals()
        end = tile_ints()
        last = int(0)
        for row in range(wp.min(side, settings.height - top)):
            for lane in range(wp.min(side, settings.width - left)):
                p = row * side + lane
                t[p] = real(1.0)
                end[p] = ends[(camera * settings.height + top + row) * settings.width + left + lane]
                last = wp.max(last, end[p])
        for instance in range(ranges[tile, 0], last):
            i = gaussian_ids[instance]
            u11 = projected[i, 2]
            bounds = f.bounds_of(
                projected[i, 0], projected[i, 1], u11, projected[i, 4], projected[i, 10], projected[i, 11], settings.whole_tiles
            )
            for lane in range(strip):
                ramp[lane] = f.apart(u11 * real(lane))
            weight_sum = real(0.0)
            weight_max = real(0.0)
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
                            if alpha >= settings.alpha_cut and instance < end[p]:
                                w = alpha * t[p]
                                t[p] = t[p] * (real(1.0) - alpha)
                                weight_sum += w
                                weight_max = wp.max(weight_max, w)
            weights[slots[instance], 0] = weight_sum
            weights[slots[instance], 1] = weight_max

    return contributions
