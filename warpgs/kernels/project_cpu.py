"""The forward kernel of `project` for the CPU, in plain Warp.

A task projects `LANES` Gaussians. Most operations are loops over the lanes without branches, which the compiler vectorises.
Loads, calls of the C library, and colours are done for one Gaussian at a time.
"""

import functools

import warp as wp

from warpgs.constants import LARGEST_COEFFICIENT
from warpgs.kernels.compiler import EXACT
from warpgs.kernels.functions import make_projection, make_spans
from warpgs.kernels.project_inputs import PROJECTED_SIZE
from warpgs.kernels.project_lanes import LANES, make_lanes


@functools.cache
def make_forward(real, camera_model: str, parameters: str, antialiased: bool, bases: int):
    """Make the kernel; arguments are those of `project_cuda.make_forward`."""
    one = make_projection(real, camera_model, parameters)
    m = make_projection(real, camera_model, parameters, lanes=True)
    s = make_spans(real, lanes=True)
    g = make_lanes(real, camera_model, parameters, bases)
    vec3 = m.vec3
    lane_reals = wp.types.vector(LANES, real)
    lane_ints = wp.types.vector(LANES, wp.int32)
    lane_bases = g.lane_bases
    lanes = wp.constant(LANES)

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT)
    def forward(
        begin: int,
        means: wp.array(dtype=m.vec3), quats: wp.array(dtype=m.vec4), log_scales: wp.array(dtype=m.vec3),
        logit_opacities: wp.array(dtype=real), coefficients: wp.array2d(dtype=m.vec3),
        viewmats: wp.array(dtype=m.mat44), Ks: wp.array(dtype=m.mat33), lenses: wp.array2d(dtype=real),
        opacity_factors: wp.array(dtype=real),
        width: int, height: int, origin_x: int, origin_y: int, window_width: int, window_height: int,
        tile_size: int, sh_count: int,
        near: real, far: real, low_pass: real, alpha_cut: real, square_sigma: real,
        # outputs
        projected: wp.array2d(dtype=real), tile_counts: wp.array(dtype=int),
    ):  # fmt: skip
        task = begin + wp.tid()
        count = means.shape[0]
        tasks = (count + lanes - 1) // lanes
        camera = task // tasks
        first = (task - camera * tasks) * lanes
        used = wp.min(lanes, count - first)
        view = viewmats[camera]
        K = Ks[camera]
        lens = lenses[camera]

        shapes = g.Shapes()
        opacity = lane_reals()
        for lane in range(used):
            n = first + lane
            g.store(means[n], quats[n], log_scales[n], lane, shapes)
            opacity[lane] = one.opacity_of(logit_opacities[n])
            if opacity_factors.shape[0] > 0:
                opacity[lane] = opacity[lane] * opacity_factors[n]

        valid = lane_ints()
        pixel_x = lane_reals()
        pixel_y = lane_reals()
        u11 = lane_reals()
        u12 = lane_reals()
        u22 = lane_reals()
        depth = lane_reals()
        shrink = lane_reals()
        a = lane_reals()
        b = lane_reals()
        c = lane_reals()
        for lane in range(lanes):
            e = m.ellipse(
                g.mean_of(shapes, lane), g.quat_of(shapes, lane), g.scales_of(shapes, lane),
                view, K, lens, real(width), real(height), near, low_pass,
            )  # fmt: skip
            if wp.static(antialiased):
                opacity[lane] = opacity[lane] * m.compensation(e)
            factor = m.factor_of(e)
            found = wp.where(m.finite3(factor), e.valid, 0)
            found = wp.where(m.depth_of(e.position) <= far, found, 0)
            o = opacity[lane]
            found = wp.where(o - o == real(0.0), found, 0)
            found = wp.where(o > real(0.0), found, 0)
            valid[lane] = wp.where(o >= alpha_cut, found, 0)
            pixel_x[lane] = e.pixel[0]
            pixel_y[lane] = e.pixel[1]
            u11[lane] = factor[0]
            u12[lane] = factor[1]
            u22[lane] = factor[2]
            depth[lane] = m.depth_of(e.position)
            shrink[lane] = e.shrink
            a[lane] = e.a
            b[lane] = e.b
            c[lane] = e.c

        reach = lane_reals()
        for lane in range(used):
            if valid[lane] != 0:
                reach[lane] = s.reach_of(opacity[lane], alpha_cut, square_sigma)
        half_width = lane_reals()
        half_height = lane_reals()
        begin_row = lane_ints()
        end_row = lane_ints()
        tiles = lane_ints()
        for lane in range(lanes):
            half = s.half_sides(a[lane], b[lane], c[lane], shrink[lane], reach[lane], alpha_cut, square_sigma)
            rows = s.tile_rows(pixel_y[lane], half[1], origin_y, window_height, tile_size)
            begin_row[lane] = wp.where(valid[lane] != 0, rows[0], 0)
            end_row[lane] = wp.where(valid[lane] != 0, rows[1], 0)
            half_width[lane] = half[0]
            half_height[lane] = half[1]
        most = int(0)
        for lane in range(used):
            most = wp.max(most, end_row[lane] - begin_row[lane])
        for k in range(most):
            for lane in range(lanes):
                row = begin_row[lane] + k
                columns = s.tile_columns(
                    pixel_x[lane], pixel_y[lane], vec3(u11[lane], u12[lane], u22[lane]), reach[lane], half_width[lane],
                    half_height[lane], row, origin_x, window_width, tile_size,
                )  # fmt: skip
                tiles[lane] = tiles[lane] + wp.where(row < end_row[lane], columns[1] - columns[0], 0)

        # last, since it reads the most
        values = lane_bases()
        for lane in range(lanes):
            g.store_basis(m.direction(g.mean_of(shapes, lane), view), lane, values)
        for lane in range(used):
            n = first + lane
            i = camera * count + n
            color = vec3(real(0.5), real(0.5), real(0.5))
            if tiles[lane] > 0:
                large = int(0)
                k = int(0)
                while k < sh_count:
                    coefficient = coefficients[wp.max(n, 0), wp.max(k, 0)]
                    color += values[wp.max(k, 0) * lanes + lane] * coefficient
                    large += wp.where(wp.max(wp.abs(coefficient)) <= real(LARGEST_COEFFICIENT), 0, 1)
                    k += 1
                if not (m.finite3(color) and large == 0):
                    tiles[lane] = 0
            tile_counts[i] = tiles[lane]
            if tiles[lane] > 0:
                projected[i, 0] = pixel_x[lane]
                projected[i, 1] = pixel_y[lane]
                projected[i, 2] = u11[lane]
                projected[i, 3] = u12[lane]
                projected[i, 4] = u22[lane]
                projected[i, 5] = opacity[lane]
                for channel in range(3):
                    projected[i, 6 + channel] = wp.max(color[channel], real(0.0))
                projected[i, 9] = depth[lane]
                projected[i, 10] = half_width[lane]
                projected[i, 11] = half_height[lane]
            else:
                for k in range(PROJECTED_SIZE):
                    projected[i, k] = real(0.0)

    return forward
