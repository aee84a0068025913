"""Warp functions that several ops share, by scalar type: rotations, the factor of the 2D covariance, tile spans."""

import functools
from types import SimpleNamespace

import warp as wp


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
        # q is a unit quaternion wxyz
        w = q[0]
        x = q[1]
        y = q[2]
        z = q[3]
        one = real(1.0)
        two = real(2.0)
        return mat33(
            one - two * (y * y + z * z), two * (x * y - w * z), two * (x * z + w * y),
            two * (x * y + w * z), one - two * (x * x + z * z), two * (y * z - w * x),
            two * (x * z - w * y), two * (y * z + w * x), one - two * (x * x + y * y),
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
def make_spans(real):
    """Functions that decide which tiles a projected Gaussian touches, for one scalar type (docs/tiles.md).

    Counting and emitting call the same functions. Every bound is widened by a margin that covers the rounding of its
    own arithmetic, so a pixel that blending would draw is never missed; a tile listed in excess draws nothing.
    """
    vec3 = wp.types.vector(3, real)
    vec2i = wp.types.vector(2, wp.int32)

    @wp.func
    def pixel_range(lo: real, hi: real, size: wp.int32) -> vec2i:
        """Pixels whose centres lie in [lo, hi], clipped to the image in floating point before the cast."""
        limit = real(size)
        first = wp.ceil(wp.clamp(lo - real(0.5), real(0.0), limit))
        last = wp.floor(wp.clamp(hi - real(0.5), real(-1.0), limit - real(1.0)))
        return vec2i(int(first), int(last))

    @wp.func
    def tile_rows(my: real, half_height: real, height: wp.int32, tile_size: wp.int32) -> vec2i:
        """First tile row and one past the last that [my - half_height, my + half_height] touches."""
        margin = real(0.01) + real(2.0e-6) * (wp.abs(my) + half_height)
        rows = pixel_range(my - half_height - margin, my + half_height + margin, height)
        if rows[1] < rows[0]:
            return vec2i(0, 0)
        return vec2i(rows[0] // tile_size, rows[1] // tile_size + 1)

    @wp.func
    def tile_columns(
        mx: real, my: real, factor: vec3, reach: real, half_width: real, half_height: real,
        row: wp.int32, width: wp.int32, tile_size: wp.int32,
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
        columns = pixel_range(mx + left - margin, mx + right + margin, width)
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
