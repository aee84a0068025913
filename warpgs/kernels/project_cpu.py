"""Projection in plain Warp: several Gaussians abreast in the lanes of a CPU, and float64 on every device."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.constants import LARGEST_COEFFICIENT
from warpgs.kernels import ellipse, sh
from warpgs.kernels.ellipse import PROJECTED_SIZE, make_projection, make_spans
from warpgs.kernels.native import EXACT

LANES = 16
"""Gaussians of a task."""


@functools.cache
def make_lanes(real, camera_model: str, parameters: str, bases: int):
    """Make the record of a task's Gaussians and its functions; arguments are those of `project_cpu_backward.make_backward`.

    A loop over the lanes vectorises, since each value of all lanes is contiguous.
    """
    m = make_projection(real, camera_model, parameters)
    basis_of = sh.make_functions(real, bases).basis
    vec3 = m.vec3
    vec4 = m.vec4
    lane_reals = wp.types.vector(LANES, real)
    lane_bases = wp.types.vector(bases * LANES, real)
    lanes = wp.constant(LANES)

    @wp.struct
    class Shapes:
        """Parameters of the Gaussians; lanes beyond the last hold zeros."""

        mean_x: lane_reals  # [u]
        mean_y: lane_reals
        mean_z: lane_reals
        quat_w: lane_reals
        quat_x: lane_reals
        quat_y: lane_reals
        quat_z: lane_reals
        scale_x: lane_reals  # activated [u]
        scale_y: lane_reals
        scale_z: lane_reals

    @wp.func(inline=True)
    def at(entry: wp.ref[real]) -> real:
        """Return an entry of a vector that is taken by reference; Warp would copy the vector otherwise."""
        return entry

    @wp.func(inline=True)
    def store(mean: vec3, quat: vec4, log_scale: vec3, lane: wp.int32, shapes: wp.ref[Shapes]):
        """Store a Gaussian in its lane."""
        scale = m.scales_of(log_scale)
        shapes.mean_x[lane] = mean[0]
        shapes.mean_y[lane] = mean[1]
        shapes.mean_z[lane] = mean[2]
        shapes.quat_w[lane] = quat[0]
        shapes.quat_x[lane] = quat[1]
        shapes.quat_y[lane] = quat[2]
        shapes.quat_z[lane] = quat[3]
        shapes.scale_x[lane] = scale[0]
        shapes.scale_y[lane] = scale[1]
        shapes.scale_z[lane] = scale[2]

    @wp.func(inline=True)
    def mean_of(s: wp.ref[Shapes], lane: wp.int32) -> vec3:
        """Return the mean of a lane [u]."""
        return vec3(at(s.mean_x[lane]), at(s.mean_y[lane]), at(s.mean_z[lane]))

    @wp.func(inline=True)
    def quat_of(s: wp.ref[Shapes], lane: wp.int32) -> vec4:
        """Return the quaternion of a lane."""
        return vec4(at(s.quat_w[lane]), at(s.quat_x[lane]), at(s.quat_y[lane]), at(s.quat_z[lane]))

    @wp.func(inline=True)
    def scales_of(s: wp.ref[Shapes], lane: wp.int32) -> vec3:
        """Return the activated scales of a lane [u]."""
        return vec3(at(s.scale_x[lane]), at(s.scale_y[lane]), at(s.scale_z[lane]))

    @wp.func(inline=True)
    def store_basis(d: vec4, lane: wp.int32, basis: wp.ref[lane_bases]):
        """Store the basis at a direction."""
        y = basis_of(vec3(d[0], d[1], d[2]))
        for k in range(wp.static(bases)):
            basis[k * lanes + lane] = y[k]

    return SimpleNamespace(
        Shapes=Shapes, lane_bases=lane_bases, at=at, store=store, mean_of=mean_of, quat_of=quat_of, scales_of=scales_of,
        store_basis=store_basis,
    )  # fmt: skip


# The forward kernel of `project` for the CPU, in plain Warp.
#
# A task projects `LANES` Gaussians. Most operations are loops over the lanes without branches, which the compiler
# vectorises. Loads, calls of the C library, and colours are done for one Gaussian at a time.


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


@functools.cache
def make_backward(real, camera_model: str, parameters: str, antialiased: bool, bases: int, camera_gradients: bool):
    """Make the kernel. Each task sums over all cameras, so no sum needs atomics.

    Args:
        real: wp.float32 or wp.float64.
        camera_model: Name of the camera model, whose functions are compiled in.
        parameters: Kind of the Gaussians' parameters (`Pass.parameters`).
        antialiased: True where opacities were multiplied by `compensation`.
        bases: Number of basis values that a colour may have (`sh.bases_for`).
        camera_gradients: True to compute the gradients of viewmats and Ks.
    """
    m = make_projection(real, camera_model, parameters, lanes=True)
    of_one = ellipse.make_functions(real, camera_model, parameters, antialiased, bases)
    f = ellipse.make_functions(real, camera_model, parameters, antialiased, bases, lanes=True)
    gaussians = make_lanes(real, camera_model, parameters, bases)
    values = sh.make_functions(real, bases).values
    vec3 = m.vec3
    vec4 = m.vec4
    mat33 = m.mat33
    vec12 = wp.types.vector(PROJECTED_SIZE, real)
    lane_reals = wp.types.vector(LANES, real)
    lane_ints = wp.types.vector(LANES, wp.int32)
    lane_vec3 = wp.types.vector(3 * LANES, real)
    lane_vec4 = wp.types.vector(4 * LANES, real)
    lane_mat33 = wp.types.vector(9 * LANES, real)
    lane_rows = wp.types.vector(PROJECTED_SIZE * LANES, real)
    lane_bases = gaussians.lane_bases
    at = gaussians.at
    lanes = wp.constant(LANES)

    @wp.struct
    class CameraParts:
        """Values of each lane for the gradients of the cameras; the entries of one lane lie `LANES` apart."""

        position: lane_vec3
        turned: lane_mat33
        unit: lane_vec4
        K: lane_mat33

    @wp.func(inline=True)
    def row_of(rows: wp.ref[lane_rows], lane: wp.int32) -> vec12:
        """Return the row of a lane."""
        found = vec12()
        for k in range(wp.static(PROJECTED_SIZE)):
            found[k] = at(rows[k * lanes + lane])
        return found

    @wp.func(inline=True)
    def weights_of(weights: wp.ref[lane_bases], lane: wp.int32) -> values:
        """Return the gradient of the basis of a lane."""
        found = values()
        for k in range(wp.static(bases)):
            found[k] = at(weights[k * lanes + lane])
        return found

    @wp.func(inline=True)
    def store_parts(g: f.ShapeGradient, lane: wp.int32, parts: wp.ref[CameraParts]):
        """Store the data for the gradients of the cameras."""
        for j in range(wp.static(3)):
            parts.position[j * lanes + lane] = g.position[j]
            for k in range(wp.static(3)):
                parts.turned[(3 * j + k) * lanes + lane] = g.turned[j, k]
                parts.K[(3 * j + k) * lanes + lane] = g.K[j, k]
        for k in range(wp.static(4)):
            parts.unit[k * lanes + lane] = g.unit[k]

    @wp.func(inline=True)
    def matrix_of(matrices: wp.ref[lane_mat33], lane: wp.int32) -> mat33:
        """Return the matrix of a lane."""
        found = mat33()
        for j in range(wp.static(3)):
            for k in range(wp.static(3)):
                found[j, k] = at(matrices[(3 * j + k) * lanes + lane])
        return found

    @wp.func(inline=True)
    def vec4_of(vectors: wp.ref[lane_vec4], lane: wp.int32) -> vec4:
        """Return the vector of a lane."""
        found = vec4()
        for k in range(wp.static(4)):
            found[k] = at(vectors[k * lanes + lane])
        return found

    @wp.func(inline=True)
    def vec3_of(vectors: wp.ref[lane_vec3], lane: wp.int32) -> vec3:
        """Return the vector of a lane."""
        found = vec3()
        for k in range(wp.static(3)):
            found[k] = at(vectors[k * lanes + lane])
        return found

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT)
    def backward(
        begin: int,
        means: wp.array(dtype=m.vec3), quats: wp.array(dtype=m.vec4), log_scales: wp.array(dtype=m.vec3),
        logit_opacities: wp.array(dtype=real), coefficients: wp.array2d(dtype=m.vec3),
        viewmats: wp.array(dtype=m.mat44), Ks: wp.array(dtype=m.mat33), lenses: wp.array2d(dtype=real),
        width: int, height: int, sh_count: int, near: real, low_pass: real,
        projected: wp.array2d(dtype=real), tile_counts: wp.array(dtype=int), v_projected: wp.array2d(dtype=real),
        # outputs; those of the cameras zero on entry
        v_means: wp.array(dtype=m.vec3), v_quats: wp.array(dtype=m.vec4), v_log_scales: wp.array(dtype=m.vec3),
        v_logit_opacities: wp.array(dtype=real), v_coefficients: wp.array2d(dtype=m.vec3),
        v_viewmats: wp.array2d(dtype=m.mat44), v_Ks: wp.array2d(dtype=m.mat33),
    ):  # fmt: skip
        count = means.shape[0]
        first = (begin + wp.tid()) * lanes
        used = wp.min(lanes, count - first)
        shapes = gaussians.Shapes()
        for lane in range(used):
            n = first + lane
            gaussians.store(means[n], quats[n], log_scales[n], lane, shapes)

        # sums over the cameras; the number of cameras that saw a lane; whether this one does
        v_mean_x = lane_reals()
        v_mean_y = lane_reals()
        v_mean_z = lane_reals()
        v_quat_w = lane_reals()
        v_quat_x = lane_reals()
        v_quat_y = lane_reals()
        v_quat_z = lane_reals()
        v_scale_x = lane_reals()
        v_scale_y = lane_reals()
        v_scale_z = lane_reals()
        v_logit = lane_reals()
        views = lane_ints()
        seen = lane_ints()
        rows = lane_rows()
        v_rows = lane_rows()
        basis = lane_bases()
        weights = lane_bases()
        centered_x = lane_reals()
        centered_y = lane_reals()
        centered_z = lane_reals()
        parts = CameraParts()
        for camera in range(viewmats.shape[0]):
            view = viewmats[camera]
            K = Ks[camera]
            lens = lenses[camera]
            for lane in range(used):
                i = camera * count + first + lane
                seen[lane] = wp.where(tile_counts[i] > 0, 1, 0)
                if tile_counts[i] > 0:
                    for k in range(wp.static(PROJECTED_SIZE)):
                        rows[k * lanes + lane] = projected[i, k]
                        v_rows[k * lanes + lane] = v_projected[i, k]
            for lane in range(lanes):
                g = f.shape(
                    gaussians.mean_of(shapes, lane), gaussians.quat_of(shapes, lane), gaussians.scales_of(shapes, lane),
                    view, K, lens, real(width), real(height), near, low_pass, row_of(rows, lane), row_of(v_rows, lane), 0,
                )  # fmt: skip
                hit = seen[lane] != 0
                none = real(0.0)
                v_mean_x[lane] = v_mean_x[lane] + wp.where(hit, g.mean[0], none)
                v_mean_y[lane] = v_mean_y[lane] + wp.where(hit, g.mean[1], none)
                v_mean_z[lane] = v_mean_z[lane] + wp.where(hit, g.mean[2], none)
                v_quat_w[lane] = v_quat_w[lane] + wp.where(hit, g.quat[0], none)
                v_quat_x[lane] = v_quat_x[lane] + wp.where(hit, g.quat[1], none)
                v_quat_y[lane] = v_quat_y[lane] + wp.where(hit, g.quat[2], none)
                v_quat_z[lane] = v_quat_z[lane] + wp.where(hit, g.quat[3], none)
                v_scale_x[lane] = v_scale_x[lane] + wp.where(hit, g.log_scale[0], none)
                v_scale_y[lane] = v_scale_y[lane] + wp.where(hit, g.log_scale[1], none)
                v_scale_z[lane] = v_scale_z[lane] + wp.where(hit, g.log_scale[2], none)
                if wp.static(camera_gradients):
                    store_parts(g, lane, parts)
            for lane in range(lanes):
                gaussians.store_basis(m.direction(gaussians.mean_of(shapes, lane), view), lane, basis)
            for lane in range(used):
                if seen[lane] != 0:
                    n = wp.max(first + lane, 0)
                    i = camera * count + n
                    v_logit[lane] = v_logit[lane] + of_one.logit(projected, v_projected, i, logit_opacities[n])
                    v_color = of_one.color(projected, v_projected, i)
                    k = int(0)
                    while k < sh_count:
                        o = wp.max(k, 0)
                        weights[o * lanes + lane] = wp.dot(coefficients[n, o], v_color)
                        v_coefficient = basis[o * lanes + lane] * v_color
                        if views[lane] > 0:
                            v_coefficient += v_coefficients[n, o]
                        v_coefficients[n, o] = v_coefficient
                        k += 1
                    views[lane] = views[lane] + 1
            for lane in range(lanes):
                d = m.direction(gaussians.mean_of(shapes, lane), view)
                v_centered = f.centered(d, weights_of(weights, lane))
                hit = seen[lane] != 0
                none = real(0.0)
                centered_x[lane] = wp.where(hit, v_centered[0], none)
                centered_y[lane] = wp.where(hit, v_centered[1], none)
                centered_z[lane] = wp.where(hit, v_centered[2], none)
                v_mean_x[lane] = v_mean_x[lane] + centered_x[lane]
                v_mean_y[lane] = v_mean_y[lane] + centered_y[lane]
                v_mean_z[lane] = v_mean_z[lane] + centered_z[lane]
            if wp.static(camera_gradients):
                for lane in range(used):
                    if seen[lane] != 0:
                        n = first + lane
                        v_centered = vec3(centered_x[lane], centered_y[lane], centered_z[lane])
                        v_viewmats[camera, n] = f.view_gradient(
                            view, means[n], quats[n], log_scales[n], vec3_of(parts.position, lane),
                            matrix_of(parts.turned, lane), vec4_of(parts.unit, lane), v_centered,
                        )  # fmt: skip
                        v_Ks[camera, n] = matrix_of(parts.K, lane)
        for lane in range(used):
            n = first + lane
            v_means[n] = vec3(v_mean_x[lane], v_mean_y[lane], v_mean_z[lane])
            v_quats[n] = vec4(v_quat_w[lane], v_quat_x[lane], v_quat_y[lane], v_quat_z[lane])
            v_log_scales[n] = vec3(v_scale_x[lane], v_scale_y[lane], v_scale_z[lane])
            v_logit_opacities[n] = v_logit[lane]
            k = wp.where(views[lane] > 0, sh_count, 0)
            while k < v_coefficients.shape[1]:
                v_coefficients[n, k] = vec3()
                k += 1

    return backward
