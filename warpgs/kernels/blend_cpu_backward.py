"""The backward blending kernel in plain Warp, one task per tile: that of the CPU, and of float64 on every device.

The kernel walks the Gaussians of its tile back to front. A Gaussian's whole effect on a pixel is one number
d = c . v_rgb + z v_z + v_w (docs/blend.md, section 3). Each step of the walk is a function over the records of `blend_records`.
Loops over channels are unrolled, because of their static number, and so stand apart from the loops that must not be.
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.constants import SMALLEST_WEIGHT
from warpgs.kernels.blend_records import COLORS, VALUES, make_records
from warpgs.kernels.compiler import ROLLED
from warpgs.kernels.falloff import ABREAST, STRIP, make_functions


@functools.cache
def make_walk(real, tile_size: int, channels: int, absgrad: bool):
    """Make the functions that load the pixels of a tile and walk past a Gaussian."""
    f = make_functions(real)
    r = make_records(real, tile_size, channels, absgrad)
    stride = wp.constant(tile_size * (tile_size + 1))
    side = wp.constant(tile_size)
    strip = wp.constant(STRIP)
    parts = wp.constant(tile_size // STRIP)
    strips = wp.constant(tile_size * (tile_size // STRIP))
    bits = wp.constant(tile_size * (tile_size // STRIP) - 1)
    abreast = wp.constant(ABREAST)
    smallest = wp.constant(real(SMALLEST_WEIGHT))
    row_reals = wp.types.vector(tile_size, real)
    at = r.at
    at_int = r.at_int

    @wp.func(inline=True)
    def load_channels(
        o: wp.int32, p: wp.int32, camera: wp.int32, backgrounds: wp.array2d(dtype=real), v_rgb: wp.array2d(dtype=real),
        pixels: wp.ref[r.Pixels],
    ) -> real:  # fmt: skip
        """Load the upstream gradient of a pixel's channels; return its product with the background."""
        pixels.g[p] = v_rgb[o, 0]
        product = backgrounds[camera, 0] * v_rgb[o, 0]
        for c in range(1, wp.static(channels)):
            pixels.g[c * stride + p] = v_rgb[o, c]
            product = product + backgrounds[camera, c] * v_rgb[o, c]
        return product

    @wp.func(inline=True)
    def effect(g: r.Projected, p: wp.int32, pixels: wp.ref[r.Pixels]) -> real:
        """Return the product of a Gaussian's channels with the upstream gradient of a pixel."""
        product = at(g.color[0]) * at(pixels.g[p])
        for c in range(1, wp.static(channels)):
            product = product + at(g.color[c]) * at(pixels.g[c * stride + p])
        return product

    @wp.func(inline=True)
    def load_pixels(
        place: wp.vec3i, settings: f.Blending, backgrounds: wp.array2d(dtype=real), transmittances: wp.array(dtype=real),
        weights: wp.array(dtype=real), depth: wp.array(dtype=real), ends: wp.array(dtype=int),
        v_rgb: wp.array2d(dtype=real), v_alpha: wp.array(dtype=real), v_depth: wp.array(dtype=real),
        pixels: wp.ref[r.Pixels],
    ) -> wp.int32:  # fmt: skip
        """Load what is known of the pixels; return one past the last instance that any of them blended."""
        camera = place[0]
        left = place[1]
        top = place[2]
        last = int(0)
        for row in range(wp.min(side, settings.height - top)):
            for column in range(wp.min(side, settings.width - left)):
                part = column // strip
                p = (part * side + row) * strip + column - part * strip
                o = (camera * settings.height + top + row) * settings.width + left + column
                t = transmittances[o]
                pixels.t[p] = t
                v_w = real(0.0)
                if weights[o] >= smallest:
                    v_z = v_depth[o] / weights[o]
                    pixels.v_z[p] = v_z
                    v_w = -v_z * depth[o]
                pixels.v_w[p] = v_w + v_alpha[o]
                pixels.behind[p] = t * load_channels(o, p, camera, backgrounds, v_rgb, pixels)
                pixels.end[p] = ends[o]
                pixels.strip_end[part * side + row] = wp.max(at_int(pixels.strip_end[part * side + row]), ends[o])
                last = wp.max(last, ends[o])
        return last

    @wp.func(inline=True)
    def find_strips(
        g: r.Projected, instance: wp.int32, place: wp.vec3i, settings: f.Blending, pixels: wp.ref[r.Pixels],
        reach: wp.ref[r.Reach],
    ) -> wp.int32:  # fmt: skip
        """List the strips that a Gaussian reaches; return their number."""
        row_dy = row_reals()
        row_e12 = row_reals()
        row_e22 = row_reals()
        for row in range(side):
            dy = real(settings.origin_y + place[2] + row) + real(0.5) - g.y
            e2 = g.u22 * dy
            row_dy[row] = dy
            row_e12[row] = f.apart(g.u12 * dy)
            row_e22[row] = f.apart(e2 * e2)
        for part in range(parts):
            dx = real(settings.origin_x + place[1] + part * strip) + real(0.5) - g.x
            at_left = f.apart(g.u11 * dx)
            for row in range(side):
                o = part * side + row
                start = at_left + row_e12[row]
                reach.dx[o] = dx
                reach.dy[o] = row_dy[row]
                reach.e22[o] = row_e22[row]
                reach.start[o] = start
                hit = f.reaches(start, g.u11, row_e22[row], g.aside, g.limit) and instance < at_int(pixels.strip_end[o])
                reach.hits[o] = wp.where(hit, 1, 0)
        for lane in range(strip):
            reach.ramp[lane] = f.apart(g.u11 * real(lane))
        reaching = int(0)
        for o in range(strips):  # without a branch, which would be mispredicted once for each row or so
            reach.order[reaching & bits] = o
            reaching += at_int(reach.hits[o])
        return reaching

    @wp.func(inline=True)
    def find_shades(
        g: r.Projected, instance: wp.int32, reaching: wp.int32, settings: f.Blending, pixels: wp.ref[r.Pixels],
        reach: wp.ref[r.Reach], shades: wp.ref[r.Shades],
    ):  # fmt: skip
        """Compute the alphas of the pixels of the strips that are reached."""
        e1 = f.abreast()
        e2_squared = f.abreast()
        k = int(0)
        while k < reaching:
            base = wp.max(k, 0)
            k += abreast  # the last few may not be reached; their values are not read
            for lane in range(strip):
                ramp = at(reach.ramp[lane])
                for n in range(abreast):
                    o = at_int(reach.order[base + n]) & bits
                    e1[n] = at(reach.start[o]) + ramp
                    e2_squared[n] = at(reach.e22[o])
                falloffs = f.falloffs(wp.cw_mul(e1, e1) + e2_squared)
                for n in range(abreast):
                    q = (base + n) * strip + lane
                    raw = g.opacity * falloffs[n]
                    alpha = wp.where(settings.alpha_max < raw, settings.alpha_max, raw)
                    until = at_int(pixels.end[(at_int(reach.order[base + n]) & bits) * strip + lane])
                    blended = alpha >= settings.alpha_cut and instance < until
                    alpha = wp.where(blended, alpha, real(0.0))
                    shades.alpha[q] = alpha
                    shades.inverse[q] = real(1.0) / (real(1.0) - alpha)
                    shades.slope[q] = wp.where(blended and raw <= settings.alpha_max, falloffs[n], real(0.0))

    @wp.func(inline=True)
    def step_back(
        g: r.Projected, reaching: wp.int32, pixels: wp.ref[r.Pixels], reach: wp.ref[r.Reach], shades: wp.ref[r.Shades]
    ):
        """Walk past a Gaussian: find its weights and the gradients of its falloff, and what lies before it."""
        k = int(0)
        while k < reaching:
            base = wp.max(k, 0) * strip
            o = at_int(reach.order[wp.max(k, 0)]) & bits
            k += 1
            for lane in range(strip):
                p = o * strip + lane
                q = base + lane
                d = effect(g, p, pixels) + g.z * at(pixels.v_z[p]) + at(pixels.v_w[p])
                before = at(pixels.t[p]) * at(shades.inverse[q])
                w = at(shades.alpha[q]) * before
                shades.v[q] = (at(pixels.t[p]) * d - at(pixels.behind[p])) * at(shades.inverse[q]) * at(shades.slope[q])
                shades.w[q] = w
                pixels.t[p] = before
                pixels.behind[p] = at(pixels.behind[p]) + w * d

    return SimpleNamespace(load_pixels=load_pixels, find_strips=find_strips, find_shades=find_shades, step_back=step_back)


@functools.cache
def make_gradient(real, tile_size: int, channels: int, absgrad: bool):
    """Make the functions that sum the gradient of one instance."""
    r = make_records(real, tile_size, channels, absgrad)
    count = VALUES + channels - COLORS + 2 * absgrad
    values = wp.constant(count)
    channels_of_strip = wp.constant((channels + 2 * absgrad) * STRIP)
    stride = wp.constant(tile_size * (tile_size + 1))
    at = r.at
    at_int = r.at_int
    half_sums = wp.types.vector(count * (STRIP // 2), real)
    strip_sums = wp.types.vector(count * STRIP, real)
    value_reals = wp.types.vector(count, real)
    bits = wp.constant(tile_size * (tile_size // STRIP) - 1)
    strip = wp.constant(STRIP)
    half = wp.constant(STRIP // 2)

    @wp.func(inline=True)
    def add_channels(w: real, p: wp.int32, lane: wp.int32, pixels: wp.ref[r.Pixels], s: wp.ref[r.Gradient]):
        """Add what a pixel gives to the gradient of the channels."""
        for c in range(wp.static(channels)):
            s.color[c * strip + lane] = at(s.color[c * strip + lane]) + w * at(pixels.g[c * stride + p])

    @wp.func(inline=True)
    def add_magnitudes(g: r.Projected, v_e1: real, v_y: real, lane: wp.int32, s: wp.ref[r.Gradient]):
        """Add the magnitudes of what a pixel gives to the gradient of the mean, where they are asked for."""
        if wp.static(absgrad):
            x = wp.static(channels * STRIP) + lane
            y = wp.static((channels + 1) * STRIP) + lane
            s.color[x] = at(s.color[x]) + wp.abs(v_e1)
            s.color[y] = at(s.color[y]) + wp.abs(g.u12 * v_e1 + g.u22 * g.u22 * v_y)

    @wp.func(inline=True)
    def sum_up(
        g: r.Projected, reaching: wp.int32, pixels: wp.ref[r.Pixels], reach: wp.ref[r.Reach], shades: wp.ref[r.Shades]
    ) -> r.Gradient:
        """Return the sums over the strips that are reached."""
        s = r.Gradient()
        k = int(0)
        while k < reaching:
            base = wp.max(k, 0) * strip
            o = at_int(reach.order[wp.max(k, 0)]) & bits
            k += 1
            dx = at(reach.dx[o])
            dy = at(reach.dy[o])
            start = at(reach.start[o])
            for lane in range(strip):
                p = o * strip + lane
                v = at(shades.v[base + lane])
                w = at(shades.w[base + lane])
                v_e1 = v * (start + at(reach.ramp[lane]))
                v_y = v * dy
                s.e1[lane] = at(s.e1[lane]) + v_e1
                s.y[lane] = at(s.y[lane]) + v_y
                s.xx[lane] = at(s.xx[lane]) + v_e1 * (dx + real(lane))
                s.xy[lane] = at(s.xy[lane]) + v_e1 * dy
                s.yy[lane] = at(s.yy[lane]) + v_y * dy
                s.opacity[lane] = at(s.opacity[lane]) + v
                add_channels(w, p, lane, pixels, s)
                add_magnitudes(g, v_e1, v_y, lane, s)
                s.z[lane] = at(s.z[lane]) + w * at(pixels.v_z[p])
        return s

    @wp.func(inline=True)
    def totals_of(s: wp.ref[r.Gradient]) -> value_reals:
        """Return the sums over the places in a strip, always in one order."""
        # Into one array per width, because additions vectorise only where nothing may overlap.
        sums = strip_sums()
        for lane in range(strip):
            sums[0 * strip + lane] = at(s.e1[lane])
            sums[1 * strip + lane] = at(s.y[lane])
            sums[2 * strip + lane] = at(s.xx[lane])
            sums[3 * strip + lane] = at(s.xy[lane])
            sums[4 * strip + lane] = at(s.yy[lane])
            sums[5 * strip + lane] = at(s.opacity[lane])
            sums[(values - 1) * strip + lane] = at(s.z[lane])
        for k in range(channels_of_strip):
            sums[6 * strip + k] = at(s.color[k])
        halves = half_sums()
        for k in range(values):
            for lane in range(half):
                halves[k * half + lane] = sums[k * strip + lane] + sums[k * strip + half + lane]
        totals = value_reals()
        for k in range(values):
            o = k * half
            totals[k] = (halves[o] + halves[o + 2]) + (halves[o + 1] + halves[o + 3])
        return totals

    @wp.func(inline=True)
    def store(g: r.Projected, totals: value_reals, slot: wp.int32, v_slots: wp.array2d(dtype=real)):
        """Store the gradient of an instance, which the sums are but for factors that they share."""
        v_e1 = g.opacity * totals[0]
        v_e2 = g.opacity * g.u22 * totals[1]
        v_slots[slot, 0] = g.u11 * v_e1
        v_slots[slot, 1] = g.u12 * v_e1 + g.u22 * v_e2
        v_slots[slot, 2] = -g.opacity * totals[2]
        v_slots[slot, 3] = -g.opacity * totals[3]
        v_slots[slot, 4] = -g.opacity * g.u22 * totals[4]
        for k in range(5, values):
            v_slots[slot, k] = totals[k]
        if wp.static(absgrad):  # behind the depth, which is the last total
            v_slots[slot, values - 3] = totals[values - 1]
            v_slots[slot, values - 2] = g.opacity * wp.abs(g.u11) * totals[values - 3]
            v_slots[slot, values - 1] = g.opacity * totals[values - 2]

    return SimpleNamespace(sum_up=sum_up, totals_of=totals_of, store=store)


@functools.cache
def make_backward(real, tile_size: int, channels: int, absgrad: bool = False):
    """Make the kernel for one scalar type, tile size and number of channels; ``absgrad`` as in `BlendSettings`."""
    f = make_functions(real)
    r = make_records(real, tile_size, channels, absgrad)
    m = make_walk(real, tile_size, channels, absgrad)
    n = make_gradient(real, tile_size, channels, absgrad)
    side = wp.constant(tile_size)
    place_z = wp.constant(6 + channels)

    @wp.func(inline=True)
    def load_color(projected: wp.array2d(dtype=real), i: int, g: wp.ref[r.Projected]):
        """Load the channels of a projected Gaussian."""
        for c in range(wp.static(channels)):
            g.color[c] = projected[i, 6 + c]

    @wp.func(inline=True)
    def projected_at(projected: wp.array2d(dtype=real), i: int, x: real, whole_tiles: int) -> r.Projected:
        """Return a projected Gaussian whose ``x`` was loaded before."""
        g = r.Projected()
        g.x = x
        g.y = projected[i, 1]
        g.u11 = projected[i, 2]
        g.u12 = projected[i, 3]
        g.u22 = projected[i, 4]
        g.opacity = projected[i, 5]
        load_color(projected, i, g)
        g.z = projected[i, place_z]
        bounds = f.bounds_of(g.x, g.y, g.u11, g.u22, projected[i, place_z + 1], projected[i, place_z + 2], whole_tiles)
        g.aside = bounds[0]
        g.limit = bounds[1]
        return g

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def backward(
        begin: int, settings: f.Blending, projected: wp.array2d(dtype=real), ranges: wp.array2d(dtype=int),
        gaussian_ids: wp.array(dtype=int), slots: wp.array(dtype=int), backgrounds: wp.array2d(dtype=real),
        transmittances: wp.array(dtype=real), weights: wp.array(dtype=real), depth: wp.array(dtype=real),
        ends: wp.array(dtype=int),
        v_rgb: wp.array2d(dtype=real), v_alpha: wp.array(dtype=real), v_depth: wp.array(dtype=real),
        # outputs, zero on entry
        v_slots: wp.array2d(dtype=real),
    ):  # fmt: skip
        tile = begin + wp.tid()
        place = f.place_of(tile, side, settings)
        pixels = r.Pixels()
        reach = r.Reach()
        shades = r.Shades()
        instance = m.load_pixels(
            place, settings, backgrounds, transmittances, weights, depth, ends, v_rgb, v_alpha, v_depth, pixels
        )
        ahead = real(0.0)
        if instance > ranges[tile, 0]:
            ahead = projected[gaussian_ids[instance - 1], 0]
        while instance > ranges[tile, 0]:
            instance -= 1
            g = projected_at(projected, gaussian_ids[instance], ahead, settings.whole_tiles)
            ahead = projected[gaussian_ids[wp.max(instance - 1, 0)], 0]  # loaded early, as it may be far away
            reaching = m.find_strips(g, instance, place, settings, pixels, reach)
            m.find_shades(g, instance, reaching, settings, pixels, reach, shades)
            m.step_back(g, reaching, pixels, reach, shades)
            # Apart from the walk, because what both need does not fit into 16 registers.
            sums = n.sum_up(g, reaching, pixels, reach, shades)
            n.store(g, n.totals_of(sums), slots[instance], v_slots)

    return backward
