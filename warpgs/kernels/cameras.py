"""Camera models: the interface, and the Warp functions of each model with their gradients."""

import functools
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, ClassVar

import warp as wp

from warpgs.constants import FAR, FRUSTUM_MARGIN, RIM_SAMPLES
from warpgs.errors import UsageError
from warpgs.plugins import Registry
from warpgs.scene import Camera


class CameraModel:
    """A camera model: Warp functions that map a point in camera coordinates to a pixel, and their gradients."""

    name: ClassVar[str]
    """Name of the model in `Camera.model`."""
    coefficients: int = 0
    """Number P of coefficients in `Camera.distortion`."""

    @staticmethod
    def make_functions(real: type) -> SimpleNamespace:
        """Make the functions for one scalar type, wp.float32 or wp.float64.

        Below, ``position`` is a mean in camera coordinates [u] (+x right, +y down, +z forward), ``K`` the intrinsics [3, 3],
        ``lens`` the coefficients of distortion, a Warp array [P], ``pixel`` the result of ``pixel_of`` and J the Jacobian of
        ``pixel_of`` by the position, 2 x 3. The namespace has:

        ``in_range(position, lens, near) -> bool``: True if the model can project this position. A NaN must give False.

        ``depth_of(position) -> real``: The depth [u], above 0 where ``in_range`` is True. It orders the Gaussians and is
        rendered.

        ``pixel_of(position, K, lens) -> vec2``: The projected position [px].

        ``expansion_point(pixel, width, height) -> vec2``: The pixel at which J is evaluated [px]: ``pixel``, or ``pixel``
        clamped to the image plus a margin if a first-order expansion would be too inaccurate far outside the image.

        ``project_axes(position, K, lens, point, axes) -> Rows``: J times ``axes`` [3, 3], with J at the expansion point
        ``point``. ``Rows`` is a struct with two vec3, ``first`` and ``second``.

        ``axes_backward(position, K, lens, point, v_first, v_second) -> mat33``: The gradient of ``axes`` from the gradients of
        the two rows.

        ``position_backward(position, K, lens, pixel, point, axes, v_first, v_second, v_pixel, v_depth) -> Gradients``: The
        gradients of position and intrinsics from those of the two rows, of the pixel and of the depth.
        ``Gradients`` is a struct with ``v_position`` (vec3) and ``v_K`` (mat33). Where ``point`` equals ``pixel``, J depends on
        the position; otherwise J is constant. The coefficients have no gradient.

        Raises:
            TypeError: The class does not define this function.
        """
        raise TypeError("a camera model must define make_functions(real); warpgs/kernels/cameras.py is an example")


CAMERA_MODELS = Registry("camera model", CameraModel, "warpgs.kernels.cameras")
"""Camera models by name."""
register = register_camera_model = CAMERA_MODELS.register


def check_camera(camera: Camera) -> type[CameraModel]:
    """Return the model of a camera, or of a batch; UsageError where the coefficients do not match it or require gradients."""
    model = CAMERA_MODELS.find(camera.model)
    found = 0 if camera.distortion is None else camera.distortion.shape[-1]
    if found and not model.coefficients:
        raise UsageError(f"the camera model {camera.model!r} takes no distortion; give model opencv (8) or fisheye (4)")
    if found != model.coefficients:
        raise UsageError(f"{camera.model!r} takes {model.coefficients} coefficients of distortion, not {found}; 0 for none")
    if getattr(camera.distortion, "requires_grad", False):
        raise UsageError("gradients of distortion coefficients are not supported: give Camera.distortion.detach()")
    return model


@functools.cache
def types_of(real: type) -> tuple[Any, ...]:
    """Return vectors of 2, 3 and 4, matrices of 3 x 3 and 4 x 4, and an array of a scalar type."""
    vectors = [wp.types.vector(size, real) for size in (2, 3, 4)]
    return *vectors, wp.types.matrix((3, 3), real), wp.types.matrix((4, 4), real), wp.array(dtype=real)


def named(*functions: Any, **more: Any) -> SimpleNamespace:
    """Return a namespace of Warp's functions, kernels and structs by their own names, and of ``more``."""
    return SimpleNamespace(**{f.key.rpartition("__")[2]: f for f in functions}, **more)


@functools.cache
def make_linear(real: type) -> SimpleNamespace:
    """Make the structs, products and functions that models share, for one scalar type, wp.float32 or wp.float64."""
    vec2, vec3, _, mat33, _, Reals = types_of(real)

    @wp.struct
    class Rows:
        """Two rows, of the Jacobian or of Jacobian times axes [px]."""

        first: vec3
        second: vec3

    @wp.struct
    class Gradients:
        """Gradients of the position in the camera and of the intrinsics."""

        v_position: vec3
        v_K: mat33

    @wp.func
    def intrinsics_of(fx: real, fy: real, center: vec2) -> mat33:
        zero = real(0.0)
        return mat33(fx, zero, center[0], zero, fy, center[1], zero, zero, zero)

    @wp.func
    def in_front(position: vec3, lens: Reals, near: real) -> wp.bool:
        # phrased so that a NaN gives False
        return position[2] >= near and position[2] <= real(FAR)

    @wp.func
    def z_of(position: vec3) -> real:
        return position[2]

    @wp.func
    def unclamped(pixel: vec2, width: real, height: real) -> vec2:
        return pixel

    @wp.func
    def clamped(pixel: vec2, width: real, height: real) -> vec2:
        margin = real(FRUSTUM_MARGIN)
        return vec2(
            wp.clamp(pixel[0], -margin * width, width + margin * width),
            wp.clamp(pixel[1], -margin * height, height + margin * height),
        )

    usual = {"in_range": in_front, "depth_of": z_of, "expansion_point": clamped}

    def products(jacobian: Callable[..., Any], *functions: Any, **more: Any) -> SimpleNamespace:
        """Return the functions of a model: the given ones, and those by its ``jacobian(position, K, lens, point) -> Rows``."""

        @wp.func
        def project_axes(position: vec3, K: mat33, lens: Reals, point: vec2, axes: mat33) -> Rows:
            j = jacobian(position, K, lens, point)
            turned = wp.transpose(axes)
            return Rows(turned * j.first, turned * j.second)  # type: ignore[call-arg]  # a struct of Warp

        @wp.func
        def axes_backward(position: vec3, K: mat33, lens: Reals, point: vec2, v_first: vec3, v_second: vec3) -> mat33:
            j = jacobian(position, K, lens, point)
            return wp.outer(j.first, v_first) + wp.outer(j.second, v_second)

        return SimpleNamespace(**usual | vars(named(project_axes, axes_backward, *functions, **more)))

    return named(Rows, Gradients, intrinsics_of, unclamped, usual=usual, products=products)


@register("pinhole")
class Pinhole(CameraModel):
    """The pinhole camera."""

    @staticmethod
    @functools.cache
    def make_functions(real: type) -> SimpleNamespace:
        """Make the functions of `CameraModel.make_functions`."""
        linear = make_linear(real)
        vec2, vec3, _, mat33, _, Reals = types_of(real)

        @wp.func
        def pixel_of(position: vec3, K: mat33, lens: Reals) -> vec2:
            return vec2(K[0, 0] * position[0] / position[2] + K[0, 2], K[1, 1] * position[1] / position[2] + K[1, 2])

        @wp.func
        def project_axes(position: vec3, K: mat33, lens: Reals, point: vec2, axes: mat33) -> linear.Rows:
            z = position[2]
            jx = K[0, 0] / z
            jy = K[1, 1] / z
            jxz = (K[0, 2] - point[0]) / z
            jyz = (K[1, 2] - point[1]) / z
            return linear.Rows(jx * axes[0] + jxz * axes[2], jy * axes[1] + jyz * axes[2])

        @wp.func
        def axes_backward(position: vec3, K: mat33, lens: Reals, point: vec2, v_first: vec3, v_second: vec3) -> mat33:
            inv_z = real(1.0) / position[2]
            jx = K[0, 0] * inv_z
            jy = K[1, 1] * inv_z
            jxz = (K[0, 2] - point[0]) * inv_z
            jyz = (K[1, 2] - point[1]) * inv_z
            return wp.matrix_from_rows(jx * v_first, jy * v_second, jxz * v_first + jyz * v_second)

        @wp.func
        def position_backward(
            position: vec3, K: mat33, lens: Reals, pixel: vec2, point: vec2, axes: mat33,
            v_first: vec3, v_second: vec3, v_pixel: vec2, v_depth: real,
        ) -> linear.Gradients:  # fmt: skip
            x, y = position[0], position[1]
            inv_z = real(1.0) / position[2]
            jx = K[0, 0] * inv_z
            jy = K[1, 1] * inv_z
            jxz = (K[0, 2] - point[0]) * inv_z
            jyz = (K[1, 2] - point[1]) * inv_z
            v_jx = wp.dot(v_first, axes[0])
            v_jxz = wp.dot(v_first, axes[2])
            v_jy = wp.dot(v_second, axes[1])
            v_jyz = wp.dot(v_second, axes[2])
            v_x = v_pixel[0] * jx
            v_y = v_pixel[1] * jy
            v_z = (
                -(v_pixel[0] * jx * x + v_pixel[1] * jy * y + v_jx * jx + v_jy * jy + v_jxz * jxz + v_jyz * jyz) * inv_z
                + v_depth
            )
            v_K = linear.intrinsics_of((v_pixel[0] * x + v_jx) * inv_z, (v_pixel[1] * y + v_jy) * inv_z, v_pixel)
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
            return linear.Gradients(vec3(v_x, v_y, v_z), v_K)

        return named(pixel_of, project_axes, axes_backward, position_backward, **linear.usual)


@register("orthographic")
class Orthographic(CameraModel):
    """The orthographic camera."""

    @staticmethod
    @functools.cache
    def make_functions(real: type) -> SimpleNamespace:
        """Make the functions of `CameraModel.make_functions`."""
        linear = make_linear(real)
        vec2, vec3, _, mat33, _, Reals = types_of(real)

        @wp.func
        def pixel_of(position: vec3, K: mat33, lens: Reals) -> vec2:
            return vec2(K[0, 0] * position[0] + K[0, 2], K[1, 1] * position[1] + K[1, 2])

        @wp.func
        def jacobian(position: vec3, K: mat33, lens: Reals, point: vec2) -> linear.Rows:
            zero = real(0.0)
            return linear.Rows(vec3(K[0, 0], zero, zero), vec3(zero, K[1, 1], zero))

        @wp.func
        def position_backward(
            position: vec3, K: mat33, lens: Reals, pixel: vec2, point: vec2, axes: mat33,
            v_first: vec3, v_second: vec3, v_pixel: vec2, v_depth: real,
        ) -> linear.Gradients:  # fmt: skip
            fx = v_pixel[0] * position[0] + wp.dot(v_first, axes[0])
            fy = v_pixel[1] * position[1] + wp.dot(v_second, axes[1])
            v_position = vec3(v_pixel[0] * K[0, 0], v_pixel[1] * K[1, 1], v_depth)
            return linear.Gradients(v_position, linear.intrinsics_of(fx, fy, v_pixel))

        return linear.products(jacobian, pixel_of, position_backward, expansion_point=linear.unclamped)


@register("opencv")
class OpenCV(CameraModel):
    """The pinhole camera with distortion; coefficients k1, k2, p1, p2, k3, k4, k5, k6, in OpenCV's order."""

    coefficients = 8

    @staticmethod
    @functools.cache
    def make_functions(real: type) -> SimpleNamespace:
        """Make the functions of `CameraModel.make_functions`."""
        linear = make_linear(real)
        vec2, vec3, _, mat33, _, Reals = types_of(real)
        one, two = real(1.0), real(2.0)

        @wp.struct
        class Distorted:
            """The distorted point of (a, b), and its Jacobian, which is symmetric."""

            a: real
            b: real
            aa: real
            ab: real
            bb: real
            folded: wp.bool

        @wp.func
        def radial_at(t: real, lens: Reals) -> tuple[real, real, real, real]:
            """Return the radial factor R = N / M at a squared radius, its first two derivatives by that, and M."""
            three = real(3.0)
            k1, k2, k3, k4, k5, k6 = lens[0], lens[1], lens[4], lens[5], lens[6], lens[7]
            m = one + t * (k4 + t * (k5 + t * k6))
            m1 = k4 + t * (two * k5 + t * three * k6)
            m2 = two * (k5 + t * three * k6)
            value = (one + t * (k1 + t * (k2 + t * k3))) / m
            first = (k1 + t * (two * k2 + t * three * k3) - value * m1) / m
            return value, first, (two * (k2 + t * three * k3) - two * first * m1 - value * m2) / m, m

        @wp.func
        def distort(a: real, b: real, lens: Reals) -> Distorted:
            six = real(6.0)
            p1, p2 = lens[2], lens[3]
            t = a * a + b * b
            value, first, _second, denominator = radial_at(t, lens)
            d = Distorted()
            d.a = a * value + two * p1 * a * b + p2 * (t + two * a * a)
            d.b = b * value + p1 * (t + two * b * b) + two * p2 * a * b
            d.aa = value + two * a * a * first + two * p1 * b + six * p2 * a
            d.ab = two * (a * b * first + p1 * a + p2 * b)
            d.bb = value + two * b * b * first + six * p1 * b + two * p2 * a
            # phrased so that a NaN is folded
            d.folded = not (denominator > real(0.0) and d.aa + d.bb > real(0.0) and d.aa * d.bb - d.ab * d.ab > real(0.0))
            return d

        @wp.func
        def curved(a: real, b: real, v_aa: real, v_ab: real, v_bb: real, lens: Reals) -> vec2:
            """Return the gradients of (a, b) from those of the Jacobian's entries."""
            four = real(4.0)
            six = real(6.0)
            p1, p2 = lens[2], lens[3]
            _value, first, second, _denominator = radial_at(a * a + b * b, lens)
            aaa = six * a * first + four * a * a * a * second + six * p2
            aab = two * b * first + four * a * a * b * second + two * p1
            abb = two * a * first + four * a * b * b * second + two * p2
            bbb = six * b * first + four * b * b * b * second + six * p1
            return vec2(v_aa * aaa + v_ab * aab + v_bb * abb, v_aa * aab + v_ab * abb + v_bb * bbb)

        @wp.func
        def in_range(position: vec3, lens: Reals, near: real) -> wp.bool:
            # phrased so that a NaN gives False
            if not (position[2] >= near and position[2] <= real(FAR)):
                return False
            a = position[0] / position[2]
            b = position[1] / position[2]
            count = int(RIM_SAMPLES)  # a loop, not sixteen copies
            for i in range(count):  # several samples, since the map may rise again beyond a fold
                part = real(i + 1) / real(RIM_SAMPLES)
                s = wp.sqrt(part / (one + (one - part) * (a * a + b * b)))  # evenly spaced in the squared sine of the angle
                d = distort(s * a, s * b, lens)
                if d.folded:
                    return False
            return True

        @wp.func
        def pixel_of(position: vec3, K: mat33, lens: Reals) -> vec2:
            d = distort(position[0] / position[2], position[1] / position[2], lens)
            return vec2(K[0, 0] * d.a + K[0, 2], K[1, 1] * d.b + K[1, 2])

        @wp.func
        def scale_to(limit: real, offset: real) -> real:
            """Return the factor from a pixel's offset to that of the expansion point; 1 where no factor leads to the axis."""
            s = limit / offset
            if offset != limit and s >= real(0.0) and s < one:
                return s
            return one

        @wp.func
        def jacobian(position: vec3, K: mat33, lens: Reals, point: vec2) -> linear.Rows:
            pixel = pixel_of(position, K, lens)
            inv_z = one / position[2]
            a = position[0] * inv_z * scale_to(point[0] - K[0, 2], pixel[0] - K[0, 2])
            b = position[1] * inv_z * scale_to(point[1] - K[1, 2], pixel[1] - K[1, 2])
            d = distort(a, b, lens)
            first = K[0, 0] * inv_z * vec3(d.aa, d.ab, -(d.aa * a + d.ab * b))
            second = K[1, 1] * inv_z * vec3(d.ab, d.bb, -(d.ab * a + d.bb * b))
            return linear.Rows(first, second)

        @wp.func
        def position_backward(
            position: vec3, K: mat33, lens: Reals, pixel: vec2, point: vec2, axes: mat33,
            v_first: vec3, v_second: vec3, v_pixel: vec2, v_depth: real,
        ) -> linear.Gradients:  # fmt: skip
            inv_z = one / position[2]
            jx = K[0, 0] * inv_z
            jy = K[1, 1] * inv_z
            a0 = position[0] * inv_z
            b0 = position[1] * inv_z
            mean = distort(a0, b0, lens)
            sx = one
            sy = one
            if point[0] != pixel[0]:
                sx = scale_to(point[0] - K[0, 2], pixel[0] - K[0, 2])
            if point[1] != pixel[1]:
                sy = scale_to(point[1] - K[1, 2], pixel[1] - K[1, 2])
            a = sx * a0
            b = sy * b0
            d = distort(a, b, lens)
            g = axes * v_first  # gradients of the rows of J
            h = axes * v_second
            u_aa = g[0] - a * g[2]
            u_ab = g[1] - b * g[2]
            w_ab = h[0] - a * h[2]
            w_bb = h[1] - b * h[2]
            first = d.aa * u_aa + d.ab * u_ab  # by jx and jy
            second = d.ab * w_ab + d.bb * w_bb
            bent = curved(a, b, jx * u_aa, jx * u_ab + jy * w_ab, jy * w_bb, lens)
            v_ea = bent[0] - jx * g[2] * d.aa - jy * h[2] * d.ab  # of the expansion point
            v_eb = bent[1] - jx * g[2] * d.ab - jy * h[2] * d.bb
            v_a = v_pixel[0] * K[0, 0] * mean.aa + v_pixel[1] * K[1, 1] * mean.ab
            v_b = v_pixel[0] * K[0, 0] * mean.ab + v_pixel[1] * K[1, 1] * mean.bb
            v_a += v_ea * sx
            v_b += v_eb * sy
            v_K = linear.intrinsics_of(v_pixel[0] * mean.a + first * inv_z, v_pixel[1] * mean.b + second * inv_z, v_pixel)
            if sx < one:  # a = a0 (limit - cx) / (fx distorted a0)
                v_a -= v_ea * a / mean.a * mean.aa
                v_b -= v_ea * a / mean.a * mean.ab
                v_K[0, 0] = v_K[0, 0] - v_ea * a / K[0, 0]
                v_K[0, 2] = v_K[0, 2] - v_ea * a0 / (K[0, 0] * mean.a)
            if sy < one:
                v_a -= v_eb * b / mean.b * mean.ab
                v_b -= v_eb * b / mean.b * mean.bb
                v_K[1, 1] = v_K[1, 1] - v_eb * b / K[1, 1]
                v_K[1, 2] = v_K[1, 2] - v_eb * b0 / (K[1, 1] * mean.b)
            v_z = -(v_a * a0 + v_b * b0 + first * jx + second * jy) * inv_z + v_depth
            return linear.Gradients(vec3(v_a * inv_z, v_b * inv_z, v_z), v_K)

        return linear.products(jacobian, in_range, pixel_of, position_backward)


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
    @functools.cache
    def make_functions(real: type) -> SimpleNamespace:
        """Make the functions of `CameraModel.make_functions`."""
        linear = make_linear(real)
        vec2, vec3, _, mat33, _, Reals = types_of(real)

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
        def slope(t: real, lens: Reals) -> real:
            """Return the derivative of the radius by the angle, whose square is t."""
            return real(1.0) + t * (
                real(3.0) * lens[0] + t * (real(5.0) * lens[1] + t * (real(7.0) * lens[2] + t * real(9.0) * lens[3]))
            )

        @wp.func
        def angle_over_sine(r2: real, z: real) -> tuple[real, real, real]:
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
                return A * inv, real(2.0) * B * inv * inv * inv, real(4.0) * C * inv * inv * inv * inv * inv
            r = wp.sqrt(r2)
            A = wp.atan2(r, z) / r
            B = (z - A) / r2
            return A, B, -(real(2.0) * z + real(3.0) * B) / r2

        @wp.func
        def profile(unit: vec3, lens: Reals) -> Profile:
            two = real(2.0)
            r2 = unit[0] * unit[0] + unit[1] * unit[1]
            z = unit[2]
            A, B, C = angle_over_sine(r2, z)
            t = A * A * r2
            s = real(1.0) + t * (lens[0] + t * (lens[1] + t * (lens[2] + t * lens[3])))
            s1 = lens[0] + t * (two * lens[1] + t * (real(3.0) * lens[2] + t * real(4.0) * lens[3]))
            s2 = two * lens[1] + t * (real(6.0) * lens[2] + t * real(12.0) * lens[3])
            m = slope(t, lens)
            m1 = real(6.0) * lens[0] + t * (real(20.0) * lens[1] + t * (real(42.0) * lens[2] + t * real(72.0) * lens[3]))
            Az = A * z
            p = Profile()
            p.G = A * s
            p.H = B * s + two * A * Az * s1
            p.L = C * s + real(6.0) * B * Az * s1 + real(4.0) * A * (Az * Az * s2 - Az * s1)
            p.E = -m
            p.N = two * m - Az * m1
            p.P = r2 * A * m1 + two * m * z
            return p

        @wp.func
        def distance_of(position: vec3) -> real:
            largest = wp.max(wp.abs(position))
            if not (largest > real(0.0)):
                return largest
            return largest * wp.length(position / largest)

        @wp.func
        def in_range(position: vec3, lens: Reals, near: real) -> wp.bool:
            # phrased so that a NaN gives False
            distance = distance_of(position)
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
                if not (slope(t * t, lens) > real(0.0)):
                    return False
            return True

        @wp.func
        def pixel_of(position: vec3, K: mat33, lens: Reals) -> vec2:
            unit = position / distance_of(position)
            p = profile(unit, lens)
            return vec2(K[0, 0] * unit[0] * p.G + K[0, 2], K[1, 1] * unit[1] * p.G + K[1, 2])

        @wp.func
        def jacobian(position: vec3, K: mat33, lens: Reals, point: vec2) -> linear.Rows:
            distance = distance_of(position)
            unit = position / distance
            x, y = unit[0], unit[1]
            p = profile(unit, lens)
            jx = K[0, 0] / distance
            jy = K[1, 1] / distance
            first = vec3(jx * (p.G + x * x * p.H), jx * x * y * p.H, jx * x * p.E)
            second = vec3(jy * x * y * p.H, jy * (p.G + y * y * p.H), jy * y * p.E)
            return linear.Rows(first, second)

        @wp.func
        def position_backward(
            position: vec3, K: mat33, lens: Reals, pixel: vec2, point: vec2, axes: mat33,
            v_first: vec3, v_second: vec3, v_pixel: vec2, v_depth: real,
        ) -> linear.Gradients:  # fmt: skip
            two = real(2.0)
            distance = distance_of(position)
            unit = position / distance
            x, y = unit[0], unit[1]
            p = profile(unit, lens)
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
            fx = v_pixel[0] * x * p.G + v_row0[0] * (p.G + x * x * p.H) + v_row0[1] * x * y * p.H + v_row0[2] * x * p.E
            fy = v_pixel[1] * y * p.G + v_row1[0] * x * y * p.H + v_row1[1] * (p.G + y * y * p.H) + v_row1[2] * y * p.E
            v_position = vec3(v_x, v_y, v_z) / distance + v_depth * unit
            return linear.Gradients(v_position, linear.intrinsics_of(fx, fy, v_pixel))

        own = {"depth_of": distance_of, "expansion_point": linear.unclamped}
        return linear.products(jacobian, in_range, pixel_of, position_backward, **own)
