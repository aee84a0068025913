"""Blending kernels in plain Warp, one task per tile; used on the CPU, and for float64 on every device.

A task cuts the rows of its tile into strips. The innermost loops run over the pixels of one strip without branches and are
kept rolled, so that the compiler vectorises them (docs/blend.md, section 5).
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.constants import SMALLEST_WEIGHT
from warpgs.kernels.blend_contributions import make_contributions
from warpgs.kernels.blend_cpu_backward import make_backward
from warpgs.kernels.blend_records import COLORS
from warpgs.kernels.compiler import ROLLED
from warpgs.kernels.falloff import ABREAST, STRIP, make_functions

BATCH = 64
"""Gaussians that the forward pass processes at a time, strip by strip; a power of 2, since BATCH - 1 masks indices."""
TOGETHER = 16
"""Gaussians of a batch that are tested together, in a loop that vectorises; divides `BATCH`."""


@functools.cache
def make_forward(real, tile_size: int, channels: int):
    """Make the forward kernel for one scalar type, tile size and number of channels."""
    f = make_functions(real)
    # Vectors rather than local arrays: the compiler must see that they do not overlap. They are one row longer than
    # the tile, so that they are not 4096 bytes apart: there a load of one would wait for a store to the other (4K aliasing).
    tile_reals = wp.types.vector(tile_size * (tile_size + 1), real)
    tile_ints = wp.types.vector(tile_size * (tile_size + 1), wp.int32)
    strip_reals = wp.types.vector(STRIP, real)
    strip_ints = wp.types.vector(STRIP, wp.int32)
    batch_reals = wp.types.vector(BATCH, real)
    batch_ints = wp.types.vector(BATCH, wp.int32)
    batch_strips = wp.types.vector(BATCH * STRIP, real)
    record = wp.types.vector(9 + channels, real)
    # of several channels, one after the other
    tile_channels = wp.types.vector(channels * tile_size * (tile_size + 1), real)
    strip_channels = wp.types.vector(2 * channels * STRIP, real)
    batch_channels = wp.types.vector(channels * BATCH, real)
    place_z = wp.constant(6 + channels)
    tile_stride = wp.constant(tile_size * (tile_size + 1))
    per_pixel = wp.constant(channels)
    per_row = wp.constant(channels * tile_size)
    side = wp.constant(tile_size)
    pixels = wp.constant(tile_size * tile_size)
    strip = wp.constant(STRIP)
    parts = wp.constant(tile_size // STRIP)
    abreast = wp.constant(ABREAST)
    batch = wp.constant(BATCH)
    bits = wp.constant(BATCH - 1)
    outside = wp.constant(real(-1.0))
    together = wp.constant(TOGETHER)
    smallest = wp.constant(real(SMALLEST_WEIGHT))

    # Loops over channels have a static length and are unrolled, so they are kept apart from loops that must stay rolled.
    @wp.func(inline=True)
    def at(entry: wp.ref[real]) -> real:
        """Return an entry of a vector that is taken by reference; Warp would copy the vector otherwise."""
        return entry

    @wp.func(inline=True)
    def load_channels(projected: wp.array(dtype=record), i: wp.int32, j: wp.int32, color: wp.ref[batch_channels]):
        """Load the channels of a Gaussian of the batch."""
        for c in range(wp.static(channels)):
            color[c * batch + j] = projected[i][6 + c]

    @wp.func(inline=True)
    def load_strip(base: wp.int32, lane: wp.int32, sums: wp.ref[tile_channels], strip_sums: wp.ref[strip_channels]):
        """Load the sums of a pixel of a strip."""
        for c in range(wp.static(channels)):
            strip_sums[2 * c * strip + lane] = at(sums[c * tile_stride + base + lane])

    @wp.func(inline=True)
    def store_strip(base: wp.int32, lane: wp.int32, strip_sums: wp.ref[strip_channels], sums: wp.ref[tile_channels]):
        """Store the sums of a pixel of a strip."""
        for c in range(wp.static(channels)):
            sums[c * tile_stride + base + lane] = at(strip_sums[2 * c * strip + lane])

    @wp.func(inline=True)
    def add_channels(w: real, lane: wp.int32, j: wp.int32, color: wp.ref[batch_channels], strip_sums: wp.ref[strip_channels]):
        """Add the channels of a Gaussian to the sums of a pixel of a strip."""
        for c in range(wp.static(channels)):
            strip_sums[2 * c * strip + lane] = at(strip_sums[2 * c * strip + lane]) + w * at(color[c * batch + j])

    @wp.func(inline=True)
    def add_background(
        camera: wp.int32, p: wp.int32, t: real, backgrounds: wp.array2d(dtype=real), sums: wp.ref[tile_channels]
    ):
        """Add the background to the sums of a pixel."""
        for c in range(wp.static(channels)):
            sums[c * tile_stride + p] = at(sums[c * tile_stride + p]) + t * backgrounds[camera, c]

    @wp.func(inline=True)
    def join_channels(p: wp.int32, sums: wp.ref[tile_channels], joined: wp.ref[tile_channels]):
        """Put the channels of a pixel side by side."""
        for c in range(wp.static(channels)):
            joined[p * per_pixel + c] = at(sums[c * tile_stride + p])

    @wp.func(inline=True)
    def store_channels(o: wp.int32, p: wp.int32, joined: wp.ref[tile_channels], rgb: wp.array(dtype=real)):
        """Store the channels of a pixel, whose first has the index ``o``."""
        for c in range(wp.static(channels)):
            rgb[o + c] = at(joined[p * per_pixel + c])

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def forward(
        begin: int, settings: f.Blending, projected: wp.array(dtype=record), ranges: wp.array2d(dtype=int),
        gaussian_ids: wp.array(dtype=int), backgrounds: wp.array2d(dtype=real),
        # outputs, and the distance of pixels in the first
        rgb: wp.array(dtype=real), pitch: int, alpha_out: wp.array(dtype=real), depth: wp.array(dtype=real),
        transmittances: wp.array(dtype=real), weights: wp.array(dtype=real), ends: wp.array(dtype=int),
    ):  # fmt: skip
        tile = begin + wp.tid()
        place = f.place_of(tile, side, settings)
        camera = place[0]
        left = place[1]
        top = place[2]

        # The state of the tile: transmittance of what was blended, and of all that was visited, which falls below the stop once
        # the pixel is finished; sums; one past the last instance blended.
        t = tile_reals()
        passed = tile_reals()
        sums = tile_channels()
        z = tile_reals()
        total = tile_reals()
        end = tile_ints()
        for p in range(pixels):
            # pixels outside the image are finished before they begin
            inside = top + p // side < settings.height and left + p - (p // side) * side < settings.width
            t[p] = real(1.0)
            passed[p] = wp.where(inside, real(1.0), outside)
        # The same for one strip, in registers.
        strip_t = strip_reals()
        strip_passed = strip_reals()
        strip_sums = strip_channels()
        strip_z = strip_reals()
        strip_total = strip_reals()
        strip_end = strip_ints()
        # The Gaussians of a batch: values; u11 times the pixels of a strip; values shared in a row; those that reach a strip.
        mx = batch_reals()
        my = batch_reals()
        u11 = batch_reals()
        u12 = batch_reals()
        u22 = batch_reals()
        opacity = batch_reals()
        color = batch_channels()
        distance = batch_reals()
        aside = batch_reals()
        limit = batch_reals()
        ramp = batch_strips()
        e12 = batch_reals()
        e22 = batch_reals()
        start = batch_reals()
        hits = batch_ints()
        list = batch_ints()
        alphas = batch_strips()
        e1 = f.abreast()
        e2_squared = f.abreast()

        last = ranges[tile, 1]
        first = ranges[tile, 0]
        while first < last:
            count = wp.min(batch, last - first)
            j = int(0)
            while j < count:  # a loop of its own, so that many loads are under way at once
                i = gaussian_ids[wp.max(first + j, 0)]
                if i < 0:
                    break  # never true; a loop that may end early is not vectorised, which here avoids slow gathers
                mx[j & bits] = projected[i][0]
                j += 1
            for j in range(batch):
                limit[j] = real(-1.0)  # reaches nothing
            j = int(0)
            while j < count:
                i = gaussian_ids[wp.max(first + j, 0)]
                if i < 0:
                    break  # never
                my[j] = projected[i][1]
                u11[j] = projected[i][2]
                u12[j] = projected[i][3]
                u22[j] = projected[i][4]
                opacity[j] = projected[i][5]
                load_channels(projected, i, j, color)
                distance[j] = projected[i][place_z]
                bounds = f.bounds_of(
                    mx[j], my[j], u11[j], u22[j], projected[i][place_z + 1], projected[i][place_z + 2], settings.whole_tiles
                )
                aside[j] = bounds[0]
                limit[j] = bounds[1]
                j += 1
            j = int(0)
            while j < count:
                o = j & bits
                j += 1
                for lane in range(strip):
                    ramp[o * strip + lane] = f.apart(u11[o] * real(lane))
            left_open = int(0)
            for row in range(side):
                y = real(settings.origin_y + top + row) + real(0.5)
                group = int(0)
                while group < count:
                    o = group & bits
                    group += together
                    for lane in range(together):
                        dy = y - my[o + lane]
                        e2 = u22[o + lane] * dy
                        e12[o + lane] = f.apart(u12[o + lane] * dy)
                        e22[o + lane] = f.apart(e2 * e2)
                for part in range(parts):
                    base = wp.max(row * side + part * strip, 0)
                    strip_open = int(0)
                    for lane in range(strip):
                        strip_passed[lane] = passed[base + lane]
                        strip_open += wp.where(strip_passed[lane] >= settings.stop, 1, 0)
                    if strip_open > 0:
                        x = real(settings.origin_x + left + part * strip) + real(0.5)
                        group = int(0)
                        while group < count:
                            o = group & bits
                            group += together
                            for lane in range(together):
                                j = o + lane
                                start[j] = f.apart(u11[j] * (x - mx[j])) + e12[j]
                                hits[j] = wp.where(f.reaches(start[j], u11[j], e22[j], aside[j], limit[j]), 1, 0)
                        reaching = int(0)
                        group = int(0)
                        while group < count:
                            o = group & bits
                            group += together
                            for lane in range(together):  # no branch, since it would be mispredicted once for each Gaussian
                                list[reaching & bits] = o + lane
                                reaching += hits[o + lane]
                        k = int(0)
                        while k < reaching:
                            o = wp.max(k, 0)
                            k += abreast  # the last few may not reach the strip; their values are not read
                            for lane in range(strip):
                                for n in range(abreast):
                                    j = list[o + n] & bits
                                    e1[n] = start[j] + ramp[j * strip + lane]
                                    e2_squared[n] = e22[j]
                                g = f.falloffs(wp.cw_mul(e1, e1) + e2_squared)
                                for n in range(abreast):
                                    raw = opacity[list[o + n] & bits] * g[n]
                                    alpha = wp.where(settings.alpha_max < raw, settings.alpha_max, raw)
                                    alphas[(o + n) * strip + lane] = wp.where(alpha >= settings.alpha_cut, alpha, real(0.0))
                        for lane in range(strip):
                            strip_t[lane] = t[base + lane]
                            load_strip(base, lane, sums, strip_sums)
                            strip_z[lane] = z[base + lane]
                            strip_total[lane] = total[base + lane]
                            strip_end[lane] = end[base + lane]
                        k = int(0)
                        while k < reaching:
                            o = wp.max(k, 0)
                            k += 1
                            j = list[o] & bits
                            number = first + j + 1
                            for lane in range(strip):
                                alpha = alphas[o * strip + lane]
                                before = strip_passed[lane]
                                after = before * (real(1.0) - alpha)
                                # inclusive: blend, then stop; exclusive: stop instead of blending
                                blended = wp.where(settings.inclusive != 0, before, after) >= settings.stop
                                w = wp.where(blended, alpha, real(0.0)) * before
                                strip_t[lane] = wp.where(blended, after, strip_t[lane])
                                strip_passed[lane] = after
                                strip_end[lane] = wp.where(w > real(0.0), number, strip_end[lane])
                                add_channels(w, lane, j, color, strip_sums)
                                strip_z[lane] = strip_z[lane] + w * distance[j]
                                strip_total[lane] = strip_total[lane] + w
                        for lane in range(strip):
                            t[base + lane] = strip_t[lane]
                            passed[base + lane] = strip_passed[lane]
                            store_strip(base, lane, strip_sums, sums)
                            z[base + lane] = strip_z[lane]
                            total[base + lane] = strip_total[lane]
                            end[base + lane] = strip_end[lane]
                    left_open += strip_open
            first += batch
            if left_open == 0:
                first = last

        joined = tile_channels()
        for p in range(pixels):
            add_background(camera, p, t[p], backgrounds, sums)
            join_channels(p, sums, joined)
            z[p] = wp.where(total[p] >= smallest, z[p] / total[p], real(0.0))
        rows = wp.min(side, settings.height - top)
        across = wp.min(side, settings.width - left)
        row = int(0)
        while row < rows:
            first_pixel = (camera * settings.height + top + row) * settings.width + left
            o = wp.max(first_pixel, 0)
            p = wp.max(row * side, 0)
            row += 1
            if across == side:
                for lane in range(side):
                    alpha_out[o + lane] = real(1.0) - t[p + lane]
                    depth[o + lane] = z[p + lane]
                    transmittances[o + lane] = t[p + lane]
                    weights[o + lane] = total[p + lane]
                    ends[o + lane] = end[p + lane]
            else:
                lane = int(0)
                while lane < across:
                    alpha_out[o + lane] = real(1.0) - t[p + lane]
                    depth[o + lane] = z[p + lane]
                    transmittances[o + lane] = t[p + lane]
                    weights[o + lane] = total[p + lane]
                    ends[o + lane] = end[p + lane]
                    lane += 1
            if across == side and pitch == per_pixel:
                for k in range(per_row):  # few wide stores: at most 64 of a core can wait for cache lines
                    rgb[o * per_pixel + k] = joined[p * per_pixel + k]
            else:
                lane = int(0)
                while lane < across:
                    at_pixel = (first_pixel + lane) * pitch
                    if at_pixel < 0:
                        break  # never true; it prevents vectorisation, which would make these stores slow scatters
                    store_channels(at_pixel, wp.max(p + lane, 0), joined, rgb)
                    lane += 1

    return forward


@functools.cache
def make_kernels(real, tile_size: int, channels: int = COLORS, absgrad: bool = False, deep: bool = True):
    """Make the forward, backward and contribution kernels; arguments are those of `make_backward`."""
    return SimpleNamespace(
        forward=make_forward(real, tile_size, channels),
        backward=make_backward(real, tile_size, channels, absgrad, deep),
        contributions=make_contributions(real, tile_size),
    )
