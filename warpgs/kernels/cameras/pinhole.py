"""The pinhole camera: x / z and y / z times the focal lengths, plus the principal point (docs/project.md, section 3)."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.constants import FAR, FRUSTUM_MARGIN
from warpgs.kernels.cameras.base import CameraModel, register


@register("pinhole")
class Pinhole(CameraModel):
    """The pinhole camera."""

    @staticmethod
    def make_functions(real: type) -> SimpleNamespace:
        """Make the functions of `CameraModel.make_functions`."""
        return _make_functions(real)


@functools.cache
def _make_functions(real: type) -> SimpleNamespace:
    vec2 = wp.types.vector(2, real)
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)

    @wp.struct
    class Rows:
        """The two rows of Jacobian times axes [px]."""

        first: vec3
        second: vec3

    @wp.struct
    class Gradients:
        """Gradients of the position in the camera and of the intrinsics."""

        v_position: vec3
        v_K: mat33

    @wp.func
    def in_range(position: vec3, lens: wp.array(dtype=real), near: real) -> wp.bool:
        # phrased so that a NaN gives False
        return position[2] >= near and position[2] <= real(FAR)

    @wp.func
    def depth_of(position: vec3) -> real:
        return position[2]

    @wp.func
    def pixel_of(position: vec3, K: mat33, lens: wp.array(dtype=real)) -> vec2:
        return vec2(K[0, 0] * position[0] / position[2] + K[0, 2], K[1, 1] * position[1] / position[2] + K[1, 2])

    @wp.func
    def expansion_point(pixel: vec2, width: real, height: real) -> vec2:
        margin = real(FRUSTUM_MARGIN)
        return vec2(
            wp.clamp(pixel[0], -margin * width, width + margin * width),
            wp.clamp(pixel[1], -margin * height, height + margin * height),
        )

    @wp.func
    def project_axes(position: vec3, K: mat33, lens: wp.array(dtype=real), point: vec2, axes: mat33) -> Rows:
        z = position[2]
        jx = K[0, 0] / z
        jy = K[1, 1] / z
        jxz = (K[0, 2] - point[0]) / z
        jyz = (K[1, 2] - point[1]) / z
        rows = Rows()
        rows.first = vec3(
            jx * axes[0, 0] + jxz * axes[2, 0],
            jx * axes[0, 1] + jxz * axes[2, 1],
            jx * axes[0, 2] + jxz * axes[2, 2],
        )
        rows.second = vec3(
            jy * axes[1, 0] + jyz * axes[2, 0],
            jy * axes[1, 1] + jyz * axes[2, 1],
            jy * axes[1, 2] + jyz * axes[2, 2],
        )
        return rows

    @wp.func
    def axes_backward(
        position: vec3, K: mat33, lens: wp.array(dtype=real), point: vec2, v_first: vec3, v_second: vec3
    ) -> mat33:
        inv_z = real(1.0) / position[2]
        jx = K[0, 0] * inv_z
        jy = K[1, 1] * inv_z
        jxz = (K[0, 2] - point[0]) * inv_z
        jyz = (K[1, 2] - point[1]) * inv_z
        g0 = jx * v_first
        g1 = jy * v_second
        g2 = jxz * v_first + jyz * v_second
        return mat33(g0[0], g0[1], g0[2], g1[0], g1[1], g1[2], g2[0], g2[1], g2[2])

    @wp.func
    def position_backward(
        position: vec3, K: mat33, lens: wp.array(dtype=real), pixel: vec2, point: vec2, axes: mat33,
        v_first: vec3, v_second: vec3, v_pixel: vec2, v_depth: real,
    ) -> Gradients:  # fmt: skip
        x = position[0]
        y = position[1]
        inv_z = real(1.0) / position[2]
        jx = K[0, 0] * inv_z
        jy = K[1, 1] * inv_z
        jxz = (K[0, 2] - point[0]) * inv_z
        jyz = (K[1, 2] - point[1]) * inv_z
        axes0 = vec3(axes[0, 0], axes[0, 1], axes[0, 2])
        axes1 = vec3(axes[1, 0], axes[1, 1], axes[1, 2])
        axes2 = vec3(axes[2, 0], axes[2, 1], axes[2, 2])
        v_jx = wp.dot(v_first, axes0)
        v_jxz = wp.dot(v_first, axes2)
        v_jy = wp.dot(v_second, axes1)
        v_jyz = wp.dot(v_second, axes2)
        v_K = mat33()
        v_x = v_pixel[0] * jx
        v_y = v_pixel[1] * jy
        v_z = -(v_pixel[0] * jx * x + v_pixel[1] * jy * y + v_jx * jx + v_jy * jy + v_jxz * jxz + v_jyz * jyz) * inv_z + v_depth
        v_K[0, 0] = (v_pixel[0] * x + v_jx) * inv_z
        v_K[1, 1] = (v_pixel[1] * y + v_jy) * inv_z
        v_K[0, 2] = v_pixel[0]
        v_K[1, 2] = v_pixel[1]
        if point[0] == pixel[0]:  # the Jacobian moves with the mean: cx - px = -fx x / z
            v_x -= v_jxz * jx * inv_z
            v_z += v_jxz * jx * x * inv_z * inv_z
            v_K[0, 0] = v_K[0, 0] - v_jxz * x * inv_z * inv_z
        else:
            v_K[0, 2] = v_K[0, 2] + v_jxz * inv_z
        if point[1] == pixel[1]:
            v_y -= v_jyz * jy * inv_z
            v_z += v_jyz * jy * y * inv_z * inv_z
            v_K[1, 1] = v_K[1, 1] - v_jyz * y * inv_z * inv_z
        else:
            v_K[1, 2] = v_K[1, 2] + v_jyz * inv_z
        g = Gradients()
        g.v_position = vec3(v_x, v_y, v_z)
        g.v_K = v_K
        return g

    return SimpleNamespace(
        in_range=in_range, depth_of=depth_of, pixel_of=pixel_of, expansion_point=expansion_point, project_axes=project_axes,
        axes_backward=axes_backward, position_backward=position_backward,
    )  # fmt: skip
