"""The orthographic camera: x and y times K[0, 0] and K[1, 1] [px/u], at any depth (docs/project.md, section 3)."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.constants import FAR
from warpgs.kernels.cameras.base import CameraModel, register
from warpgs.kernels.cameras.linear import make_linear


@register("orthographic")
class Orthographic(CameraModel):
    """The orthographic camera."""

    @staticmethod
    def make_functions(real: type) -> SimpleNamespace:
        """Make the functions of `CameraModel.make_functions`."""
        return _make_functions(real)


@functools.cache
def _make_functions(real: type) -> SimpleNamespace:
    linear = make_linear(real)
    vec2 = wp.types.vector(2, real)
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)

    @wp.func
    def in_range(position: vec3, lens: wp.array(dtype=real), near: real) -> wp.bool:
        # phrased so that a NaN gives False
        return position[2] >= near and position[2] <= real(FAR)

    @wp.func
    def depth_of(position: vec3) -> real:
        return position[2]

    @wp.func
    def pixel_of(position: vec3, K: mat33, lens: wp.array(dtype=real)) -> vec2:
        return vec2(K[0, 0] * position[0] + K[0, 2], K[1, 1] * position[1] + K[1, 2])

    @wp.func
    def expansion_point(pixel: vec2, width: real, height: real) -> vec2:
        return pixel

    @wp.func
    def jacobian(K: mat33) -> linear.Rows:
        zero = real(0.0)
        return linear.rows_of(vec3(K[0, 0], zero, zero), vec3(zero, K[1, 1], zero))

    @wp.func
    def project_axes(position: vec3, K: mat33, lens: wp.array(dtype=real), point: vec2, axes: mat33) -> linear.Rows:
        return linear.times_axes(jacobian(K), axes)

    @wp.func
    def axes_backward(
        position: vec3, K: mat33, lens: wp.array(dtype=real), point: vec2, v_first: vec3, v_second: vec3
    ) -> mat33:
        return linear.transposed_times(jacobian(K), v_first, v_second)

    @wp.func
    def position_backward(
        position: vec3, K: mat33, lens: wp.array(dtype=real), pixel: vec2, point: vec2, axes: mat33,
        v_first: vec3, v_second: vec3, v_pixel: vec2, v_depth: real,
    ) -> linear.Gradients:  # fmt: skip
        v_K = mat33()
        v_K[0, 0] = v_pixel[0] * position[0] + wp.dot(v_first, vec3(axes[0, 0], axes[0, 1], axes[0, 2]))
        v_K[1, 1] = v_pixel[1] * position[1] + wp.dot(v_second, vec3(axes[1, 0], axes[1, 1], axes[1, 2]))
        v_K[0, 2] = v_pixel[0]
        v_K[1, 2] = v_pixel[1]
        g = linear.Gradients()
        g.v_position = vec3(v_pixel[0] * K[0, 0], v_pixel[1] * K[1, 1], v_depth)
        g.v_K = v_K
        return g

    return SimpleNamespace(
        in_range=in_range, depth_of=depth_of, pixel_of=pixel_of, expansion_point=expansion_point, project_axes=project_axes,
        axes_backward=axes_backward, position_backward=position_backward,
    )  # fmt: skip
