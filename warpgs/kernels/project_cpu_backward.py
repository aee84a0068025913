"""The backward kernel of `project` for the CPU, in plain Warp (see `project_cpu`)."""

import functools

import warp as wp

from warpgs.kernels import project_backward, sh
from warpgs.kernels.compiler import EXACT
from warpgs.kernels.functions import make_projection
from warpgs.kernels.project_inputs import PROJECTED_SIZE
from warpgs.kernels.project_lanes import LANES, make_lanes


@functools.cache
def make_backward(real, camera_model: str, parameters: str, antialiased: bool, bases: int, camera_gradients: bool):
    """Make the kernel. Each task sums over all cameras, so no sum needs atomics.

    Args:
        real: wp.float32 or wp.float64.
        camera_model: Name of the camera model, whose functions are compiled in.
        parameters: Kind of the Gaussians' parameters (`ProjectSettings.parameters`).
        antialiased: True where opacities were multiplied by `compensation`.
        bases: Number of basis values that a colour may have (`sh.bases_for`).
        camera_gradients: True to compute the gradients of viewmats and Ks.
    """
    m = make_projection(real, camera_model, parameters, lanes=True)
    of_one = project_backward.make_functions(real, camera_model, parameters, antialiased, bases)
    f = project_backward.make_functions(real, camera_model, parameters, antialiased, bases, lanes=True)
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
