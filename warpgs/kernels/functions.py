"""Warp functions that several kernels share, by scalar type: rotations, the projected ellipse, tile spans."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.constants import FARTHEST_PIXEL, LARGEST_AXIS, SHORTEST_QUAT, SMALLEST_DETERMINANT
from warpgs.kernels.cameras.base import CAMERA_MODELS
from warpgs.kernels.covariance import make_covariance


@functools.cache
def make_rotations(real):
    """Make the quaternion and rotation functions for one scalar type (docs/project.md, section 2)."""
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
        # q is a unit quaternion wxyz. Every entry is quadratic in q, so a rounding error of the length only scales the
        # matrix. With ones on the diagonal, the error would rotate it, and move the end of a needle across its width.
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
        # gradient of sum(v * rotation(q)) by q, not constrained to unit length
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
def make_types(real):
    """Make the vector and matrix types that the kernels of one scalar type share."""
    return SimpleNamespace(
        vec2=wp.types.vector(2, real), vec3=wp.types.vector(3, real), vec4=wp.types.vector(4, real),
        mat33=wp.types.matrix((3, 3), real), mat44=wp.types.matrix((4, 4), real),
    )  # fmt: skip


SHRINKS = 6
"""Number of divisions by 2^16 that take `LARGEST_AXIS` below 2^16 px."""


@functools.cache
def make_projection(real, camera_model: str, parameters: str = "stored", lanes: bool = False):
    """Make the steps of the projection that forward and backward share (derivation: docs/project.md).

    Args:
        real: wp.float32 or wp.float64.
        camera_model: Name of the camera model, whose functions are compiled in.
        parameters: Kind of the Gaussians' parameters (`ProjectSettings.parameters`).
        lanes: True for loops that the compiler vectorises: without branches and calls, so culled Gaussians are computed to the
            end, too. Scales and opacities are activated beforehand.
    """
    r = make_rotations(real)
    factor = make_covariance(real).factor
    camera = CAMERA_MODELS.find(camera_model).make_functions(real)
    t = make_types(real)
    vec2 = t.vec2
    vec3 = t.vec3
    vec4 = t.vec4
    mat33 = t.mat33
    mat44 = t.mat44

    @wp.struct
    class Ellipse:
        """One Gaussian in one camera, before colour."""

        valid: wp.int32
        position: vec3  # in the camera [u]
        pixel: vec2  # [px]
        expansion_point: vec2  # pixel at which the Jacobian is taken [px]
        quat: vec4  # unit
        quat_length: real
        scales: vec3  # [u]
        axes: mat33  # camera rotation times Gaussian rotation times scales [u], or times the factor of the covariance
        m1: vec3  # rows of Jacobian times axes, times shrink
        m2: vec3
        shrink: real  # power of two that keeps the squares in range
        a: real  # covariance times shrink^2: xx, xy, yy, determinant
        b: real
        c: real
        det: real

    @wp.func
    def finite3(v: vec3) -> wp.bool:
        if wp.static(lanes):  # isfinite would be a function call
            return (v[0] - v[0]) + (v[1] - v[1]) + (v[2] - v[2]) == real(0.0)
        return wp.isfinite(v[0]) and wp.isfinite(v[1]) and wp.isfinite(v[2])

    @wp.func
    def sigmoid(x: real) -> real:
        if x >= real(0.0):
            return real(1.0) / (real(1.0) + wp.exp(-x))
        t = wp.exp(x)
        return t / (real(1.0) + t)

    @wp.func
    def scales_of(stored: vec3) -> vec3:
        if wp.static(parameters != "stored" or lanes):
            return stored
        return vec3(wp.exp(stored[0]), wp.exp(stored[1]), wp.exp(stored[2]))

    @wp.func
    def opacity_of(stored: real) -> real:
        if wp.static(parameters != "stored"):
            return stored
        return sigmoid(stored)

    @wp.func
    def ellipse(
        mean: vec3, q: vec4, log_scale: vec3, view: mat44, K: mat33, lens: wp.array(dtype=real),
        width: real, height: real, near: real, low_pass: real,
    ) -> Ellipse:  # fmt: skip
        e = Ellipse()
        e.valid = 0
        rotation = mat33(
            view[0, 0], view[0, 1], view[0, 2], view[1, 0], view[1, 1], view[1, 2], view[2, 0], view[2, 1], view[2, 2]
        )
        e.position = rotation * mean + vec3(view[0, 3], view[1, 3], view[2, 3])
        # Guards are phrased so that a NaN fails them.
        before = camera.in_range(e.position, lens, near)
        if wp.static(not lanes):
            if not before:
                return e
        pixel = camera.pixel_of(e.position, K, lens)
        near_image = wp.abs(pixel[0]) <= real(FARTHEST_PIXEL) and wp.abs(pixel[1]) <= real(FARTHEST_PIXEL)
        if wp.static(not lanes):
            if not near_image:
                return e
        e.pixel = pixel
        e.expansion_point = camera.expansion_point(pixel, width, height)
        turned = wp.bool(True)
        sized = wp.bool(True)
        if wp.static(parameters == "covariances"):
            e.axes = rotation * factor(q, log_scale)  # NaN without a factor; culled below
        else:
            e.quat_length = r.quat_length(q)
            turned = e.quat_length >= real(SHORTEST_QUAT) and e.quat_length * real(SHORTEST_QUAT) <= real(1.0)
            if wp.static(not lanes):
                if not turned:
                    return e
            e.quat = q / e.quat_length
            e.scales = scales_of(log_scale)
            sized = finite3(e.scales)  # the logarithm of 0 is -inf, and no error
            if wp.static(not lanes):
                if not sized:
                    return e
            e.axes = rotation * r.rotation(e.quat) * wp.diag(e.scales)
        rows = camera.project_axes(e.position, K, lens, e.expansion_point, e.axes)
        m1 = rows.first
        m2 = rows.second
        finite = finite3(m1) and finite3(m2)
        if wp.static(not lanes):
            if not finite:
                return e
        # det grows with the fourth power of the axes: shrink them below 2^16 px by exact powers of two.
        largest = wp.max(wp.max(wp.abs(m1)), wp.max(wp.abs(m2)))
        short = largest <= real(LARGEST_AXIS)
        if wp.static(not lanes):
            if not short:
                return e
        shrink = real(1.0)
        if wp.static(lanes):
            for _ in range(wp.static(SHRINKS)):
                times = wp.where(largest > real(65536.0), real(1.0 / 65536.0), real(1.0))
                largest *= times
                shrink *= times
        else:
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
        if wp.static(lanes):
            valid = before and near_image and turned and sized and finite and short
            valid = valid and e.det >= real(SMALLEST_DETERMINANT) and e.c >= real(SMALLEST_DETERMINANT)
            e.valid = wp.where(valid, 1, 0)
        elif e.det >= real(SMALLEST_DETERMINANT) and e.c >= real(SMALLEST_DETERMINANT):
            e.valid = 1
        return e

    @wp.func
    def factor_of(e: Ellipse) -> vec3:
        """Return u11, u12 and u22 [1/px] (docs/project.md, section 4)."""
        inv_c = real(1.0) / wp.sqrt(e.c)
        inv_det = real(1.0) / wp.sqrt(e.det)
        return vec3(e.c * inv_c * inv_det, -e.b * inv_c * inv_det, inv_c) * e.shrink

    @wp.func
    def compensation(e: Ellipse) -> real:
        """Return sqrt(det(cov2d) / det(cov2d + low_pass I)), the antialiasing factor of the opacity, at most 1."""
        normal = wp.cross(e.m1, e.m2)
        largest = wp.max(wp.abs(normal))
        if not largest > real(0.0):
            return real(0.0)
        normal = normal / largest  # its square could underflow
        return wp.min(largest * (wp.sqrt(wp.dot(normal, normal)) / wp.sqrt(e.det)), real(1.0))

    @wp.func
    def direction(mean: vec3, view: mat44) -> vec4:
        """Return the unit vector from the camera centre to the mean, and the distance; zeros where the two coincide."""
        centered = mean + vec3(
            view[0, 0] * view[0, 3] + view[1, 0] * view[1, 3] + view[2, 0] * view[2, 3],
            view[0, 1] * view[0, 3] + view[1, 1] * view[1, 3] + view[2, 1] * view[2, 3],
            view[0, 2] * view[0, 3] + view[1, 2] * view[1, 3] + view[2, 2] * view[2, 3],
        )
        largest = wp.max(wp.abs(centered))
        if wp.static(lanes):
            apart = wp.where(largest > real(0.0), largest - largest == real(0.0), False)
        else:
            apart = largest > real(0.0) and wp.isfinite(largest)
            if not apart:
                return vec4()
        d = centered / largest
        length = wp.sqrt(wp.dot(d, d))
        d = d / length
        if wp.static(lanes):
            none = real(0.0)
            return vec4(
                wp.where(apart, d[0], none), wp.where(apart, d[1], none), wp.where(apart, d[2], none),
                wp.where(apart, length * largest, none),
            )  # fmt: skip
        return vec4(d[0], d[1], d[2], length * largest)

    return SimpleNamespace(
        Ellipse=Ellipse, ellipse=ellipse, factor_of=factor_of, compensation=compensation,
        sigmoid=sigmoid, opacity_of=opacity_of, scales_of=scales_of,
        direction=direction, finite3=finite3, project_axes=camera.project_axes,
        rotation=r.rotation, rotation_backward=r.rotation_backward,
        depth_of=camera.depth_of, axes_backward=camera.axes_backward, position_backward=camera.position_backward,
        vec2=vec2, vec3=vec3, vec4=vec4, mat33=mat33, mat44=mat44,
    )  # fmt: skip


@functools.cache
def make_spans(real, lanes: bool = False):
    """Make the functions that decide which tiles a projected Gaussian touches, for one scalar type (docs/tiles.md).

    Counting and emitting call the same functions. Every bound is widened by a margin that covers the rounding of its
    own arithmetic, so a pixel that blending would change is never missed; a tile listed in excess changes nothing.
    """
    vec2 = wp.types.vector(2, real)
    vec3 = wp.types.vector(3, real)
    vec2i = wp.types.vector(2, wp.int32)

    @wp.func
    def tile_range(lo: real, hi: real, begin: wp.int32, size: wp.int32, tile_size: wp.int32) -> vec2i:
        """Return the first tile of the image, and one past the last, with pixel centres of [lo, hi] in the window."""
        limit = real(begin + size)
        # clipped before the cast to int
        first = wp.ceil(wp.clamp(lo - real(0.5), real(begin), limit))
        last = wp.floor(wp.clamp(hi - real(0.5), real(begin) - real(1.0), limit - real(1.0)))
        if wp.static(lanes):  # divisions of integers do not vectorise; those of floats below 2^24 round to no other integer
            side = real(tile_size)
            end = wp.where(last < first, 0, int(last / side) + 1)
            return vec2i(wp.where(last < first, 0, int(first / side)), end)
        if last < first:
            return vec2i(0, 0)
        return vec2i(int(first) // tile_size, int(last) // tile_size + 1)

    @wp.func
    def tile_rows(my: real, half_height: real, origin_y: wp.int32, height: wp.int32, tile_size: wp.int32) -> vec2i:
        """Return the first tile row of the image, and one past the last, that my +- half_height touches in the window."""
        margin = real(0.01) + real(2.0e-6) * (wp.abs(my) + half_height)
        return tile_range(my - half_height - margin, my + half_height + margin, origin_y, height, tile_size)

    @wp.func
    def tile_columns(
        mx: real, my: real, factor: vec3, reach: real, half_width: real, half_height: real,
        row: wp.int32, origin_x: wp.int32, width: wp.int32, tile_size: wp.int32,
    ) -> vec2i:  # fmt: skip
        """Return the first tile column, and one past the last, that the ellipse |U d| <= reach touches in a row of tiles.

        ``reach`` 0 selects the whole box instead of the ellipse.
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
        return tile_range(mx + left - margin, mx + right + margin, origin_x, width, tile_size)

    @wp.func
    def reach_of(opacity: real, alpha_cut: real, square_sigma: real) -> real:
        """Return the Mahalanobis radius r at which alpha falls to the cut, o exp(-r^2/2) = cut; 0 selects the whole box."""
        if alpha_cut > real(0.0) and square_sigma == real(0.0):
            # the last term covers the rounding of the logarithm and of alpha itself
            return wp.sqrt(real(2.0) * wp.log(opacity / alpha_cut) + real(1.0e-5)) * real(1.00001)
        return real(0.0)

    @wp.func
    def half_sides(a: real, b: real, c: real, shrink: real, reach: real, alpha_cut: real, square_sigma: real) -> vec2:
        """Return half width and half height [px] of the box; ``a``, ``b`` and ``c`` are the covariance times shrink^2."""
        half_width = real(1.0e30)  # without a cut every tile is touched
        half_height = real(1.0e30)
        if square_sigma > real(0.0):
            middle = real(0.5) * (a + c)
            longest = middle + wp.sqrt(real(0.25) * (a - c) * (a - c) + b * b)
            half_width = wp.ceil(square_sigma * wp.sqrt(longest) / shrink)
            half_height = half_width
        elif alpha_cut > real(0.0):
            half_width = reach * wp.sqrt(a) / shrink
            half_height = reach * wp.sqrt(c) / shrink
        return vec2(half_width, half_height)

    return SimpleNamespace(
        tile_range=tile_range, tile_rows=tile_rows, tile_columns=tile_columns, reach_of=reach_of, half_sides=half_sides,
        vec2i=vec2i,
    )  # fmt: skip
