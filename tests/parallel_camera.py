"""A camera model that only tests know: parallel projection, bent by four coefficients."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.kernels import CameraModel, register_camera_model

NAME = "test_parallel"


@register_camera_model(NAME)
class Parallel(CameraModel):
    """u = K00 (x + c0 x^2 + c1 x^3) + K02 and v = K11 (y + c2 y^2 + c3 y^3) + K12, whatever the depth."""

    coefficients = 4

    @staticmethod
    def make_functions(real):
        return make_parallel(real)


@functools.cache
def make_parallel(real):
    vec2 = wp.types.vector(2, real)
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)

    @wp.struct
    class Rows:
        first: vec3
        second: vec3

    @wp.struct
    class Gradients:
        v_position: vec3
        v_K: mat33

    @wp.func
    def bent(x: real, a: real, b: real) -> real:
        return x + a * x * x + b * x * x * x

    @wp.func
    def slope(x: real, a: real, b: real) -> real:
        return real(1.0) + real(2.0) * a * x + real(3.0) * b * x * x

    @wp.func
    def curve(x: real, a: real, b: real) -> real:
        return real(2.0) * a + real(6.0) * b * x

    @wp.func
    def in_range(position: vec3, lens: wp.array(dtype=real), near: real) -> wp.bool:
        return position[2] >= near and wp.isfinite(position[2])

    @wp.func
    def depth_of(position: vec3) -> real:
        return position[2]

    @wp.func
    def pixel_of(position: vec3, K: mat33, lens: wp.array(dtype=real)) -> vec2:
        u = K[0, 0] * bent(position[0], lens[0], lens[1]) + K[0, 2]
        v = K[1, 1] * bent(position[1], lens[2], lens[3]) + K[1, 2]
        return vec2(u, v)

    @wp.func
    def expansion_point(pixel: vec2, width: real, height: real) -> vec2:
        return pixel

    @wp.func
    def project_axes(position: vec3, K: mat33, lens: wp.array(dtype=real), point: vec2, axes: mat33) -> Rows:
        rows = Rows()
        rows.first = K[0, 0] * slope(position[0], lens[0], lens[1]) * vec3(axes[0, 0], axes[0, 1], axes[0, 2])
        rows.second = K[1, 1] * slope(position[1], lens[2], lens[3]) * vec3(axes[1, 0], axes[1, 1], axes[1, 2])
        return rows

    @wp.func
    def axes_backward(
        position: vec3, K: mat33, lens: wp.array(dtype=real), point: vec2, v_first: vec3, v_second: vec3
    ) -> mat33:
        g0 = K[0, 0] * slope(position[0], lens[0], lens[1]) * v_first
        g1 = K[1, 1] * slope(position[1], lens[2], lens[3]) * v_second
        zero = real(0.0)
        return mat33(g0[0], g0[1], g0[2], g1[0], g1[1], g1[2], zero, zero, zero)

    @wp.func
    def position_backward(
        position: vec3, K: mat33, lens: wp.array(dtype=real), pixel: vec2, point: vec2, axes: mat33,
        v_first: vec3, v_second: vec3, v_pixel: vec2, v_depth: real,
    ) -> Gradients:  # fmt: skip
        v_slope_x = wp.dot(v_first, vec3(axes[0, 0], axes[0, 1], axes[0, 2]))
        v_slope_y = wp.dot(v_second, vec3(axes[1, 0], axes[1, 1], axes[1, 2]))
        slope_x = slope(position[0], lens[0], lens[1])
        slope_y = slope(position[1], lens[2], lens[3])
        v_x = K[0, 0] * (v_pixel[0] * slope_x + v_slope_x * curve(position[0], lens[0], lens[1]))
        v_y = K[1, 1] * (v_pixel[1] * slope_y + v_slope_y * curve(position[1], lens[2], lens[3]))
        g = Gradients()
        g.v_position = vec3(v_x, v_y, v_depth)
        v_K = mat33()
        v_K[0, 0] = v_pixel[0] * bent(position[0], lens[0], lens[1]) + v_slope_x * slope_x
        v_K[1, 1] = v_pixel[1] * bent(position[1], lens[2], lens[3]) + v_slope_y * slope_y
        v_K[0, 2] = v_pixel[0]
        v_K[1, 2] = v_pixel[1]
        g.v_K = v_K
        return g

    return SimpleNamespace(
        in_range=in_range, depth_of=depth_of, pixel_of=pixel_of, expansion_point=expansion_point, project_axes=project_axes,
        axes_backward=axes_backward, position_backward=position_backward,
    )  # fmt: skip
