"""The backward blending kernel in plain Warp, one task per tile: that of the CPU, and of float64 on every device."""

import functools

import warp as wp

from warpgs.constants import SMALLEST_WEIGHT
from warpgs.kernels.compiler import ROLLED
from warpgs.kernels.falloff import ABREAST, STRIP, make_functions

VALUES = 10
"""Number of gradient values of an instance."""


@functools.cache
def make_backward(real, tile_size: int):
    """Make the kernel for one scalar type and tile size."""
    f = make_functions(real)
    # The tile lies in columns as wide as a strip, one beside the other. One row longer than it: see `make_kernels`.
    count = tile_size * (tile_size // STRIP)
    tile_reals = wp.types.vector(tile_size * (tile_size + 1), real)
    tile_ints = wp.types.vector(tile_size * (tile_size + 1), wp.int32)
    list_reals = wp.types.vector(count, real)
    list_ints = wp.types.vector(count, wp.int32)
    row_reals = wp.types.vector(tile_size, real)
    strip_reals = wp.types.vector(STRIP, real)
    strip_sums = wp.types.vector(VALUES * STRIP, real)
    half_sums = wp.types.vector(VALUES * (STRIP // 2), real)
    value_reals = wp.types.vector(VALUES, real)
    side = wp.constant(tile_size)
    strips = wp.constant(count)
    bits = wp.constant(count - 1)
    strip = wp.constant(STRIP)
    half = wp.constant(STRIP // 2)
    parts = wp.constant(tile_size // STRIP)
    abreast = wp.constant(ABREAST)
    smallest = wp.constant(real(SMALLEST_WEIGHT))

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
        camera = place[0]
        left = place[1]
        top = place[2]

        # A Gaussian's whole effect on a pixel is one number d = c . v_rgb + z v_z + v_w (docs/blend.md, section 3).
        t = tile_reals()  # transmittance behind the current instance, then before it
        behind = tile_reals()  # sum of w d over what lies behind, background included
        g0 = tile_reals()
        g1 = tile_reals()
        g2 = tile_reals()
        v_z = tile_reals()
        v_w = tile_reals()
        end = tile_ints()
        strip_end = list_ints()
        instance = int(0)
        for row in range(wp.min(side, settings.height - top)):
            for column in range(wp.min(side, settings.width - left)):
                part = column // strip
                p = (part * side + row) * strip + column - part * strip
                o = (camera * settings.height + top + row) * settings.width + left + column
                t[p] = transmittances[o]
                g0[p] = v_rgb[o, 0]
                g1[p] = v_rgb[o, 1]
                g2[p] = v_rgb[o, 2]
                if weights[o] >= smallest:
                    v_z[p] = v_depth[o] / weights[o]
                    v_w[p] = -v_z[p] * depth[o]
                v_w[p] = v_w[p] + v_alpha[o]
                behind[p] = t[p] * (
                    backgrounds[camera, 0] * g0[p] + backgrounds[camera, 1] * g1[p] + backgrounds[camera, 2] * g2[p]
                )
                end[p] = ends[o]
                strip_end[part * side + row] = wp.max(strip_end[part * side + row], ends[o])
                instance = wp.max(instance, ends[o])

        # of a Gaussian, by strip; and the strips that it reaches
        dxs = list_reals()
        dys = list_reals()
        e22 = list_reals()
        start = list_reals()
        hits = list_ints()
        list = list_ints()
        alphas = tile_reals()
        inverses = tile_reals()
        slopes = tile_reals()
        vs = tile_reals()
        ws = tile_reals()
        row_dy = row_reals()
        row_e12 = row_reals()
        row_e22 = row_reals()
        e1 = f.abreast()
        e2_squared = f.abreast()
        ramp = strip_reals()
        s1 = strip_reals()
        s2 = strip_reals()
        s11 = strip_reals()
        s12 = strip_reals()
        s22 = strip_reals()
        so = strip_reals()
        s_c0 = strip_reals()
        s_c1 = strip_reals()
        s_c2 = strip_reals()
        sz = strip_reals()
        sums = strip_sums()
        halves = half_sums()
        totals = value_reals()
        ahead = real(0.0)
        if instance > ranges[tile, 0]:
            ahead = projected[gaussian_ids[instance - 1], 0]
        while instance > ranges[tile, 0]:
            instance -= 1
            i = gaussian_ids[instance]
            mx = ahead
            ahead = projected[gaussian_ids[wp.max(instance - 1, 0)], 0]  # loaded early, as it may be far away
            my = projected[i, 1]
            u11 = projected[i, 2]
            u12 = projected[i, 3]
            u22 = projected[i, 4]
            opacity = projected[i, 5]
            c0 = projected[i, 6]
            c1 = projected[i, 7]
            c2 = projected[i, 8]
            distance = projected[i, 9]
            bounds = f.bounds_of(mx, my, u11, u22, projected[i, 10], projected[i, 11], settings.whole_tiles)
            for row in range(side):
                dy = real(settings.origin_y + top + row) + real(0.5) - my
                e2 = u22 * dy
                row_dy[row] = dy
                row_e12[row] = f.apart(u12 * dy)
                row_e22[row] = f.apart(e2 * e2)
            for part in range(parts):
                dx = real(settings.origin_x + left + part * strip) + real(0.5) - mx
                at = f.apart(u11 * dx)
                for row in range(side):
                    o = part * side + row
                    dxs[o] = dx
                    dys[o] = row_dy[row]
                    e22[o] = row_e22[row]
                    start[o] = at + row_e12[row]
                    until = strip_end[o]
                    hit = f.reaches(start[o], u11, e22[o], bounds[0], bounds[1]) and instance < until
                    hits[o] = wp.where(hit, 1, 0)
            reaching = int(0)
            for o in range(strips):  # without a branch, which would be mispredicted once for each row or so
                list[reaching & bits] = o
                reaching += hits[o]
            for lane in range(strip):
                ramp[lane] = f.apart(u11 * real(lane))
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
            k = int(0)
            while k < reaching:
                base = wp.max(k, 0)
                k += abreast  # the last few may not be reached; their values are not read
                for lane in range(strip):
                    for n in range(abreast):
                        o = list[base + n] & bits
                        e1[n] = start[o] + ramp[lane]
                        e2_squared[n] = e22[o]
                    g = f.falloffs(wp.cw_mul(e1, e1) + e2_squared)
                    for n in range(abreast):
                        q = (base + n) * strip + lane
                        raw = opacity * g[n]
                        alpha = wp.where(settings.alpha_max < raw, settings.alpha_max, raw)
                        until = end[(list[base + n] & bits) * strip + lane]
                        blended = alpha >= settings.alpha_cut and instance < until
                        alpha = wp.where(blended, alpha, real(0.0))
                        alphas[q] = alpha
                        inverses[q] = real(1.0) / (real(1.0) - alpha)
                        slopes[q] = wp.where(blended and raw <= settings.alpha_max, g[n], real(0.0))
            k = int(0)
            while k < reaching:
                base = wp.max(k, 0) * strip
                o = list[wp.max(k, 0)] & bits
                k += 1
                for lane in range(strip):
                    p = o * strip + lane
                    q = base + lane
                    d = c0 * g0[p] + c1 * g1[p] + c2 * g2[p] + distance * v_z[p] + v_w[p]
                    before = t[p] * inverses[q]
                    w = alphas[q] * before
                    vs[q] = (t[p] * d - behind[p]) * inverses[q] * slopes[q]
                    ws[q] = w
                    t[p] = before
                    behind[p] = behind[p] + w * d
            # Apart from the loop above, because what both need does not fit into 16 registers.
            k = int(0)
            while k < reaching:
                base = wp.max(k, 0) * strip
                o = list[wp.max(k, 0)] & bits
                k += 1
                dx = dxs[o]
                dy = dys[o]
                for lane in range(strip):
                    p = o * strip + lane
                    v = vs[base + lane]
                    w = ws[base + lane]
                    v_e1 = v * (start[o] + ramp[lane])
                    v_y = v * dy
                    s1[lane] = s1[lane] + v_e1
                    s2[lane] = s2[lane] + v_y
                    s11[lane] = s11[lane] + v_e1 * (dx + real(lane))
                    s12[lane] = s12[lane] + v_e1 * dy
                    s22[lane] = s22[lane] + v_y * dy
                    so[lane] = so[lane] + v
                    s_c0[lane] = s_c0[lane] + w * g0[p]
                    s_c1[lane] = s_c1[lane] + w * g1[p]
                    s_c2[lane] = s_c2[lane] + w * g2[p]
                    sz[lane] = sz[lane] + w * v_z[p]
            # Into one array per width, because additions vectorise only where nothing may overlap.
            for lane in range(strip):
                sums[0 * strip + lane] = s1[lane]
                sums[1 * strip + lane] = s2[lane]
                sums[2 * strip + lane] = s11[lane]
                sums[3 * strip + lane] = s12[lane]
                sums[4 * strip + lane] = s22[lane]
                sums[5 * strip + lane] = so[lane]
                sums[6 * strip + lane] = s_c0[lane]
                sums[7 * strip + lane] = s_c1[lane]
                sums[8 * strip + lane] = s_c2[lane]
                sums[9 * strip + lane] = sz[lane]
            for k in range(VALUES):
                for lane in range(half):
                    halves[k * half + lane] = sums[k * strip + lane] + sums[k * strip + half + lane]
            for k in range(VALUES):
                o = k * half
                totals[k] = (halves[o] + halves[o + 2]) + (halves[o + 1] + halves[o + 3])
            slot = slots[instance]
            v_e1 = opacity * totals[0]
            v_e2 = opacity * u22 * totals[1]
            v_slots[slot, 0] = u11 * v_e1
            v_slots[slot, 1] = u12 * v_e1 + u22 * v_e2
            v_slots[slot, 2] = -opacity * totals[2]
            v_slots[slot, 3] = -opacity * totals[3]
            v_slots[slot, 4] = -opacity * u22 * totals[4]
            for k in range(5, VALUES):
                v_slots[slot, k] = totals[k]

    return backward
