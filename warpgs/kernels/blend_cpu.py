"""Blending kernels in plain Warp, one task per tile: the CPU's kernels, and the float64 kernels on every device.

A task walks the Gaussians of its tile and, for each, the pixel rows its box touches. The innermost loop runs over the
pixels of a row without branches and is kept rolled, so that the compiler vectorises it (docs/blend.md, section 5).
"""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.kernels.compiler import ROLLED
from warpgs.kernels.falloff import make_functions

VALUES = 10
"""Gradient values of an instance."""
BATCH = 32
"""Gaussians that the forward pass takes at a time, row by row; between batches it looks for pixels still open."""


@functools.cache
def make_kernels(real, tile_size: int):
    """Forward, backward and contribution kernels for one scalar type and tile size."""
    f = make_functions(real, tile_size)
    # Vectors rather than local arrays: the compiler must see that they do not overlap. One row longer than the tile, so that
    # they do not lie 4096 bytes apart, where a load is taken to wait for a store to the other.
    tile_reals = wp.types.vector(tile_size * (tile_size + 1), real)
    tile_ints = wp.types.vector(tile_size * (tile_size + 1), wp.int32)
    row_reals = wp.types.vector(tile_size, real)
    row_ints = wp.types.vector(tile_size, wp.int32)
    batch_values = wp.types.vector(10 * BATCH, real)
    batch_ints = wp.types.vector(BATCH, wp.int32)
    side_sums = wp.types.vector(VALUES * tile_size, real)
    half_sums = wp.types.vector(VALUES * (tile_size // 2), real)
    value_reals = wp.types.vector(VALUES, real)
    half = wp.constant(tile_size // 2)
    side = wp.constant(tile_size)
    pixels = wp.constant(tile_size * tile_size)

    @wp.kernel(enable_backward=False, module="unique", module_options=ROLLED)
    def forward(
        begin: int, splats: wp.array2d(dtype=real), ranges: wp.array2d(dtype=int), splat_ids: wp.array(dtype=int),
        backgrounds: wp.array2d(dtype=real), origin_x: int, origin_y: int, width: int, height: int, columns: int, tiles: int,
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

        # The state of the tile: transmittance, below ``stop`` once the pixel is finished, negative where it was finished
        # before a Gaussian instead of by one; sums; one past the last instance blended.
        t = tile_reals()
        red = tile_reals()
        green = tile_reals()
        blue = tile_reals()
        z = tile_reals()
        total = tile_reals()
        end = tile_ints()
        for p in range(pixels):
            # pixels outside the image are finished before they begin
            inside = top + p // side < height and left + p - (p // side) * side < width
            t[p] = wp.where(inside, real(1.0), real(-1.0))
        # The same for one row, in registers, and the Gaussians of a batch: values, u11 dx, and by row which of them reach it.
        row_t = row_reals()
        row_red = row_reals()
        row_green = row_reals()
        row_blue = row_reals()
        row_z = row_reals()
        row_total = row_reals()
        row_end = row_ints()
        values = batch_values()
        tops = batch_ints()
        bottoms = batch_ints()
        list = batch_ints()

        # inclusive: blend, then stop; exclusive: stop instead of blending
        leave = wp.where(inclusive != 0, real(-1.0), stop)
        last = ranges[tile, 1]
        first = ranges[tile, 0]
        while first < last:
            for j in range(BATCH):
                tops[j] = side  # reaches no row
            j = int(0)
            while j < wp.min(BATCH, last - first):
                i = splat_ids[wp.max(first + j, 0)]
                if i < 0:
                    break  # never; but a loop that may end early is not vectorised, which here would mean slow gathers
                for k in range(10):
                    values[j * 10 + k] = splats[i, k]
                rows = f.rows_of(splats[i, 1], splats[i, 11], whole_tiles, origin_y + top)
                tops[j] = rows[0]
                bottoms[j] = rows[1]
                j += 1
            left_open = int(0)
            for row in range(side):
                base = wp.max(row * side, 0)
                row_open = int(0)
                for lane in range(side):
                    row_t[lane] = t[base + lane]
                    row_open += wp.where(row_t[lane] >= stop, 1, 0)
                if row_open > 0:
                    reaching = int(0)
                    for j in range(BATCH):  # without a branch, which would be mispredicted once for each Gaussian
                        list[wp.max(reaching, 0)] = j
                        reaching += wp.where(row >= tops[j], wp.where(row < bottoms[j], 1, 0), 0)
                    for lane in range(side):
                        row_red[lane] = red[base + lane]
                        row_green[lane] = green[base + lane]
                        row_blue[lane] = blue[base + lane]
                        row_z[lane] = z[base + lane]
                        row_total[lane] = total[base + lane]
                        row_end[lane] = end[base + lane]
                    k = int(0)
                    while k < reaching:
                        j = list[wp.max(k, 0)]
                        k += 1
                        v = wp.max(j * 10, 0)
                        x0 = real(origin_x + left) + real(0.5) - values[v]
                        dy = real(origin_y + top + row) + real(0.5) - values[v + 1]
                        u11 = values[v + 2]
                        e12 = values[v + 3] * dy
                        e2 = values[v + 4] * dy
                        e22 = e2 * e2
                        opacity = values[v + 5]
                        c0 = values[v + 6]
                        c1 = values[v + 7]
                        c2 = values[v + 8]
                        distance = values[v + 9]
                        number = first + j + 1
                        for lane in range(side):
                            e1 = f.apart(u11 * (x0 + real(lane))) + e12
                            raw = opacity * f.falloff(e1 * e1 + e22)
                            alpha = wp.where(alpha_max < raw, alpha_max, raw)
                            before = row_t[lane]
                            drawn = alpha >= alpha_cut and before >= stop
                            blended = drawn and before * (real(1.0) - alpha) >= leave
                            alpha = wp.where(blended, alpha, real(0.0))
                            w = alpha * before
                            row_t[lane] = before * wp.where(drawn and not blended, real(-1.0), real(1.0) - alpha)
                            row_end[lane] = wp.max(row_end[lane], wp.where(blended, number, 0))
                            row_red[lane] = row_red[lane] + w * c0
                            row_green[lane] = row_green[lane] + w * c1
                            row_blue[lane] = row_blue[lane] + w * c2
                            row_z[lane] = row_z[lane] + w * distance
                            row_total[lane] = row_total[lane] + w
                    for lane in range(side):
                        t[base + lane] = row_t[lane]
                        red[base + lane] = row_red[lane]
                        green[base + lane] = row_green[lane]
                        blue[base + lane] = row_blue[lane]
                        z[base + lane] = row_z[lane]
                        total[base + lane] = row_total[lane]
                        end[base + lane] = row_end[lane]
                left_open += row_open
            first += BATCH
            if left_open == 0:
                first = last

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
        slots: wp.array(dtype=int), backgrounds: wp.array2d(dtype=real),
        origin_x: int, origin_y: int, width: int, height: int, columns: int, tiles: int,
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
            rows = f.rows_of(my, splats[i, 11], whole_tiles, origin_y + top)
            x0 = real(origin_x + left) + real(0.5) - mx
            for lane in range(side):
                ux[lane] = f.apart(u11 * (x0 + real(lane)))
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
                dy = real(origin_y + top + row) + real(0.5) - my
                e12 = u12 * dy
                e2 = u22 * dy
                e22 = e2 * e2
                e2y = e2 * dy
                base = wp.max(row * side, 0)
                for lane in range(side):
                    p = base + lane
                    dx = x0 + real(lane)
                    e1 = ux[lane] + e12
                    g = f.falloff(e1 * e1 + e22)
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
        slots: wp.array(dtype=int), origin_x: int, origin_y: int, width: int, height: int, columns: int, tiles: int,
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
            rows = f.rows_of(splats[i, 1], splats[i, 11], whole_tiles, origin_y + top)
            x0 = real(origin_x + left) + real(0.5) - splats[i, 0]
            for lane in range(side):
                ux[lane] = f.apart(splats[i, 2] * (x0 + real(lane)))
            weight_sum = real(0.0)
            weight_max = real(0.0)
            for row in range(rows[0], rows[1]):
                dy = real(origin_y + top + row) + real(0.5) - splats[i, 1]
                e12 = splats[i, 3] * dy
                e2 = splats[i, 4] * dy
                for lane in range(side):
                    p = row * side + lane
                    e1 = ux[lane] + e12
                    alpha = wp.min(alpha_max, splats[i, 5] * f.falloff(e1 * e1 + e2 * e2))
                    if alpha >= alpha_cut and instance < end[p]:
                        w = alpha * t[p]
                        t[p] = t[p] * (real(1.0) - alpha)
                        weight_sum += w
                        weight_max = wp.max(weight_max, w)
            weights[slots[instance], 0] = weight_sum
            weights[slots[instance], 1] = weight_max

    return SimpleNamespace(forward=forward, backward=backward, contributions=contributions)
