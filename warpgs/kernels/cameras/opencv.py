"""The pinhole camera with OpenCV's radial and tangential distortion, Brown-Conrady (docs/project.md, section 3)."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.constants import FAR, FRUSTUM_MARGIN, RIM_SAMPLES
from warpgs.kernels.cameras.base import CameraModel, register
from warpgs.kernels.cameras.linear import make_linear


@register("opencv")
class OpenCV(CameraModel):
    """The pinhole camera with distortion; coefficients k1, k2, p1, p2, k3, k4, k5, k6, in OpenCV's order."""

    coefficients = 8

    @staticmethod
    def make_functions(real: type) -> SimpleNamespace:
        """Make the functions of `CameraModel.make_functions`."""
        return _make_functions(real)


@functools.cache
def _make_distortion(real: type) -> SimpleNamespace:
    vec2 = wp.types.vector(2, real)
    one = real(1.0)
    two = real(2.0)

    @wp.struct
    class Radial:
        """The radial factor R = N / M at a squared radius, and its first two derivatives by the squared radius."""

        value: real
        first: real
        second: real
        denominator: real

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
    def radial_at(t: real, lens: wp.array(dtype=real)) -> Radial:
        three = real(3.0)
        k1 = lens[0]
        k2 = lens[1]
        k3 = lens[4]
        k4 = lens[5]
        k5 = lens[6]
        k6 = lens[7]
        m = one + t * (k4 + t * (k5 + t * k6))
        m1 = k4 + t * (two * k5 + t * three * k6)
        m2 = two * (k5 + t * three * k6)
        r = Radial()
        r.denominator = m
        r.value = (one + t * (k1 + t * (k2 + t * k3))) / m
        r.first = (k1 + t * (two * k2 + t * three * k3) - r.value * m1) / m
        r.second = (two * (k2 + t * three * k3) - two * r.first * m1 - r.value * m2) / m
        return r

    @wp.func
    def distort(a: real, b: real, lens: wp.array(dtype=real)) -> Distorted:
        six = real(6.0)
        p1 = lens[2]
        p2 = lens[3]
        t = a * a + b * b
        r = radial_at(t, lens)
        d = Distorted()
        d.a = a * r.value + two * p1 * a * b + p2 * (t + two * a * a)
        d.b = b * r.value + p1 * (t + two * b * b) + two * p2 * a * b
        d.aa = r.value + two * a * a * r.first + two * p1 * b + six * p2 * a
        d.ab = two * (a * b * r.first + p1 * a + p2 * b)
        d.bb = r.value + two * b * b * r.first + six * p1 * b + two * p2 * a
        # phrased so that a NaN is folded
        d.folded = not (r.denominator > real(0.0) and d.aa + d.bb > real(0.0) and d.aa * d.bb - d.ab * d.ab > real(0.0))
        return d

    @wp.func
    def curved(a: real, b: real, v_aa: real, v_ab: real, v_bb: real, lens: wp.array(dtype=real)) -> vec2:
        """Return the gradients of (a, b) from those of the Jacobian's entries."""
        four = real(4.0)
        six = real(6.0)
        p1 = lens[2]
        p2 = lens[3]
        r = radial_at(a * a + b * b, lens)
        aaa = six * a * r.first + four * a * a * a * r.second + six * p2
        aab = two * b * r.first + four * a * a * b * r.second + two * p1
        abb = two * a * r.first + four * a * b * b * r.second + two * p2
        bbb = six * b * r.first + four * b * b * b * r.second + six * p1
        return vec2(v_aa * aaa + v_ab * aab + v_bb * abb, v_aa * aab + v_ab * abb + v_bb * bbb)

    return SimpleNamespace(distort=distort, curved=curved)


@functools.cache
def _make_functions(real: type) -> SimpleNamespace:
    linear = make_linear(real)
    lensed = _make_distortion(real)
    vec2 = wp.types.vector(2, real)
    vec3 = wp.types.vector(3, real)
    mat33 = wp.types.matrix((3, 3), real)
    one = real(1.0)

    @wp.func
    def in_range(position: vec3, lens: wp.array(dtype=real), near: real) -> wp.bool:
        # phrased so that a NaN gives False
        if not (position[2] >= near and position[2] <= real(FAR)):
            return False
        a = position[0] / position[2]
        b = position[1] / position[2]
        count = int(RIM_SAMPLES)  # a loop, not sixteen copies
        for i in range(count):  # several samples, since the map may rise again beyond a fold
            part = real(i + 1) / real(RIM_SAMPLES)
            s = wp.sqrt(part / (one + (one - part) * (a * a + b * b)))  # evenly spaced in the squared sine of the angle
            d = lensed.distort(s * a, s * b, lens)
            if d.folded:
                return False
        return True

    @wp.func
    def depth_of(position: vec3) -> real:
        return position[2]

    @wp.func
    def pixel_of(position: vec3, K: mat33, lens: wp.array(dtype=real)) -> vec2:
        d = lensed.distort(position[0] / position[2], position[1] / position[2], lens)
        return vec2(K[0, 0] * d.a + K[0, 2], K[1, 1] * d.b + K[1, 2])

    @wp.func
    def expansion_point(pixel: vec2, width: real, height: real) -> vec2:
        margin = real(FRUSTUM_MARGIN)
        return vec2(
            wp.clamp(pixel[0], -margin * width, width + margin * width),
            wp.clamp(pixel[1], -margin * height, height + margin * height),
        )

    @wp.func
    def scale_to(limit: real, offset: real) -> real:
        """Return the factor from a pixel's offset to that of the expansion point; 1 where no factor leads to the axis."""
        s = limit / offset
        if offset != limit and s >= real(0.0) and s < one:
            return s
        return one

    @wp.func
    def jacobian(position: vec3, K: mat33, lens: wp.array(dtype=real), point: vec2) -> linear.Rows:
        pixel = pixel_of(position, K, lens)
        inv_z = one / position[2]
        a = position[0] * inv_z * scale_to(point[0] - K[0, 2], pixel[0] - K[0, 2])
        b = position[1] * inv_z * scale_to(point[1] - K[1, 2], pixel[1] - K[1, 2])
        d = lensed.distort(a, b, lens)
        first = K[0, 0] * inv_z * vec3(d.aa, d.ab, -(d.aa * a + d.ab * b))
        second = K[1, 1] * inv_z * vec3(d.ab, d.bb, -(d.ab * a + d.bb * b))
        return linear.rows_of(first, second)

    @wp.func
    def project_axes(position: vec3, K: mat33, lens: wp.array(dtype=real), point: vec2, axes: mat33) -> linear.Rows:
        return linear.times_axes(jacobian(position, K, lens, point), axes)

    @wp.func
    def axes_backward(
        position: vec3, K: mat33, lens: wp.array(dtype=real), point: vec2, v_first: vec3, v_second: vec3
    ) -> mat33:
        return linear.transposed_times(jacobian(position, K, lens, point), v_first, v_second)

    @wp.func
    def position_backward(
        position: vec3, K: mat33, lens: wp.array(dtype=real), pixel: vec2, point: vec2, axes: mat33,
        v_first: vec3, v_second: vec3, v_pixel: vec2, v_depth: real,
    ) -> linear.Gradients:  # fmt: skip
        inv_z = one / position[2]
        jx = K[0, 0] * inv_z
        jy = K[1, 1] * inv_z
        a0 = position[0] * inv_z
        b0 = position[1] * inv_z
        mean = lensed.distort(a0, b0, lens)
        sx = one
        sy = one
        if point[0] != pixel[0]:
            sx = scale_to(point[0] - K[0, 2], pixel[0] - K[0, 2])
        if point[1] != pixel[1]:
            sy = scale_to(point[1] - K[1, 2], pixel[1] - K[1, 2])
        a = sx * a0
        b = sy * b0
        d = lensed.distort(a, b, lens)
        g = axes * v_first  # gradients of the rows of J
        h = axes * v_second
        u_aa = g[0] - a * g[2]
        u_ab = g[1] - b * g[2]
        w_ab = h[0] - a * h[2]
        w_bb = h[1] - b * h[2]
        first = d.aa * u_aa + d.ab * u_ab  # by jx and jy
        second = d.ab * w_ab + d.bb * w_bb
        bent = lensed.curved(a, b, jx * u_aa, jx * u_ab + jy * w_ab, jy * w_bb, lens)
        v_ea = bent[0] - jx * g[2] * d.aa - jy * h[2] * d.ab  # of the expansion point
        v_eb = bent[1] - jx * g[2] * d.ab - jy * h[2] * d.bb
        v_a = v_pixel[0] * K[0, 0] * mean.aa + v_pixel[1] * K[1, 1] * mean.ab
        v_b = v_pixel[0] * K[0, 0] * mean.ab + v_pixel[1] * K[1, 1] * mean.bb
        v_a += v_ea * sx
        v_b += v_eb * sy
        v_K = mat33()
        v_K[0, 0] = v_pixel[0] * mean.a + first * inv_z
        v_K[1, 1] = v_pixel[1] * mean.b + second * inv_z
        v_K[0, 2] = v_pixel[0]
        v_K[1, 2] = v_pixel[1]
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
        gradients = linear.Gradients()
        gradients.v_position = vec3(v_a * inv_z, v_b * inv_z, v_z)
        gradients.v_K = v_K
        return gradients

    return SimpleNamespace(
        in_range=in_range, depth_of=depth_of, pixel_of=pixel_of, expansion_point=expansion_point, project_axes=project_axes,
        axes_backward=axes_backward, position_backward=position_backward,
    )  # fmt: skip
