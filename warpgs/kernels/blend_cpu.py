"""Blending kernels in plain Warp, one task per tile: the CPU's kernels, and the float64 kernels on every device.

A task walks the Gaussians of its tile and, for each, the pixel rows its box touches. The innermost loop runs over the
pixels of a row without branches and is kept rolled, so that the compiler vectorises it (docs/blend.md, section 5).
"""

import functools
from types import SimpleNamespace

import warp as wp

STOP_CHECK = 8
"""Gaussians between two looks at whether any pixel of the tile is still open."""


@functools.cache
def make_exp(real):
    """exp(x) for x <= 0. In float32 by a polynomial, because a call to the C library would not vectorise."""
    if real is wp.float64:

        @wp.func
        def exp64(x: real) -> real:
            return wp.exp(x)

        return exp64

    @wp.func
    def exp32(x: real) -> real:
        # x = n ln 2 + r, |r| <= ln 2 / 2. Adding 1.5 * 2^23 rounds to an integer and leaves it in the low bits.
        x = wp.max(x, real(-87.0))
        shifted = x * real(1.4426950408889634) + real(12582912.0)
        n = shifted - real(12582912.0)
        r = (x - n * real(0.693359375)) - n * real(-2.12194440e-4)  # ln 2 in two parts, the first exact in 10 bits
        # minimax polynomial of (exp(r) - 1 - r) / r^2 on |r| <= ln 2 / 2 (Moshier, Cephes expf)
        p = real(1.9875691500e-4)
        p = p * r + real(1.3981999507e-3)
        p = p * r + real(8.3334519073e-3)
        p = p * r + real(4.1665795894e-2)
        p = p * r + real(1.6666665459e-1)
        p = p * r + real(5.0000001201e-1)
        p = (p * r) * r + r + real(1.0)
        # 2^n by adding n to the exponent bits
        return wp.cast(wp.cast(p, wp.int32) + (wp.cast(shifted, wp.int32) << 23), wp.float32)

    return exp32


@functools.cache
def make_kernels(real, tile_size: int):
    """Forward, backward and contribution kernels for one scalar type and tile size."""
    exp = make_exp(real)
    vec2i = wp.types.vector(2, wp.int32)
    # Vectors rather than local arrays: the compiler must see that they do not overlap.
    tile_reals = wp.types.vector(tile_size * tile_size, real)
    tile_ints = wp.types.vector(tile_size * tile_size, wp.int32)
    row_reals = wp.types.vector(tile_size, real)
    side = wp.constant(tile_size)
    pixels = wp.constant(tile_size * tile_size)
    options = {"max_unroll": 0}  # Warp would unroll the pixel loop, and unrolled it does not vectorise

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

    @wp.func
    def gaussian(u11: real, u22: real, dx: real, e12: real, e2: real) -> real:
        """exp(-|U d|^2 / 2); e12 = u12 dy and e2 = u22 dy are the same for a row. Never above 1."""
        e1 = u11 * dx + e12
        return exp(real(-0.5) * (e1 * e1 + e2 * e2))

    @wp.kernel(enable_backward=False, module="unique", module_options=options)
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
        open = tile_ints()  # 1 until the pixel stops
        end = tile_ints()  # one past the last instance blended
        for p in range(pixels):
            t[p] = real(1.0)
            # pixels outside the image are finished before they begin
            if top + p // side < height and left + p - (p // side) * side < width:
                open[p] = 1

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
            for row in range(rows[0], rows[1]):
                dy = real(top + row) + real(0.5) - my
                e12 = u12 * dy
                e2 = u22 * dy
                for lane in range(side):
                    p = row * side + lane
                    alpha = wp.min(alpha_max, opacity * gaussian(u11, u22, x0 + real(lane), e12, e2))
                    before = t[p]
                    after = before * (real(1.0) - alpha)
                    drawn = wp.where(alpha >= alpha_cut, open[p], 0)
                    stays = wp.where(after >= stop, 1, 0)
                    # inclusive: blend, then stop; exclusive: stop instead of blending
                    blended = wp.where(inclusive + stays > 0, drawn, 0)
                    open[p] = wp.where(drawn == 1, stays, open[p])
                    w = wp.where(blended == 1, alpha * before, real(0.0))
                    t[p] = wp.where(blended == 1, after, before)
                    end[p] = wp.where(blended == 1, instance + 1, end[p])
                    red[p] = red[p] + w * c0
                    green[p] = green[p] + w * c1
                    blue[p] = blue[p] + w * c2
                    z[p] = z[p] + w * distance
                    total[p] = total[p] + w
            instance += 1
            if (instance - first) % STOP_CHECK == 0:
                left_open = int(0)
                for p in range(pixels):
                    left_open += open[p]
                if left_open == 0:
                    instance = last

        for row in range(wp.min(side, height - top)):
            for lane in range(wp.min(side, width - left)):
                p = row * side + lane
                o = (camera * height + top + row) * width + left + lane
                rgb[o, 0] = red[p] + t[p] * backgrounds[camera, 0]
                rgb[o, 1] = green[p] + t[p] * backgrounds[camera, 1]
                rgb[o, 2] = blue[p] + t[p] * backgrounds[camera, 2]
                alpha_out[o] = real(1.0) - t[p]
                depth[o] = wp.where(total[p] > real(0.0), z[p] / total[p], real(0.0))
                transmittances[o] = t[p]
                weights[o] = total[p]
                ends[o] = end[p]

    @wp.kernel(enable_backward=False, module="unique", module_options=options)
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
                for lane in range(side):
                    p = row * side + lane
                    dx = x0 + real(lane)
                    g = gaussian(u11, u22, dx, e12, e2)
                    raw = opacity * g
                    alpha = wp.min(alpha_max, raw)
                    drawn = wp.where(alpha >= alpha_cut, wp.where(instance < end[p], 1, 0), 0)
                    inverse = real(1.0) / (real(1.0) - alpha)
                    before = wp.where(drawn == 1, t[p] * inverse, t[p])
                    w = wp.where(drawn == 1, alpha * before, real(0.0))
                    d = c0 * g0[p] + c1 * g1[p] + c2 * g2[p] + distance * v_z[p] + v_w[p]
                    v = wp.where(drawn == 1, before * d - behind[p] * inverse, real(0.0))
                    v = wp.where(raw <= alpha_max, v, real(0.0))
                    t[p] = before
                    behind[p] = behind[p] + w * d
                    v_q = -raw * v  # q = |U d|^2 / 2
                    v_e1 = v_q * (u11 * dx + e12)
                    v_e2 = v_q * e2
                    s1[lane] = s1[lane] + v_e1
                    s2[lane] = s2[lane] + v_e2
                    s11[lane] = s11[lane] + v_e1 * dx
                    s12[lane] = s12[lane] + v_e1 * dy
                    s22[lane] = s22[lane] + v_e2 * dy
                    so[lane] = so[lane] + v * g
                    s_c0[lane] = s_c0[lane] + w * g0[p]
                    s_c1[lane] = s_c1[lane] + w * g1[p]
                    s_c2[lane] = s_c2[lane] + w * g2[p]
                    sz[lane] = sz[lane] + w * v_z[p]
            half = side // 2
            while half > 0:  # pairwise, so that the sums vectorise too
                for lane in range(half):
                    s1[lane] = s1[lane] + s1[lane + half]
                    s2[lane] = s2[lane] + s2[lane + half]
                    s11[lane] = s11[lane] + s11[lane + half]
                    s12[lane] = s12[lane] + s12[lane + half]
                    s22[lane] = s22[lane] + s22[lane + half]
                    so[lane] = so[lane] + so[lane + half]
                    s_c0[lane] = s_c0[lane] + s_c0[lane + half]
                    s_c1[lane] = s_c1[lane] + s_c1[lane + half]
                    s_c2[lane] = s_c2[lane] + s_c2[lane + half]
                    sz[lane] = sz[lane] + sz[lane + half]
                half = half // 2
            slot = slots[instance]
            v_slots[slot, 0] = -u11 * s1[0]
            v_slots[slot, 1] = -(u12 * s1[0] + u22 * s2[0])
            v_slots[slot, 2] = s11[0]
            v_slots[slot, 3] = s12[0]
            v_slots[slot, 4] = s22[0]
            v_slots[slot, 5] = so[0]
            v_slots[slot, 6] = s_c0[0]
            v_slots[slot, 7] = s_c1[0]
            v_slots[slot, 8] = s_c2[0]
            v_slots[slot, 9] = sz[0]

    @wp.kernel(enable_backward=False, module="unique", module_options=options)
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
            weight_sum = real(0.0)
            weight_max = real(0.0)
            for row in range(rows[0], rows[1]):
                dy = real(top + row) + real(0.5) - splats[i, 1]
                for lane in range(side):
                    p = row * side + lane
                    g = gaussian(splats[i, 2], splats[i, 4], x0 + real(lane), splats[i, 3] * dy, splats[i, 4] * dy)
                    alpha = wp.min(alpha_max, splats[i, 5] * g)
                    if alpha >= alpha_cut and instance < end[p]:
                        w = alpha * t[p]
                        t[p] = t[p] * (real(1.0) - alpha)
                        weight_sum += w
                        weight_max = wp.max(weight_max, w)
            weights[slots[instance], 0] = weight_sum
            weights[slots[instance], 1] = weight_max

    return SimpleNamespace(forward=forward, backward=backward, contributions=contributions)
