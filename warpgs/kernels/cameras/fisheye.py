"""The fisheye camera of Kannala and Brandt, as in OpenCV: the radius is a polynomial of the axis angle (docs/project.md)."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.constants import FAR, RIM_SAMPLES
from warpgs.kernels.cameras.base import CameraModel, register
from warpgs.kernels.cameras.linear import make_linear

ANTIPODE = 1e-3
"""Smallest sine of the angle from the backward axis that is rendered: on that axis, the image of a point is a circle."""
NEAR_AXIS = 0.04
"""Squared tangent of the angle from the axis; below this value, series replace quotients that would cancel."""
TERMS = 12
"""Number of terms of the series: the error is below 1e-13 of the sum."""


@register("fisheye")
class Fisheye(CameraModel):
    """The equidistant fisheye with coefficients k1, k2, k3, k4, also past 90 degrees from the axis; depth is distance."""

    coefficients = 4

    @staticmethod
    def make_functions(real: type) -> SimpleNamespace:
        """Make the functions of `CameraModel.make_functions`."""
        return _make_functions(real)


@functools.cache
def _make_profile(real: type) -> SimpleNamespace:
    vec3 = wp.types.vector(3, real)

    @wp.struct
    class Profile:
        """Radius over sine, G, at a unit position (x, y, z) with r^2 = x^2 + y^2, and its derivatives.

        H = G_r / r, L = H_r / r, E = G_z, N = E_r / r = H_z and P = E_z.
        """

        G: real
        H: real
        L: real
        E: real
        N: real
        P: real

    @wp.func
    def slope(t: real, lens: wp.array(dtype=real)) -> real:
        """Return the derivative of the radius by the angle, whose square is t."""
        return real(1.0) + t * (
            real(3.0) * lens[0] + t * (real(5.0) * lens[1] + t * (real(7.0) * lens[2] + t * real(9.0) * lens[3]))
        )

    @wp.func
    def angle_over_sine(r2: real, z: real) -> vec3:
        """Return A = angle / r, B = A_r / r and C = B_r / r at a unit position."""
        t = r2 / (z * z)
        if z > real(0.0) and t < real(NEAR_AXIS):
            q = -t
            A = real(0.0)
            B = real(0.0)
            C = real(0.0)
            for i in range(TERMS):  # Horner's scheme, from the last term to the first, of arctan(sqrt t) / sqrt t
                n = real(TERMS - 1 - i)
                A = A * q + real(1.0) / (real(2.0) * n + real(1.0))
                B = B * q - (n + real(1.0)) / (real(2.0) * n + real(3.0))
                C = C * q + (n + real(1.0)) * (n + real(2.0)) / (real(2.0) * n + real(5.0))
            inv = real(1.0) / z
            return vec3(A * inv, real(2.0) * B * inv * inv * inv, real(4.0) * C * inv * inv * inv * inv * inv)
        r = wp.sqrt(r2)
        A = wp.atan2(r, z) / r
        B = (z - A) / r2
        return vec3(A, B, -(real(2.0) * z + real(3.0) * B) / r2)

    @wp.func
    def profile(unit: vec3, lens: wp.array(dtype=real)) -> Profile:
        two = real(2.0)
        r2 = unit[0] * unit[0] + unit[1] * unit[1]
        z = unit[2]
        abc = angle_over_sine(r2, z)
        A = abc[0]
        t = A * A * r2
        s = real(1.0) + t * (lens[0] + t * (lens[1] + t * (lens[2] + t * lens[3])))
        s1 = lens[0] + t * (two * lens[1] + t * (real(3.0) * lens[2] + t * real(4.0) * lens[3]))
        s2 = two * lens[1] + t * (real(6.0) * lens[2] + t * real(12.0) * lens[3])
        m = slope(t, lens)
        m1 = real(6.0) * lens[0] + t * (real(20.0) * lens[1] + t * (real(42.0) * lens[2] + t * real(72.0) * lens[3]))
        Az = A * z
        p = Profile()
        p.G = A * s
        p.H = abc[1] * s + two * A * Az * s1
        p.L = abc[2] * s + real(6.0) * abc[1] * Az * s1 + real(4.0) * A * (Az * Az * s2 - Az * s1)
        p.E = -m
        p.N = two * m - Az * m1
        p.P = r2 * A * m1 + two * m * z
        return p

    @wp.func
    def distance(position: vec3) -> real:
        largest = wp.max(wp.abs(position))
        if not (largest > real(0.0)):
            return largest
        return largest * wp.length(position / largest)

    return SimpleNamespace(slope=slope, profile=profile, distance=distance)


@functools.cache
def _make_functions(real: type) -> SimpleNamespace:
    linear = make_linear(real)
    radial = _make_profile(real)
    vec2 = wp.types.vector(2, real)
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)

    @wp.func
    def in_range(position: vec3, lens: wp.array(dtype=real), near: real) -> wp.bool:
        # phrased so that a NaN gives False
        distance = radial.distance(position)
        if not (distance >= near and distance <= real(FAR)):
            return False
        unit = position / distance
        r = wp.sqrt(unit[0] * unit[0] + unit[1] * unit[1])
        if not (unit[2] > real(0.0) or r >= real(ANTIPODE)):
            return False
        angle = wp.atan2(r, unit[2])
        count = int(RIM_SAMPLES)  # a loop, not sixteen copies
        for i in range(count):  # several samples, since the polynomial may rise again beyond a fold
            t = angle * (real(i + 1) / real(RIM_SAMPLES))
            if not (radial.slope(t * t, lens) > real(0.0)):
                return False
        return True

    @wp.func
    def depth_of(position: vec3) -> real:
        return radial.distance(position)

    @wp.func
    def pixel_of(position: vec3, K: mat33, lens: wp.array(dtype=real)) -> vec2:
        unit = position / radial.distance(position)
        p = radial.profile(unit, lens)
        return vec2(K[0, 0] * unit[0] * p.G + K[0, 2], K[1, 1] * unit[1] * p.G + K[1, 2])

    @wp.func
    def expansion_point(pixel: vec2, width: real, height: real) -> vec2:
        return pixel

    @wp.func
    def jacobian(position: vec3, K: mat33, lens: wp.array(dtype=real)) -> linear.Rows:
        distance = radial.distance(position)
        unit = position / distance
        x = unit[0]
        y = unit[1]
        p = radial.profile(unit, lens)
        jx = K[0, 0] / distance
        jy = K[1, 1] / distance
        first = vec3(jx * (p.G + x * x * p.H), jx * x * y * p.H, jx * x * p.E)
        second = vec3(jy * x * y * p.H, jy * (p.G + y * y * p.H), jy * y * p.E)
        return linear.rows_of(first, second)

    @wp.func
    def project_axes(position: vec3, K: mat33, lens: wp.array(dtype=real), point: vec2, axes: mat33) -> linear.Rows:
        return linear.times_axes(jacobian(position, K, lens), axes)

    @wp.func
    def axes_backward(
        position: vec3, K: mat33, lens: wp.array(dtype=real), point: vec2, v_first: vec3, v_second: vec3
    ) -> mat33:
        return linear.transposed_times(jacobian(position, K, lens), v_first, v_second)

    @wp.func
    def position_backward(
        position: vec3, K: mat33, lens: wp.array(dtype=real), pixel: vec2, point: vec2, axes: mat33,
        v_first: vec3, v_second: vec3, v_pixel: vec2, v_depth: real,
    ) -> linear.Gradients:  # fmt: skip
        two = real(2.0)
        distance = radial.distance(position)
        unit = position / distance
        x = unit[0]
        y = unit[1]
        p = radial.profile(unit, lens)
        v_row0 = axes * v_first / distance  # gradients of the rows of J, at unit distance
        v_row1 = axes * v_second / distance
        g = K[0, 0] * v_row0
        h = K[1, 1] * v_row1
        u = K[0, 0] * v_pixel[0]
        v = K[1, 1] * v_pixel[1]
        v_G = g[0] + h[1] + u * x + v * y
        v_H = g[0] * x * x + (g[1] + h[0]) * x * y + h[1] * y * y
        v_E = g[2] * x + h[2] * y
        v_r = v_G * p.H + v_H * p.L + v_E * p.N  # over r
        v_x = two * g[0] * x * p.H + (g[1] + h[0]) * y * p.H + g[2] * p.E + u * p.G + v_r * x
        v_y = (g[1] + h[0]) * x * p.H + two * h[1] * y * p.H + h[2] * p.E + v * p.G + v_r * y
        v_z = v_G * p.E + v_H * p.N + v_E * p.P
        v_K = mat33()
        v_K[0, 0] = v_pixel[0] * x * p.G + v_row0[0] * (p.G + x * x * p.H) + v_row0[1] * x * y * p.H + v_row0[2] * x * p.E
        v_K[1, 1] = v_pixel[1] * y * p.G + v_row1[0] * x * y * p.H + v_row1[1] * (p.G + y * y * p.H) + v_row1[2] * y * p.E
        v_K[0, 2] = v_pixel[0]
        v_K[1, 2] = v_pixel[1]
        gradients = linear.Gradients()
        gradients.v_position = vec3(v_x, v_y, v_z) / distance + v_depth * unit
        gradients.v_K = v_K
        return gradients

    return SimpleNamespace(
        in_range=in_range, depth_of=depth_of, pixel_of=pixel_of, expansion_point=expansion_point, project_axes=project_axes,
        axes_backward=axes_backward, position_backward=position_backward,
    )  # fmt: skip
