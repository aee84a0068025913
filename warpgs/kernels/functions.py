"""Warp functions by scalar type that kernels share: rotations, the projected ellipse, tile spans."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.constants import FAR, FARTHEST_PIXEL, FRUSTUM_MARGIN, LARGEST_AXIS, SHORTEST_QUAT, SMALLEST_DETERMINANT


@functools.cache
def make_rotations(real):
    """Quaternion and rotation functions for one scalar type (docs/project.md, section 2)."""
    vec4 = wp.types.vector(4, real)
    mat33 = wp.types.matrix((3, 3), real)

    @wp.func
    def quat_length(q: vec4) -> real:
        # Dividing by the largest component first keeps the square in range, and makes q and 2^k q give the same bits.
        largest = wp.max(wp.max(wp.abs(q[0]), wp.abs(q[1])), wp.max(wp.abs(q[2]), wp.abs(q[3])))
        p = q / largest
        return largest * wp.sqrt(wp.dot(p, p))

    @wp.func
    def rotation(q: vec4) -> mat33:
        # q is a unit quaternion wxyz. Every entry is of second degree, so what rounding takes from its length only scales the
        # matrix; with ones on the diagonal it would turn it, and a needle's end would move across its width.
        w = q[0]
        x = q[1]
        y = q[2]
        z = q[3]
        two = real(2.0)
        return mat33(
            (w * w - z * z) + (x * x - y * y), two * (x * y - w * z), two * (x * z + w * y),
            two * (x * y + w * z), (w * w - z * z) - (x * x - y * y), two * (y * z - w * x),
            two * (x * z - w * y), two * (y * z + w * x), (w * w + z * z) - (x * x + y * y),
        )  # fmt: skip

    @wp.func
    def rotation_backward(q: vec4, v: mat33) -> vec4:
        # gradient of sum(v * rotation(q)) for free q
        w = q[0]
        x = q[1]
        y = q[2]
        z = q[3]
        two = real(2.0)
        four = real(4.0)
        v_w = two * (x * (v[2, 1] - v[1, 2]) + y * (v[0, 2] - v[2, 0]) + z * (v[1, 0] - v[0, 1]))
        v_x = (
            two * (w * (v[2, 1] - v[1, 2]) + y * (v[0, 1] + v[1, 0]) + z * (v[0, 2] + v[2, 0]))
            - four * x * (v[1, 1] + v[2, 2])
        )  # fmt: skip
        v_y = (
            two * (w * (v[0, 2] - v[2, 0]) + x * (v[0, 1] + v[1, 0]) + z * (v[1, 2] + v[2, 1]))
            - four * y * (v[0, 0] + v[2, 2])
        )  # fmt: skip
        v_z = (
            two * (w * (v[1, 0] - v[0, 1]) + x * (v[0, 2] + v[2, 0]) + y * (v[1, 2] + v[2, 1]))
            - four * z * (v[0, 0] + v[1, 1])
        )  # fmt: skip
        return vec4(v_w, v_x, v_y, v_z)

    return SimpleNamespace(quat_length=quat_length, rotation=rotation, rotation_backward=rotation_backward)


@functools.cache
def make_projection(real):
    """The steps of the projection that forward and backward share (docs/project.md has the derivation)."""
    r = make_rotations(real)
    vec2 = wp.types.vector(2, real)
    vec3 = wp.types.vector(3, real)
    vec4 = wp.types.vector(4, real)
    mat33 = wp.types.matrix((3, 3), real)
    mat44 = wp.types.matrix((4, 4), real)

    @wp.struct
    class Ellipse:
        """What is left of one Gaussian in one camera, before colour."""

        valid: wp.int32
        position: vec3  # in the camera [u]
        pixel: vec2  # [px]
        clamped: vec2  # pixel that the Jacobian is taken at [px]
        quat: vec4  # unit
        quat_length: real
        scales: vec3  # [u]
        axes: mat33  # camera rotation times Gaussian rotation times scales [u]
        m1: vec3  # rows of Jacobian times axes, times shrink
        m2: vec3
        shrink: real  # power of two that keeps the squares in range
        a: real  # covariance times shrink^2: xx, xy, yy, determinant
        b: real
        c: real
        det: real

    @wp.func
    def finite3(v: vec3) -> wp.bool:
        return wp.isfinite(v[0]) and wp.isfinite(v[1]) and wp.isfinite(v[2])

    @wp.func
    def ellipse(
        mean: vec3, q: vec4, log_scale: vec3, view: mat44, K: mat33,
        width: real, height: real, near: real, low_pass: real,
    ) -> Ellipse:  # fmt: skip
        e = Ellipse()
        e.valid = 0
        rotation = mat33(
            view[0, 0], view[0, 1], view[0, 2], view[1, 0], view[1, 1], view[1, 2], view[2, 0], view[2, 1], view[2, 2]
        )
        e.position = rotation * mean + vec3(view[0, 3], view[1, 3], view[2, 3])
        x = e.position[0]
        y = e.position[1]
        z = e.position[2]
        # Guards are phrased so that a NaN fails them.
        if not (z >= near and z <= real(FAR)):
            return e
        px = K[0, 0] * x / z + K[0, 2]
        py = K[1, 1] * y / z + K[1, 2]
        if not (wp.abs(px) <= real(FARTHEST_PIXEL) and wp.abs(py) <= real(FARTHEST_PIXEL)):
            return e
        e.quat_length = r.quat_length(q)
        if not (e.quat_length >= real(SHORTEST_QUAT) and e.quat_length * real(SHORTEST_QUAT) <= real(1.0)):
            return e
        if not finite3(log_scale):  # -inf would be an axis of length 0, which log 0 is not meant to say
            return e
        e.quat = q / e.quat_length
        e.scales = vec3(wp.exp(log_scale[0]), wp.exp(log_scale[1]), wp.exp(log_scale[2]))
        e.pixel = vec2(px, py)
        margin = real(FRUSTUM_MARGIN)
        e.clamped = vec2(
            wp.clamp(px, -margin * width, width + margin * width),
            wp.clamp(py, -margin * height, height + margin * height),
        )
        e.axes = rotation * r.rotation(e.quat) * wp.diag(e.scales)
        jx = K[0, 0] / z
        jy = K[1, 1] / z
        jxz = (K[0, 2] - e.clamped[0]) / z
        jyz = (K[1, 2] - e.clamped[1]) / z
        m1 = vec3(
            jx * e.axes[0, 0] + jxz * e.axes[2, 0],
            jx * e.axes[0, 1] + jxz * e.axes[2, 1],
            jx * e.axes[0, 2] + jxz * e.axes[2, 2],
        )
        m2 = vec3(
            jy * e.axes[1, 0] + jyz * e.axes[2, 0],
            jy * e.axes[1, 1] + jyz * e.axes[2, 1],
            jy * e.axes[1, 2] + jyz * e.axes[2, 2],
        )
        if not (finite3(m1) and finite3(m2)):
            return e
        # det grows with the fourth power of the axes: shrink them below 2^16 px by exact powers of two.
        largest = wp.max(wp.max(wp.abs(m1)), wp.max(wp.abs(m2)))
        if not (largest <= real(LARGEST_AXIS)):
            return e
        shrink = real(1.0)
        while largest > real(65536.0):
            largest *= real(1.0 / 65536.0)
            shrink *= real(1.0 / 65536.0)
        e.shrink = shrink
        e.m1 = m1 * shrink
        e.m2 = m2 * shrink
        blur = low_pass * shrink * shrink
        normal = wp.cross(e.m1, e.m2)
        aa = wp.dot(e.m1, e.m1)
        cc = wp.dot(e.m2, e.m2)
        # Cauchy-Binet: only positive terms, where a c - b^2 would cancel
        e.det = wp.dot(normal, normal) + blur * (aa + cc) + blur * blur
        e.a = aa + blur
        e.b = wp.dot(e.m1, e.m2)
        e.c = cc + blur
        if e.det >= real(SMALLEST_DETERMINANT) and e.c >= real(SMALLEST_DETERMINANT):
            e.valid = 1
        return e

    @wp.func
    def sigmoid(x: real) -> real:
        if x >= real(0.0):
            return real(1.0) / (real(1.0) + wp.exp(-x))
        t = wp.exp(x)
        return t / (real(1.0) + t)

    @wp.func
    def direction(mean: vec3, view: mat44) -> vec4:
        """Unit vector from the camera centre to the mean, and the distance; zero where they coincide."""
        centered = mean + vec3(
            view[0, 0] * view[0, 3] + view[1, 0] * view[1, 3] + view[2, 0] * view[2, 3],
            view[0, 1] * view[0, 3] + view[1, 1] * view[1, 3] + view[2, 1] * view[2, 3],
            view[0, 2] * view[0, 3] + view[1, 2] * view[1, 3] + view[2, 2] * view[2, 3],
        )
        largest = wp.max(wp.abs(centered))
        if not (largest > real(0.0) and wp.isfinite(largest)):
            return vec4()
        d = centered / largest
        length = wp.sqrt(wp.dot(d, d))
        d = d / length
        return vec4(d[0], d[1], d[2], length * largest)

    return SimpleNamespace(
        Ellipse=Ellipse, ellipse=ellipse, sigmoid=sigmoid, direction=direction, finite3=finite3,
        rotation=r.rotation, rotation_backward=r.rotation_backward,
        vec3=vec3, vec4=vec4, mat33=mat33, mat44=mat44,
    )  # fmt: skip


@functools.cache
def make_spans(real):
    """Functions that decide which tiles a projected Gaussian touches, for one scalar type (docs/tiles.md).

    Counting and emitting call the same functions. Every bound is widened by a margin that covers the rounding of its
    own arithmetic, so a pixel that blending would draw is never missed; a tile listed in excess draws nothing.
    """
    vec3 = wp.types.vector(3, real)
    vec2i = wp.types.vector(2, wp.int32)

    @wp.func
    def pixel_range(lo: real, hi: real, begin: wp.int32, size: wp.int32) -> vec2i:
        """Pixels from ``begin`` on whose centres lie in [lo, hi], clipped in floating point before the cast."""
        limit = real(begin + size)
        first = wp.ceil(wp.clamp(lo - real(0.5), real(begin), limit))
        last = wp.floor(wp.clamp(hi - real(0.5), real(begin) - real(1.0), limit - real(1.0)))
        return vec2i(int(first), int(last))

    @wp.func
    def tile_rows(my: real, half_height: real, origin_y: wp.int32, height: wp.int32, tile_size: wp.int32) -> vec2i:
        """First tile row of the picture, and one past the last, that my +- half_height touches within the window."""
        margin = real(0.01) + real(2.0e-6) * (wp.abs(my) + half_height)
        rows = pixel_range(my - half_height - margin, my + half_height + margin, origin_y, height)
        if rows[1] < rows[0]:
            return vec2i(0, 0)
        return vec2i(rows[0] // tile_size, rows[1] // tile_size + 1)

    @wp.func
    def tile_columns(
        mx: real, my: real, factor: vec3, reach: real, half_width: real, half_height: real,
        row: wp.int32, origin_x: wp.int32, width: wp.int32, tile_size: wp.int32,
    ) -> vec2i:  # fmt: skip
        """First tile column and one past the last that the ellipse |U d| <= reach touches in a row of tiles.

        ``reach`` 0 asks for the whole box instead of the ellipse.
        """
        margin = real(0.01) + real(2.0e-6) * (wp.abs(mx) + half_width)
        left = -half_width
        right = half_width
        # Beyond a million pixels the squares below lose their range; the box is then as good as the ellipse.
        if reach > real(0.0) and factor[0] > real(1.0e-6) and factor[2] > real(1.0e-6):
            slack = real(0.01) + real(2.0e-6) * (wp.abs(my) + half_height)
            top = real(row * tile_size) + real(0.5) - my - slack
            bottom = top + real(tile_size - 1) + real(2.0) * slack
            top = wp.max(top, -half_height)
            bottom = wp.min(bottom, half_height)
            # height at which the ellipse is widest: half_width * cov_xy / cov_xx in terms of the factor
            turn = -half_width * factor[1] * factor[0] / (factor[1] * factor[1] + factor[2] * factor[2])
            dy = wp.clamp(turn, top, bottom)
            e = factor[2] * dy
            right = (wp.sqrt(wp.max(reach * reach - e * e, real(0.0))) - factor[1] * dy) / factor[0]
            dy = wp.clamp(-turn, top, bottom)
            e = factor[2] * dy
            left = (-wp.sqrt(wp.max(reach * reach - e * e, real(0.0))) - factor[1] * dy) / factor[0]
        columns = pixel_range(mx + left - margin, mx + right + margin, origin_x, width)
        if columns[1] < columns[0]:
            return vec2i(0, 0)
        return vec2i(columns[0] // tile_size, columns[1] // tile_size + 1)

    @wp.func
    def reach_of(opacity: real, alpha_cut: real, square_sigma: real) -> real:
        """Mahalanobis radius at which alpha falls to the cut: o exp(-r^2/2) = cut; 0 stands for the whole box."""
        if alpha_cut > real(0.0) and square_sigma == real(0.0):
            # the last term covers the rounding of the logarithm and of alpha itself
            return wp.sqrt(real(2.0) * wp.log(opacity / alpha_cut) + real(1.0e-5)) * real(1.00001)
        return real(0.0)

    return SimpleNamespace(
        pixel_range=pixel_range, tile_rows=tile_rows, tile_columns=tile_columns, reach_of=reach_of, vec2i=vec2i
    )
