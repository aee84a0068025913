"""Blending kernels in plain Warp, one task per tile; used on the CPU, and for float64 on every device."""

import functools

import warp as wp

from warpgs.constants import SMALLEST_WEIGHT
from warpgs.kernels.falloff import ABREAST, BATCH, COLORS, STRIP, TOGETHER, VALUES, make_batches, make_functions
from warpgs.kernels.native import ROLLED, IntRows, Ints, make_prefetch

# The backward blending kernel in plain Warp, one task per tile; used on the CPU, and for float64 on every device.
#
# The kernel walks the Gaussians of its tile back to front. A Gaussian's whole effect on a pixel is one number d = c .
# v_rgb + z v_z + v_w (docs/blend.md, section 3). Loops over channels have a static length and are unrolled, so they are
# kept apart from loops that must stay rolled.


@functools.cache
def make_backward(real, tile_size: int, channels: int, absgrad: bool = False, deep: bool = True):
    """Make the backward kernel; without ``deep``, depth and alpha have no gradient, and their data is not read."""
    f = make_functions(real)
    b = make_batches(real, tile_size, channels)
    Reals, Rows = wp.array(dtype=real), wp.array2d(dtype=real)
    at, at_int = b.at, b.at_int
    values = VALUES + channels - COLORS + 2 * absgrad
    together_values = TOGETHER * values
    prefetch, prefetch_slot = make_prefetch(b.record), make_prefetch(real, 2)
    prefetch_end, prefetch_value = make_prefetch(wp.int32), make_prefetch(real)
    stride, side, pixels_of_tile = tile_size * (tile_size + 1), tile_size, tile_size * tile_size
    strip, half = STRIP, STRIP // 2
    parts, strips = tile_size // STRIP, tile_size * (tile_size // STRIP)
    batch, together = BATCH, TOGETHER
    # masks of indices, whose ranges are powers of 2
    pixel_bits, strip_bits = tile_size * tile_size - 1, tile_size * (tile_size // STRIP) - 1
    row_bits, column_bits = tile_size - 1, tile_size * STRIP - 1
    bits, group_bits = BATCH - 1, TOGETHER - 1
    smallest = real(SMALLEST_WEIGHT)
    # values of a row of gradients that are at most 64 bytes apart
    spacing = max(1, 64 // ((4 if real is wp.float32 else 8) * channels))
    apart, touches = spacing, -(-(tile_size - 1) // spacing) + 1
    # Entries of pixels follow in the order of `make_batches`. Vectors are one row longer than the tile: see `make_forward`.
    # Channels are stored one after the other. In a gradient, the two magnitudes follow the channels if ``absgrad`` is set. The
    # compiler puts records 8 bytes before a cache line; with a vector of 2 in front, no strip lies in two lines.
    lead_reals, trail_reals, strip_reals = (wp.types.vector(n, real) for n in (2, 14, STRIP))
    tile_reals = wp.types.vector(tile_size * (tile_size + 1), real)

    @wp.struct
    class Pixels:
        """Values of each pixel of a tile."""

        lead: lead_reals
        t: tile_reals  # transmittance behind the current instance, then before it
        behind: tile_reals  # sum of w d over what lies behind, background included
        g: wp.types.vector(channels * tile_size * (tile_size + 1), real)  # upstream gradient of the channels
        v_z: tile_reals
        v_w: tile_reals
        end: wp.types.vector(tile_size * (tile_size + 1), wp.int32)  # one past the last instance that was blended
        trail: trail_reals

    @wp.struct
    class Shades:
        """Gradient and weight of the current instance at each pixel that it reaches."""

        lead: lead_reals
        falloff: b.column_reals  # of one column of strips, and of a few rows beyond it
        v: tile_reals  # gradient of the falloff
        w: tile_reals  # blending weight
        trail: trail_reals

    @wp.struct
    class Gradient:
        """Sums of one instance's gradient, by place in a strip."""

        e1: strip_reals
        y: strip_reals
        xx: strip_reals
        xy: strip_reals
        yy: strip_reals
        opacity: strip_reals
        color: wp.types.vector((channels + 2 * absgrad) * STRIP, real)
        z: strip_reals

    @wp.struct
    class Held:
        """Sums of several instances' gradients, one instance after the other."""

        halves: wp.types.vector(TOGETHER * values * (STRIP // 2), real)  # by place in half a strip
        totals: wp.types.vector(TOGETHER * values, real)

    @wp.func(inline=True)
    def load_channels(o: wp.int32, p: wp.int32, v_rgb: Reals, pixels: wp.ref[Pixels]):
        """Load the upstream gradient of a pixel's channels, whose first has the index ``o``."""
        for c in range(wp.static(channels)):
            pixels.g[c * stride + p] = v_rgb[o + c]

    @wp.func(inline=True)
    def behind_of(p: wp.int32, camera: wp.int32, backgrounds: Rows, pixels: wp.ref[Pixels]) -> real:
        """Return the product of a pixel's upstream gradient with the background."""
        product = backgrounds[camera, 0] * at(pixels.g[p])
        for c in range(1, wp.static(channels)):
            product = product + backgrounds[camera, c] * at(pixels.g[c * stride + p])
        return product

    @wp.func(inline=True)
    def load_depth(
        o: wp.int32, p: wp.int32, weights: Reals, depth: Reals, v_alpha: Reals, v_depth: Reals, pixels: wp.ref[Pixels]
    ):
        """Load what the gradients of depth and alpha add to the effect of a Gaussian on a pixel."""
        if wp.static(deep):
            v_w = real(0.0)
            if weights[o] >= smallest:
                v_z = v_depth[o] / weights[o]
                pixels.v_z[p] = v_z
                v_w = -v_z * depth[o]
            pixels.v_w[p] = v_w + v_alpha[o]

    @wp.func(inline=True)
    def load_pixels(
        camera: wp.int32, left: wp.int32, top: wp.int32, settings: f.Blending, backgrounds: Rows, transmittances: Reals,
        weights: Reals, depth: Reals, ends: Ints, v_rgb: Reals, pitch: wp.int32, v_alpha: Reals, v_depth: Reals,
        pixels: wp.ref[Pixels], until: wp.ref[b.strip_ints],
    ) -> wp.int32:  # fmt: skip
        """Load the pixels, and for each strip one past the last instance that it blended; return the largest of these."""
        rows = wp.min(side, settings.height - top)
        across = wp.min(side, settings.width - left)
        row = int(0)
        while row < rows:
            first = (camera * settings.height + top + row) * settings.width + left
            for part in range(parts):
                base = ((part * side + row) * strip) & pixel_bits
                lane = int(0)
                while lane < wp.min(across - part * strip, strip):
                    q = first + part * strip + lane
                    if f.never(q):
                        break
                    p = wp.max(base + lane, 0)
                    lane += 1
                    pixels.t[p] = transmittances[q]
                    pixels.end[p] = ends[q]
                    load_channels(q * pitch, p, v_rgb, pixels)
                    load_depth(q, p, weights, depth, v_alpha, v_depth, pixels)
            row += 1
        for p in range(pixels_of_tile):
            pixels.behind[p] = at(pixels.t[p]) * behind_of(p, camera, backgrounds, pixels)
        last = int(0)
        for s in range(strips):
            end = int(0)
            for lane in range(strip):
                end = wp.max(end, at_int(pixels.end[s * strip + lane]))
            until[s] = end
            last = wp.max(last, end)
        return last

    @wp.func(inline=True)
    def effect(j: wp.int32, p: wp.int32, g: wp.ref[b.Batch], pixels: wp.ref[Pixels]) -> real:
        """Return the effect d of a Gaussian on a pixel."""
        product = at(g.color[j]) * at(pixels.g[p])
        for c in range(1, wp.static(channels)):
            product = product + at(g.color[c * batch + j]) * at(pixels.g[c * stride + p])
        if wp.static(deep):
            return product + at(g.z[j]) * at(pixels.v_z[p]) + at(pixels.v_w[p])
        return product

    @wp.func(inline=True)
    def add_channels(w: real, p: wp.int32, lane: wp.int32, pixels: wp.ref[Pixels], s: wp.ref[Gradient]):
        """Add a pixel's contribution to the gradient of the channels and of the depth."""
        for c in range(wp.static(channels)):
            s.color[c * strip + lane] = at(s.color[c * strip + lane]) + w * at(pixels.g[c * stride + p])
        if wp.static(deep):
            s.z[lane] = at(s.z[lane]) + w * at(pixels.v_z[p])

    @wp.func(inline=True)
    def add_magnitudes(u12: real, u22: real, v_e1: real, v_y: real, lane: wp.int32, s: wp.ref[Gradient]):
        """Add the magnitudes of a pixel's contributions to the gradient of the mean, if they are requested."""
        if wp.static(absgrad):
            x = wp.static(channels * STRIP) + lane
            y = wp.static((channels + 1) * STRIP) + lane
            s.color[x] = at(s.color[x]) + wp.abs(v_e1)
            s.color[y] = at(s.color[y]) + wp.abs(u12 * v_e1 + u22 * u22 * v_y)

    @wp.func(inline=True)
    def walk(
        j: wp.int32, instance: wp.int32, left: wp.int32, settings: f.Blending, g: wp.ref[b.Batch], rows: wp.ref[b.Rows],
        pixels: wp.ref[Pixels], shades: wp.ref[Shades],
    ):  # fmt: skip
        """Walk back past a Gaussian: find its weights and the gradients of its falloff, and what lies before it."""
        u11 = at(g.u11[j])
        opacity = at(g.opacity[j])
        for part in range(parts):
            row = at_int(g.begin[part * batch + j])
            end = at_int(g.end[part * batch + j])
            at_left = f.apart(u11 * (real(left + part * strip) + real(0.5) - at(g.x[j])))
            b.find_falloffs(at_left, row, end, rows, shades.falloff)
            k = int(0)
            while row < end:
                o = (part * side + row) & strip_bits
                q = k & column_bits
                row += 1
                k += strip
                for lane in range(strip):
                    p = o * strip + lane
                    falloff = at(shades.falloff[q + lane])
                    raw = opacity * falloff
                    alpha = wp.where(settings.alpha_max < raw, settings.alpha_max, raw)
                    blended = alpha >= settings.alpha_cut and instance < at_int(pixels.end[p])
                    alpha = wp.where(blended, alpha, real(0.0))
                    slope = wp.where(blended and raw <= settings.alpha_max, falloff, real(0.0))
                    inverse = real(1.0) / (real(1.0) - alpha)
                    t = at(pixels.t[p])
                    behind = at(pixels.behind[p])
                    d = effect(j, p, g, pixels)
                    before = t * inverse
                    w = alpha * before
                    shades.v[p] = (t * d - behind) * inverse * slope
                    shades.w[p] = w
                    pixels.t[p] = before
                    pixels.behind[p] = behind + w * d

    @wp.func(inline=True)
    def sum_up(
        j: wp.int32, left: wp.int32, g: wp.ref[b.Batch], rows: wp.ref[b.Rows], pixels: wp.ref[Pixels],
        shades: wp.ref[Shades],
    ) -> Gradient:  # fmt: skip
        """Return the sums over the strips that a Gaussian of the batch reaches."""
        s = Gradient()
        u11 = at(g.u11[j])
        u12 = at(g.u12[j])
        u22 = at(g.u22[j])
        for part in range(parts):
            row = at_int(g.begin[part * batch + j])
            end = at_int(g.end[part * batch + j])
            dx = real(left + part * strip) + real(0.5) - at(g.x[j])
            at_left = f.apart(u11 * dx)
            while row < end:
                o = (part * side + row) & strip_bits
                dy = at(rows.dy[row & row_bits])
                start = at_left + at(rows.e12[row & row_bits])
                row += 1
                for lane in range(strip):
                    p = o * strip + lane
                    v = at(shades.v[p])
                    v_e1 = v * (start + at(rows.ramp[lane]))
                    v_y = v * dy
                    s.e1[lane] = at(s.e1[lane]) + v_e1
                    s.y[lane] = at(s.y[lane]) + v_y
                    s.xx[lane] = at(s.xx[lane]) + v_e1 * (dx + real(lane))
                    s.xy[lane] = at(s.xy[lane]) + v_e1 * dy
                    s.yy[lane] = at(s.yy[lane]) + v_y * dy
                    s.opacity[lane] = at(s.opacity[lane]) + v
                    add_channels(at(shades.w[p]), p, lane, pixels, s)
                    add_magnitudes(u12, u22, v_e1, v_y, lane, s)
        return s

    @wp.func(inline=True)
    def hold_channels(o: wp.int32, lane: wp.int32, s: wp.ref[Gradient], held: wp.ref[Held]):
        """Keep the sums of the channels at a place in half a strip."""
        for k in range(wp.static(channels + 2 * absgrad)):
            held.halves[o + (6 + k) * half] = at(s.color[k * strip + lane]) + at(s.color[k * strip + half + lane])

    @wp.func(inline=True)
    def hold(j: wp.int32, s: wp.ref[Gradient], held: wp.ref[Held]):
        """Keep the sums of a Gaussian until a group is complete; the two halves of a strip are added here."""
        o = (j & group_bits) * (values * half)
        for lane in range(half):
            held.halves[o + lane] = at(s.e1[lane]) + at(s.e1[half + lane])
            held.halves[o + 1 * half + lane] = at(s.y[lane]) + at(s.y[half + lane])
            held.halves[o + 2 * half + lane] = at(s.xx[lane]) + at(s.xx[half + lane])
            held.halves[o + 3 * half + lane] = at(s.xy[lane]) + at(s.xy[half + lane])
            held.halves[o + 4 * half + lane] = at(s.yy[lane]) + at(s.yy[half + lane])
            held.halves[o + 5 * half + lane] = at(s.opacity[lane]) + at(s.opacity[half + lane])
            held.halves[o + (values - 1) * half + lane] = at(s.z[lane]) + at(s.z[half + lane])
            hold_channels(o + lane, lane, s, held)

    @wp.func(inline=True)
    def fold(held: wp.ref[Held]):
        """Add up the sums that `hold` keeps of each Gaussian, always in the same order."""
        for n in range(together_values):
            o = n * half
            held.totals[n] = (at(held.halves[o]) + at(held.halves[o + 2])) + (at(held.halves[o + 1]) + at(held.halves[o + 3]))

    @wp.func(inline=True)
    def store(j: wp.int32, g: wp.ref[b.Batch], held: wp.ref[Held], slot: wp.int32, v_slots: Rows):
        """Store the gradient of an instance: the sums times factors that they share."""
        o = (j & group_bits) * values
        u11 = at(g.u11[j])
        u22 = at(g.u22[j])
        opacity = at(g.opacity[j])
        v_e1 = opacity * at(held.totals[o + 0])
        v_e2 = opacity * u22 * at(held.totals[o + 1])
        v_slots[slot, 0] = u11 * v_e1
        product = u22 * v_e2
        product = wp.where(real(1.0e30) < product, real(wp.inf), product)  # so that it is rounded, and not fused with the sum
        v_slots[slot, 1] = at(g.u12[j]) * v_e1 + product
        v_slots[slot, 2] = -opacity * at(held.totals[o + 2])
        v_slots[slot, 3] = -opacity * at(held.totals[o + 3])
        v_slots[slot, 4] = -opacity * u22 * at(held.totals[o + 4])
        for k in range(5, values):
            v_slots[slot, k] = at(held.totals[o + k])
        if wp.static(absgrad):  # behind the depth, which is the last total
            v_slots[slot, values - 3] = at(held.totals[o + values - 1])
            v_slots[slot, values - 2] = opacity * wp.abs(u11) * at(held.totals[o + values - 3])
            v_slots[slot, values - 1] = opacity * at(held.totals[o + values - 2])

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def backward(
        begin: int, settings: f.Blending, projected: wp.array(dtype=b.record), ranges: IntRows, gaussian_ids: Ints, slots: Ints,
        backgrounds: Rows, transmittances: Reals, weights: Reals, depth: Reals, ends: Ints, v_rgb: Reals, pitch: int,
        v_alpha: Reals, v_depth: Reals,
        # outputs, zero on entry
        v_slots: Rows,
    ):  # fmt: skip
        tile = ranges.shape[0] - 1 - begin - wp.tid()  # from the last on, as the instances
        camera, left, top = f.place_of(tile, side, settings)
        pixels = Pixels()
        until = b.strip_ints()
        gaussians = b.Batch()
        rows = b.Rows()
        shades = Shades()
        held = Held()
        first = ranges[tile, 0]
        last = load_pixels(
            camera, left, top, settings, backgrounds, transmittances, weights, depth, ends, v_rgb, pitch, v_alpha, v_depth,
            pixels, until,
        )  # fmt: skip
        left += settings.origin_x
        top += settings.origin_y
        next_camera, next_left, next_top = f.place_of(wp.max(tile - 1, 0), side, settings)
        for row in range(side):  # the pixels of the next tile
            o = (next_camera * settings.height + next_top + row) * settings.width + next_left
            prefetch_end(ends, o)
            prefetch_value(transmittances, o)
            for part in range(touches):
                prefetch_value(v_rgb, (o + part * apart) * pitch)
        while last > first:
            count = wp.min(batch, last - first)
            b.load(projected, gaussian_ids, last - 1, -1, count, settings.whole_tiles, gaussians)
            b.find_rows(left, top, last - 1, count, until, gaussians)
            j = int(0)
            while j < count:
                last -= 1
                prefetch(projected, gaussian_ids[wp.max(last - batch, 0)])  # also those of the next tile
                prefetch_slot(v_slots, slots[wp.max(last - together, 0)])
                n = j & bits
                b.find_row_values(
                    at(gaussians.y[n]), at(gaussians.u11[n]), at(gaussians.u12[n]), at(gaussians.u22[n]), top, rows
                )
                walk(n, last, left, settings, gaussians, rows, pixels, shades)
                # Apart from the walk, since both together would need more than 16 registers.
                sums = sum_up(n, left, gaussians, rows, pixels, shades)
                hold(n, sums, held)
                j += 1
                if j % together == 0 or j == count:
                    fold(held)
                    k = (j - 1) // together * together
                    while k < j:
                        store(k & bits, gaussians, held, slots[last + j - 1 - k], v_slots)
                        k += 1

    return backward


# Blending kernels in plain Warp, one task per tile; used on the CPU, and for float64 on every device.
#
# A task cuts the rows of its tile into strips. The innermost loops run over the pixels of one strip without branches
# and are kept rolled, so that the compiler vectorises them (docs/blend.md, section 5).


@functools.cache
def make_forward(real, tile_size: int, channels: int):
    """Make the forward kernel for one scalar type, tile size and number of channels."""
    f, b = make_functions(real), make_batches(real, tile_size, channels)
    # Vectors rather than local arrays: the compiler must see that they do not overlap. They are one row longer than
    # the tile, so that they are not 4096 bytes apart: there a load of one would wait for a store to the other (4K aliasing).
    tile_stride, side, pixels = tile_size * (tile_size + 1), tile_size, tile_size * tile_size
    sizes = tile_stride, STRIP, BATCH
    tile_reals, strip_reals, batch_reals, batch_strips = (wp.types.vector(n, real) for n in (*sizes, BATCH * STRIP))
    tile_ints, strip_ints, batch_ints = (wp.types.vector(n, wp.int32) for n in sizes)
    at, prefetch = b.at, make_prefetch(b.record)
    # of several channels, one after the other
    tile_channels, strip_channels = (wp.types.vector(channels * n, real) for n in (tile_stride, 2 * STRIP))
    per_pixel, per_row = channels, channels * tile_size
    strip, parts, abreast = STRIP, tile_size // STRIP, ABREAST
    batch, bits, together = BATCH, BATCH - 1, TOGETHER
    outside, smallest = real(-1.0), real(SMALLEST_WEIGHT)
    Reals, Rows = wp.array(dtype=real), wp.array2d(dtype=real)

    # Loops over channels have a static length and are unrolled, so they are kept apart from loops that must stay rolled.
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
    def add_channels(w: real, lane: wp.int32, j: wp.int32, g: wp.ref[b.Batch], strip_sums: wp.ref[strip_channels]):
        """Add the channels of a Gaussian to the sums of a pixel of a strip."""
        for c in range(wp.static(channels)):
            strip_sums[2 * c * strip + lane] = at(strip_sums[2 * c * strip + lane]) + w * at(g.color[c * batch + j])

    @wp.func(inline=True)
    def add_background(camera: wp.int32, p: wp.int32, t: real, backgrounds: Rows, sums: wp.ref[tile_channels]):
        """Add the background to the sums of a pixel."""
        for c in range(wp.static(channels)):
            sums[c * tile_stride + p] = at(sums[c * tile_stride + p]) + t * backgrounds[camera, c]

    @wp.func(inline=True)
    def join_channels(p: wp.int32, sums: wp.ref[tile_channels], joined: wp.ref[tile_channels]):
        """Put the channels of a pixel side by side."""
        for c in range(wp.static(channels)):
            joined[p * per_pixel + c] = at(sums[c * tile_stride + p])

    @wp.func(inline=True)
    def store_channels(o: wp.int32, p: wp.int32, joined: wp.ref[tile_channels], rgb: Reals):
        """Store the channels of a pixel, whose first has the index ``o``."""
        for c in range(wp.static(channels)):
            rgb[o + c] = at(joined[p * per_pixel + c])

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def forward(
        begin: int, settings: f.Blending, projected: wp.array(dtype=b.record), ranges: IntRows, gaussian_ids: Ints,
        backgrounds: Rows,
        # outputs, and the distance of pixels in the first
        rgb: Reals, pitch: int, alpha_out: Reals, depth: Reals, transmittances: Reals, weights: Reals, ends: Ints,
    ):  # fmt: skip
        tile = begin + wp.tid()
        camera, left, top = f.place_of(tile, side, settings)

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
        g = b.Batch()
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
            for j in range(batch):
                g.limit[j] = real(-1.0)  # reaches nothing
            b.load(projected, gaussian_ids, first, 1, count, settings.whole_tiles, g)
            j = int(0)
            while j < count:
                o = j & bits
                j += 1
                for lane in range(strip):
                    ramp[o * strip + lane] = f.apart(at(g.u11[o]) * real(lane))
            left_open = int(0)
            for row in range(side):
                y = real(settings.origin_y + top + row) + real(0.5)
                for k in range(batch // side):  # of the next batch, or of the next tile
                    later = first + batch + row * (batch // side) + k
                    prefetch(projected, gaussian_ids[wp.min(later, gaussian_ids.shape[0] - 1)])
                group = int(0)
                while group < count:
                    o = group & bits
                    group += together
                    for lane in range(together):
                        dy = y - at(g.y[o + lane])
                        e2 = at(g.u22[o + lane]) * dy
                        e12[o + lane] = f.apart(at(g.u12[o + lane]) * dy)
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
                                start[j] = f.apart(at(g.u11[j]) * (x - at(g.x[j]))) + e12[j]
                                hits[j] = wp.where(
                                    f.reaches(start[j], at(g.u11[j]), e22[j], at(g.aside[j]), at(g.limit[j])), 1, 0
                                )
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
                                found = f.falloffs(wp.cw_mul(e1, e1) + e2_squared)
                                for n in range(abreast):
                                    raw = at(g.opacity[list[o + n] & bits]) * found[n]
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
                                add_channels(w, lane, j, g, strip_sums)
                                strip_z[lane] = strip_z[lane] + w * at(g.z[j])
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
                    if f.never(at_pixel):
                        break
                    store_channels(at_pixel, wp.max(p + lane, 0), joined, rgb)
                    lane += 1

    return forward
