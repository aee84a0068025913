"""Blending kernels in plain Warp, one task per tile: the CPU's kernels, and the float64 kernels on every device.

A task walks the Gaussians of its tile and, for each, the pixel rows its box touches. The innermost loop runs over the
pixels of a row without branches and is kept rolled, so that the compiler vectorises it (docs/blend.md, section 5).
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.kernels.compiler import ROLLED

VALUES = 10
"""Gradient values of an instance."""
STOP_CHECK = 8
"""Gaussians between two looks at whether any pixel of the tile is still open."""


@functools.cache
def make_falloff(real):
    """exp(-x / 2) for x >= 0. In float32 by a polynomial, because a call to the C library would not vectorise."""
    if real is wp.float64:

        @wp.func
        def falloff64(x: real) -> real:
            return wp.exp(real(-0.5) * x)

        return falloff64

    @wp.func
    def falloff32(x: real) -> real:
        # exp(-x / 2) = 2^n 2^f, |f| <= 1/2. Adding 1.5 * 2^23 rounds to an integer and leaves it in the low bits.
        # The bound keeps the result, times any opacity that can be seen, a normal number: others are slow.
        y = wp.max(x * real(-0.7213475204444817), real(-110.0))
        shifted = y + real(12582912.0)
        f = y - (shifted - real(12582912.0))
        # minimax polynomial of 2^f by relative error, 9.2e-8, with constant term 1
        p = real(1.3264726641879386e-3)
        p = p * f + real(9.671512958571476e-3)
        p = p * f + real(5.550733747694458e-2)
        p = p * f + real(2.4022242080135733e-1)
        p = p * f + real(6.931469775948987e-1)
        p = p * f + real(1.0)
        # 2^n by adding n to the exponent bits
        return wp.cast(wp.cast(p, wp.int32) + (wp.cast(shifted, wp.int32) << 23), wp.float32)

    return falloff32


@functools.cache
def make_kernels(real, tile_size: int):
    """Forward, backward and contribution kernels for one scalar type and tile size."""
    falloff = make_falloff(real)
    vec2i = wp.types.vector(2, wp.int32)
    # Vectors rather than local arrays: the compiler must see that they do not overlap.
    tile_reals = wp.types.vector(tile_size * tile_size, real)
    tile_ints = wp.types.vector(tile_size * tile_size, wp.int32)
    row_reals = wp.types.vector(tile_size, real)
    side_sums = wp.types.vector(VALUES * tile_size, real)
    half_sums = wp.types.vector(VALUES * (tile_size // 2), real)
    value_reals = wp.types.vector(VALUES, real)
    half = wp.constant(tile_size // 2)
    side = wp.constant(tile_size)
    pixels = wp.constant(tile_size * tile_size)

    @wp.func
    def rows_of(my: real, half_height: real, whole_tiles: wp.int32, top: wp.int32) -> vec2i:
        """Rows of the tile, counted from its top, whose pixel centres may lie in the Gaussian's box."""
        if whole_tiles != 0:
            return vec2i(0, side)
        margin = real(0.01) + real(2.0e-6) * (wp.abs(my) + half_height)
        center = my - real(top) - real(0.5)
        first = wp.ceil(wp.clamp(center - half_height - margin, real(0.0), real(side)))
        last = wp.floor(wp.clamp(center + half_height + margin, real(-1.0), real(side) - real(1.0)))
        return vec2i(int(first), int(last) + 1)

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def forward(
        begin: int, splats: wp.array2d(dtype=real), ranges: wp.array2d(dtype=int), splat_ids: wp.array(dtype=int),
        backgrounds: wp.array2d(dtype=real), width: int, height: int, columns: int, tiles: int,
        alpha_cut: real, alpha_max: real, whole_tiles: int, stop: real, inclusive: int,
        # outputs
        rgb: wp.array2d(dtype=real), alpha_out: wp.array(dtype=real), depth: wp.array(dtype=real),
        transmittances: wp.array(dtype=real), weights: wp.array(dtype=real), ends: wp.array(dtype=int),
    ):  # fmt: skip
        tile = begin + wp.tid()
        camera = tile // tiles
        in_camera = tile - camera * tiles
        top = (in_camera // columns) * side
        left = (in_camera - (in_camera // columns) * columns) * side

        t = tile_reals()  # transmittance
        red = tile_reals()
        green = tile_reals()
        blue = tile_reals()
        z = tile_reals()
        total = tile_reals()
        ux = row_reals()  # u11 dx
        end = tile_ints()  # one past the last instance blended
        for p in range(pixels):
            # pixels outside the image are finished before they begin
            inside = top + p // side < height and left + p - (p // side) * side < width
            t[p] = wp.where(inside, real(1.0), real(-1.0))

        # inclusive: blend, then stop; exclusive: stop instead of blending
        leave = wp.where(inclusive != 0, real(-1.0), stop)
        first = ranges[tile, 0]
        last = ranges[tile, 1]
        instance = first
        while instance < last:
            i = splat_ids[instance]
            mx = splats[i, 0]
            my = splats[i, 1]
            u11 = splats[i, 2]
            u12 = splats[i, 3]
            u22 = splats[i, 4]
            opacity = splats[i, 5]
            c0 = splats[i, 6]
            c1 = splats[i, 7]
            c2 = splats[i, 8]
            distance = splats[i, 9]
            rows = rows_of(my, splats[i, 11], whole_tiles, top)
            x0 = real(left) + real(0.5) - mx
            for lane in range(side):
                ux[lane] = u11 * (x0 + real(lane))
            for row in range(rows[0], rows[1]):
                dy = real(top + row) + real(0.5) - my
                e12 = u12 * dy
                e2 = u22 * dy
                e22 = e2 * e2
                base = wp.max(row * side, 0)
                for lane in range(side):
                    p = base + lane
                    e1 = ux[lane] + e12
                    raw = opacity * falloff(e1 * e1 + e22)
                    alpha = wp.where(alpha_max < raw, alpha_max, raw)
                    before = t[p]
                    drawn = alpha >= alpha_cut and before >= stop
                    blended = drawn and before * (real(1.0) - alpha) >= leave
                    alpha = wp.where(blended, alpha, real(0.0))
                    w = alpha * before
                    t[p] = before * wp.where(drawn and not blended, real(-1.0), real(1.0) - alpha)
                    end[p] = wp.max(end[p], wp.where(blended, instance + 1, 0))
                    red[p] = red[p] + w * c0
                    green[p] = green[p] + w * c1
                    blue[p] = blue[p] + w * c2
                    z[p] = z[p] + w * distance
                    total[p] = total[p] + w
            instance += 1
            if (instance - first) % STOP_CHECK == 0:
                left_open = int(0)
                for p in range(pixels):
                    left_open += wp.where(t[p] >= stop, 1, 0)
                if left_open == 0:
                    instance = last

        for row in range(wp.min(side, height - top)):
            for lane in range(wp.min(side, width - left)):
                p = row * side + lane
                o = (camera * height + top + row) * width + left + lane
                t[p] = wp.abs(t[p])
                rgb[o, 0] = red[p] + t[p] * backgrounds[camera, 0]
                rgb[o, 1] = green[p] + t[p] * backgrounds[camera, 1]
                rgb[o, 2] = blue[p] + t[p] * backgrounds[camera, 2]
                alpha_out[o] = real(1.0) - t[p]
                depth[o] = wp.where(total[p] > real(0.0), z[p] / total[p], real(0.0))
                transmittances[o] = t[p]
                weights[o] = total[p]
                ends[o] = end[p]

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def backward(
        begin: int, splats: wp.array2d(dtype=real), ranges: wp.array2d(dtype=int), splat_ids: wp.array(dtype=int),
        slots: wp.array(dtype=int), backgrounds: wp.array2d(dtype=real), width: int, height: int, columns: int, tiles: int,
        alpha_cut: real, alpha_max: real, whole_tiles: int,
        transmittances: wp.array(dtype=real), weights: wp.array(dtype=real), depth: wp.array(dtype=real),
        ends: wp.array(dtype=int),
        v_rgb: wp.array2d(dtype=real), v_alpha: wp.array(dtype=real), v_depth: wp.array(dtype=real),
        # outputs, zero on entry
        v_slots: wp.array2d(dtype=real),
    ):  # fmt: skip
        tile = begin + wp.tid()
        camera = tile // tiles
        in_camera = tile - camera * tiles
        top = (in_camera // columns) * side
        left = (in_camera - (in_camera // columns) * columns) * side

        # A Gaussian's whole effect on a pixel is one number d = c . v_rgb + z v_z + v_w (docs/blend.md, section 3).
        t = tile_reals()  # transmittance behind the current instance, then before it
        behind = tile_reals()  # sum of w d over what lies behind, background included
        g0 = tile_reals()
        g1 = tile_reals()
        g2 = tile_reals()
        v_z = tile_reals()
        v_w = tile_reals()
        end = tile_ints()
        instance = int(0)
        for row in range(wp.min(side, height - top)):
            for lane in range(wp.min(side, width - left)):
                p = row * side + lane
                o = (camera * height + top + row) * width + left + lane
                t[p] = transmittances[o]
                g0[p] = v_rgb[o, 0]
                g1[p] = v_rgb[o, 1]
                g2[p] = v_rgb[o, 2]
                if weights[o] > real(0.0):
                    v_z[p] = v_depth[o] / weights[o]
                    v_w[p] = -v_z[p] * depth[o]
                v_w[p] = v_w[p] + v_alpha[o]
                behind[p] = t[p] * (
                    backgrounds[camera, 0] * g0[p] + backgrounds[camera, 1] * g1[p] + backgrounds[camera, 2] * g2[p]
                )
                end[p] = ends[o]
                instance = wp.max(instance, ends[o])

        ux = row_reals()
        s1 = row_reals()
        s2 = row_reals()
        s11 = row_reals()
        s12 = row_reals()
        s22 = row_reals()
        so = row_reals()
        s_c0 = row_reals()
        s_c1 = row_reals()
        s_c2 = row_reals()
        sz = row_reals()
        sums = side_sums()
        halves = half_sums()
        totals = value_reals()
        while instance > ranges[tile, 0]:
            instance -= 1
            i = splat_ids[instance]
            mx = splats[i, 0]
            my = splats[i, 1]
            u11 = splats[i, 2]
            u12 = splats[i, 3]
            u22 = splats[i, 4]
            opacity = splats[i, 5]
            c0 = splats[i, 6]
            c1 = splats[i, 7]
            c2 = splats[i, 8]
            distance = splats[i, 9]
            rows = rows_of(my, splats[i, 11], whole_tiles, top)
            x0 = real(left) + real(0.5) - mx
            for lane in range(side):
                ux[lane] = u11 * (x0 + real(lane))
                s1[lane] = real(0.0)
                s2[lane] = real(0.0)
                s11[lane] = real(0.0)
                s12[lane] = real(0.0)
                s22[lane] = real(0.0)
                so[lane] = real(0.0)
                s_c0[lane] = real(0.0)
                s_c1[lane] = real(0.0)
                s_c2[lane] = real(0.0)
                sz[lane] = real(0.0)
            for row in range(rows[0], rows[1]):
                dy = real(top + row) + real(0.5) - my
                e12 = u12 * dy
                e2 = u22 * dy
                e22 = e2 * e2
                e2y = e2 * dy
                base = wp.max(row * side, 0)
                for lane in range(side):
                    p = base + lane
                    dx = x0 + real(lane)
                    e1 = ux[lane] + e12
                    g = falloff(e1 * e1 + e22)
                    raw = opacity * g
                    alpha = wp.where(alpha_max < raw, alpha_max, raw)
                    drawn = alpha >= alpha_cut and instance < end[p]
                    alpha = wp.where(drawn, alpha, real(0.0))
                    inverse = real(1.0) / (real(1.0) - alpha)
                    before = t[p] * inverse
                    w = alpha * before
                    d = c0 * g0[p] + c1 * g1[p] + c2 * g2[p] + distance * v_z[p] + v_w[p]
                    v = before * d - behind[p] * inverse
                    v = wp.where(drawn and raw <= alpha_max, v * g, real(0.0))
                    t[p] = before
                    behind[p] = behind[p] + w * d
                    v_e1 = v * e1
                    s1[lane] = s1[lane] + v_e1
                    s2[lane] = s2[lane] + v * e2
                    s11[lane] = s11[lane] + v_e1 * dx
                    s12[lane] = s12[lane] + v_e1 * dy
                    s22[lane] = s22[lane] + v * e2y
                    so[lane] = so[lane] + v
                    s_c0[lane] = s_c0[lane] + w * g0[p]
                    s_c1[lane] = s_c1[lane] + w * g1[p]
                    s_c2[lane] = s_c2[lane] + w * g2[p]
                    sz[lane] = sz[lane] + w * v_z[p]
            # Into one array per width, because additions vectorise only where nothing may overlap.
            for lane in range(side):
                sums[0 * side + lane] = s1[lane]
                sums[1 * side + lane] = s2[lane]
                sums[2 * side + lane] = s11[lane]
                sums[3 * side + lane] = s12[lane]
                sums[4 * side + lane] = s22[lane]
                sums[5 * side + lane] = so[lane]
                sums[6 * side + lane] = s_c0[lane]
                sums[7 * side + lane] = s_c1[lane]
                sums[8 * side + lane] = s_c2[lane]
                sums[9 * side + lane] = sz[lane]
            for k in range(VALUES):
                for lane in range(half):
                    halves[k * half + lane] = sums[k * side + lane] + sums[k * side + half + lane]
            for k in range(VALUES):
                o = k * half
                if wp.static(tile_size == 16):
                    even = (halves[o] + halves[o + 4]) + (halves[o + 2] + halves[o + 6])
                    odd = (halves[o + 1] + halves[o + 5]) + (halves[o + 3] + halves[o + 7])
                    totals[k] = even + odd
                else:
                    rest = halves[o]
                    for lane in range(1, half):
                        rest += halves[o + lane]
                    totals[k] = rest
            slot = slots[instance]
            v_e1 = opacity * totals[0]
            v_e2 = opacity * totals[1]
            v_slots[slot, 0] = u11 * v_e1
            v_slots[slot, 1] = u12 * v_e1 + u22 * v_e2
            v_slots[slot, 2] = -opacity * totals[2]
            v_slots[slot, 3] = -opacity * totals[3]
            v_slots[slot, 4] = -opacity * totals[4]
            for k in range(5, VALUES):
                v_slots[slot, k] = totals[k]

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def contributions(
        begin: int, splats: wp.array2d(dtype=real), ranges: wp.array2d(dtype=int), splat_ids: wp.array(dtype=int),
        slots: wp.array(dtype=int), width: int, height: int, columns: int, tiles: int,
        alpha_cut: real, alpha_max: real, whole_tiles: int, ends: wp.array(dtype=int),
        # outputs, zero on entry: sum and maximum of the weight of each instance
        weights: wp.array2d(dtype=real),
    ):  # fmt: skip
        tile = begin + wp.tid()
        camera = tile // tiles
        in_camera = tile - camera * tiles
        top = (in_camera // columns) * side
        left = (in_camera - (in_camera // columns) * columns) * side
        ux = row_reals()
        t = tile_reals()
        end = tile_ints()
        last = int(0)
        for row in range(wp.min(side, height - top)):
            for lane in range(wp.min(side, width - left)):
                p = row * side + lane
                t[p] = real(1.0)
                end[p] = ends[(camera * height + top + row) * width + left + lane]
                last = wp.max(last, end[p])
        for instance in range(ranges[tile, 0], last):
            i = splat_ids[instance]
            rows = rows_of(splats[i, 1], splats[i, 11], whole_tiles, top)
            x0 = real(left) + real(0.5) - splats[i, 0]
            for lane in range(side):
                ux[lane] = splats[i, 2] * (x0 + real(lane))
            weight_sum = real(0.0)
            weight_max = real(0.0)
            for row in range(rows[0], rows[1]):
                dy = real(top + row) + real(0.5) - splats[i, 1]
                e12 = splats[i, 3] * dy
                e2 = splats[i, 4] * dy
                for lane in range(side):
                    p = row * side + lane
                    e1 = ux[lane] + e12
                    alpha = wp.min(alpha_max, splats[i, 5] * falloff(e1 * e1 + e2 * e2))
                    if alpha >= alpha_cut and instance < end[p]:
                        w = alpha * t[p]
                        t[p] = t[p] * (real(1.0) - alpha)
                        weight_sum += w
                        weight_max = wp.max(weight_max, w)
            weights[slots[instance], 0] = weight_sum
            weights[slots[instance], 1] = weight_max

    return SimpleNamespace(forward=forward, backward=backward, contributions=contributions)
