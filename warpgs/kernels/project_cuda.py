"""The kernels of `project` for CUDA, a thread for each Gaussian; `project_cpu` has the kernels for a CPU."""

import functools

import warp as wp

from warpgs.constants import LARGEST_COEFFICIENT
from warpgs.kernels import ellipse, sh
from warpgs.kernels.cameras import types_of
from warpgs.kernels.ellipse import PROJECTED_SIZE, arrays_of, make_projection, make_spans
from warpgs.kernels.native import Ints, clear_rows, compact, source, store_row


def _module(kind: str, real, camera_model: str, parameters: str, antialiased: bool, bases: int) -> str:
    variant = f"{camera_model}.{parameters}.{bases}{'.antialiased' * antialiased}"
    return f"warpgs.kernels.project.{kind}.cuda.{real.__name__}.{variant}"


@functools.cache
def make_forward(real, camera_model: str, parameters: str = "stored", antialiased: bool = False, bases: int = sh.BASES):
    """Make the forward kernel of one `Pass.variant`. It computes colours last, because they need the most data."""
    # In float32 the first threads of each block compute the colours of the Gaussians that touch a tile.
    native = real is wp.float32
    m = make_projection(real, camera_model, parameters)
    s = make_spans(real)
    basis = sh.make_functions(real, bases).basis
    _, vec3, *_, mat44, Reals = types_of(real)
    Vec3s, Vec4s, Mat33s, Mat44s, Rows, Vec3Rows = arrays_of(real)
    vec12, weights_of_row = wp.types.vector(PROJECTED_SIZE, real), wp.types.vector(bases, wp.float32)

    @wp.func_native(source("native_color.cu", BASES=bases))
    def color_of(sh: wp.array2d(dtype=wp.vec3), n: int, count: int, weights: weights_of_row) -> wp.vec4:
        """Return the weighted sum of the first ``count`` coefficients of row n, and their largest magnitude (ignoring NaN)."""

    @wp.func
    def store_values(projected: Rows, i: int, values: vec12):
        for k in range(wp.static(PROJECTED_SIZE)):
            projected[i, k] = values[k]

    store = store_row if native else store_values
    module = _module("forward", real, camera_model, parameters, antialiased, bases)

    @wp.func
    def color_one(
        i: int, n: int, view: mat44, means: Vec3s, coefficients: Vec3Rows, sh_count: int,
        projected: Rows, tile_counts: Ints,
    ):  # fmt: skip
        """Write the colour of row i; if the colour is not finite, Gaussian n is culled after all."""
        d = m.direction(means[n], view)
        y = basis(vec3(d[0], d[1], d[2]))
        color = vec3(real(0.5), real(0.5), real(0.5))
        largest = real(0.0)
        if wp.static(native):
            shaded = color_of(coefficients, n, sh_count, y)
            color += vec3(shaded[0], shaded[1], shaded[2])
            largest = shaded[3]
        else:
            for k in range(wp.static(bases)):
                if k < sh_count:
                    color += y[k] * coefficients[n, k]
                    largest = wp.max(largest, wp.max(wp.abs(coefficients[n, k])))
        if m.finite3(color) and largest <= real(LARGEST_COEFFICIENT):  # the maximum ignores a NaN, the colour has it
            for channel in range(3):
                projected[i, 6 + channel] = wp.max(color[channel], real(0.0))
        else:
            tile_counts[i] = 0
            store(projected, i, vec12())

    # a grid-stride loop would need half as many registers again, for the arguments
    @wp.kernel(enable_backward=False, grid_stride=False, module=module)
    def forward(
        begin: int,
        means: Vec3s, quats: Vec4s, log_scales: Vec3s,
        logit_opacities: Reals, coefficients: Vec3Rows,
        viewmats: Mat44s, Ks: Mat33s, lenses: Rows,
        opacity_factors: Reals,
        width: int, height: int, origin_x: int, origin_y: int, window_width: int, window_height: int,
        tile_size: int, sh_count: int,
        near: real, far: real, low_pass: real, alpha_cut: real, square_sigma: real,
        # outputs
        projected: Rows, tile_counts: Ints,
    ):  # fmt: skip
        i = begin + wp.tid()
        count = means.shape[0]
        seen = int(0)
        if i < viewmats.shape[0] * count:
            camera = i // count
            n = i - camera * count
            values = vec12()  # without the colour
            e = m.ellipse(
                means[n], quats[n], log_scales[n], viewmats[camera], Ks[camera], lenses[camera],
                real(width), real(height), near, low_pass,
            )  # fmt: skip
            if e.valid != 0 and m.depth_of(e.position) <= far:
                opacity = m.opacity_of(logit_opacities[n])
                if opacity_factors.shape[0] > 0:
                    opacity *= opacity_factors[n]
                if wp.static(antialiased):
                    opacity *= m.compensation(e)
                factor = m.factor_of(e)
                if wp.isfinite(opacity) and opacity > real(0.0) and opacity >= alpha_cut and m.finite3(factor):
                    reach = s.reach_of(opacity, alpha_cut, square_sigma)
                    half = s.half_sides(e.a, e.b, e.c, e.shrink, reach, alpha_cut, square_sigma)
                    rows = s.tile_rows(e.pixel[1], half[1], origin_y, window_height, tile_size)
                    for row in range(rows[0], rows[1]):
                        columns = s.tile_columns(
                            e.pixel[0], e.pixel[1], factor, reach, half[0], half[1], row, origin_x, window_width, tile_size
                        )
                        seen += columns[1] - columns[0]
                    if seen > 0:
                        values = vec12(
                            e.pixel[0], e.pixel[1], factor[0], factor[1], factor[2], opacity, real(0.0), real(0.0), real(0.0),
                            m.depth_of(e.position), half[0], half[1],
                        )  # fmt: skip
            tile_counts[i] = seen
            store(projected, i, values)
        if wp.static(native):
            i = compact(i, seen)
        elif seen == 0:
            i = -1
        if i >= 0:
            view = viewmats[i // count]
            color_one(i, i % count, view, means, coefficients, sh_count, projected, tile_counts)

    return forward


@functools.cache
def make_backward(real, camera_model: str, parameters: str = "stored", antialiased: bool = False, bases: int = sh.BASES):
    """Make the backward kernel: one thread per Gaussian, over all cameras, so no sum needs atomics."""
    # In float32 the Gaussians that some camera sees are assigned to the first threads of each block.
    native = real is wp.float32
    m = make_projection(real, camera_model, parameters)
    f = ellipse.make_functions(real, camera_model, parameters, antialiased, bases)
    functions = sh.make_functions(real, bases)
    _, vec3, vec4, mat33, mat44, Reals = types_of(real)
    Vec3s, Vec4s, Mat33s, Mat44s, Rows, Vec3Rows = arrays_of(real)
    weights_of_row = wp.types.vector(bases, wp.float32)

    @wp.func_native(source("native_color_backward.cu", BASES=bases))
    def color_backward(
        sh: wp.array2d(dtype=wp.vec3), n: int, count: int, weights: weights_of_row, v: wp.vec3, add: int,
        v_sh: wp.array2d(dtype=wp.vec3),
    ) -> weights_of_row:  # fmt: skip
        """Return the weights' gradient of `color_of` for upstream ``v``; store (0 past ``count``) or add the row's gradient."""

    # three blocks to a multiprocessor: enough registers
    registers = {"cuda_max_registers": 168, "grid_stride": False} if native else {}
    module = _module("backward", real, camera_model, parameters, antialiased, bases)

    @wp.kernel(enable_backward=False, module=module, **registers)
    def backward(
        begin: int,
        means: Vec3s, quats: Vec4s, log_scales: Vec3s,
        logit_opacities: Reals, coefficients: Vec3Rows,
        viewmats: Mat44s, Ks: Mat33s, lenses: Rows,
        width: int, height: int, sh_count: int, near: real, low_pass: real,
        projected: Rows, tile_counts: Ints, v_projected: Rows,
        camera_gradients: int,
        # outputs, of which coefficients are zero on entry in float64
        v_means: Vec3s, v_quats: Vec4s, v_log_scales: Vec3s,
        v_logit_opacities: Reals, v_coefficients: Vec3Rows,
        v_viewmats: wp.array2d(dtype=mat44), v_Ks: wp.array2d(dtype=mat33),
    ):  # fmt: skip
        n = begin + wp.tid()
        count = means.shape[0]
        if wp.static(native):
            seen = int(0)
            if n < count:
                for camera in range(viewmats.shape[0]):
                    seen += tile_counts[camera * count + n]
                if seen == 0:
                    v_means[n] = vec3()
                    v_quats[n] = vec4()
                    v_log_scales[n] = vec3()
                    v_logit_opacities[n] = real(0.0)
            clear_rows(n, seen, v_coefficients)
            n = compact(n, seen)
            if n < 0:
                return
        elif n >= count:
            return
        v_mean = vec3()
        v_quat = vec4()
        v_log_scale = vec3()
        v_logit = real(0.0)
        stored = int(0)
        for camera in range(viewmats.shape[0]):
            i = camera * count + n
            if tile_counts[i] > 0:
                view = viewmats[camera]
                g = f.shape(
                    means[n], quats[n], log_scales[n], view, Ks[camera], lenses[camera],
                    real(width), real(height), near, low_pass, projected, v_projected, i,
                )  # fmt: skip
                v_mean += g.mean
                v_quat += g.quat
                v_log_scale += g.log_scale
                # before the colour: its loads need not wait for what is stored there
                v_logit += f.logit(projected, v_projected, i, logit_opacities[n])

                d = m.direction(means[n], view)
                basis = functions.basis(vec3(d[0], d[1], d[2]))
                v_color = f.color(projected, v_projected, i)
                w = functions.values()
                if wp.static(native):
                    w = color_backward(coefficients, n, sh_count, basis, v_color, stored, v_coefficients)
                    stored += 1
                else:
                    for k in range(wp.static(bases)):
                        if k < sh_count:
                            v_coefficients[n, k] = v_coefficients[n, k] + basis[k] * v_color
                            w[k] = wp.dot(coefficients[n, k], v_color)
                v_centered = f.centered(d, w)
                v_mean += v_centered

                if camera_gradients != 0:  # section 6
                    v_viewmats[camera, n] = f.view_gradient(
                        view, means[n], quats[n], log_scales[n], g.position, g.turned, g.unit, v_centered
                    )
                    v_Ks[camera, n] = g.K
        v_means[n] = v_mean
        v_quats[n] = v_quat
        v_log_scales[n] = v_log_scale
        v_logit_opacities[n] = v_logit

    return backward
