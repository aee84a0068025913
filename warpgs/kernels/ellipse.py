"""From a Gaussian to its ellipse in the image: the functions that all forms of the projection share, and their gradients."""

import functools
from types import SimpleNamespace
from typing import NamedTuple, Self

import torch
import warp as wp

from warpgs.constants import COVARIANCE_TOLERANCE, FARTHEST_PIXEL, LARGEST_AXIS, SHORTEST_QUAT, SMALLEST_DETERMINANT
from warpgs.errors import UsageError
from warpgs.kernels import launch, sh
from warpgs.kernels.cameras import CAMERA_MODELS, named, types_of


@functools.cache
def arrays_of(real):
    """Return arrays of vectors of 3 and 4, of matrices of 3 x 3 and 4 x 4, and tables of numbers and of vectors of 3."""
    _, vec3, vec4, mat33, mat44, _ = types_of(real)
    return *(wp.array(dtype=kind) for kind in (vec3, vec4, mat33, mat44)), wp.array2d(dtype=real), wp.array2d(dtype=vec3)


PROJECTED_SIZE = 12
"""Number of values of a projected Gaussian, whose rows are 16-byte aligned in float32:
0:2 mean [px], 2:5 factor u11 u12 u22 [1/px], 5 opacity, 6:9 colour, 9 depth [u] (z; the distance for a fisheye),
10:12 half width and half height [px] of the box that holds every pixel with alpha at or above the cut-off."""

OFF_DIAGONAL = ((0, 1), (0, 2), (1, 2))
"""Rows and columns of the entries of a covariance above the diagonal, in the order in which they are packed."""


class ProjectInputs(NamedTuple):
    """The tensors of a projection, of one scalar type and on one device."""

    means: torch.Tensor
    """World positions [u], shape [N, 3]."""
    quats: torch.Tensor
    """Rotations wxyz, or entries xy, xz, yz of covariances and a 0 (`Pass.parameters`), shape [N, 4]."""
    log_scales: torch.Tensor
    """Logarithm of the axis lengths [u], the lengths themselves, or the diagonals of covariances, shape [N, 3]."""
    logit_opacities: torch.Tensor
    """Inverse sigmoid of the opacity, or the opacity itself, shape [N]."""
    sh: torch.Tensor
    """Spherical-harmonics coefficients of the colour, shape [N, K, 3]."""
    viewmats: torch.Tensor
    """camera_from_world, shape [C, 4, 4]."""
    Ks: torch.Tensor
    """Intrinsics [px] with zero skew, shape [C, 3, 3]."""
    distortion: torch.Tensor
    """Coefficients of the camera model, shape [C, P]. They have no gradient."""
    opacity_factors: torch.Tensor
    """Factors of the opacities, at least 0, shape [N]; shape [0] for none. They have no gradient."""

    def detached(self) -> Self:
        """Return the same tensors [...], detached from autograd."""
        return self._make(t.detach() for t in self)


@functools.lru_cache(maxsize=64)
def nothing(shape: tuple[int, ...], dtype: torch.dtype, device: torch.device) -> torch.Tensor:
    """Return a tensor without entries [...], the same one each time, since making one takes 5 us."""
    with torch.inference_mode(False):  # an inference-mode tensor could not be saved for a backward pass
        return torch.empty(shape, dtype=dtype, device=device)


def checked_factors(means: torch.Tensor, factors: torch.Tensor | None) -> torch.Tensor:
    """Return opacity factors [N] as `ProjectInputs` holds them, [0] for None; UsageError where they require gradients."""
    if factors is None:
        return nothing((0,), means.dtype, means.device)
    launch.check(means=(means, "N 3"), opacity_factors=(factors, "N"))
    if factors.requires_grad and torch.is_grad_enabled():
        raise UsageError("opacity_factors have no gradients: give opacity_factors.detach(), or multiply opacities")
    return factors.detach()


def packed_covariances(covars: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Return the symmetric part of covariances [N, 3, 3] as xy, xz, yz and a 0 [N, 4], and diagonals [N, 3]. Differentiable."""
    # both halves first, since a sum could overflow
    halves = 0.5 * covars
    off = [halves[:, i, j] + halves[:, j, i] for i, j in OFF_DIAGONAL]
    return torch.stack([*off, torch.zeros_like(off[0])], 1), covars.diagonal(dim1=1, dim2=2).contiguous()


SHRINKS = 6
"""Number of divisions by 2^16 that take `LARGEST_AXIS` below 2^16 px."""


@functools.cache
def make_projection(real, camera_model: str, parameters: str = "stored", lanes: bool = False):
    """Make the steps of the projection that forward and backward share (derivation: docs/project.md)."""
    # ``lanes`` is True for loops that the compiler vectorises: without branches and calls, so culled Gaussians are computed to
    # the end, too. Scales and opacities are activated beforehand.
    camera = CAMERA_MODELS.find(camera_model).make_functions(real)
    vec2, vec3, vec4, mat33, mat44, Reals = types_of(real)

    # A covariance is stored as xy, xz, yz and a 0, and its diagonal.

    @wp.func
    def factor(off: vec4, diagonal: vec3) -> mat33:
        """Return M with M M^T = Sigma where Sigma is positive semi-definite within the tolerance; else a NaN, which culls."""
        none = mat33()
        none[0, 0] = real(wp.static(float("nan")))
        S = mat33(
            diagonal[0], off[0], off[1],
            off[0], diagonal[1], off[2],
            off[1], off[2], diagonal[2],
        )  # fmt: skip
        # the axis of the largest variance first, so that rounding stays below it
        p = int(0)
        if S[1, 1] > S[0, 0]:
            p = int(1)
        if S[2, 2] > S[p, p]:
            p = int(2)
        q = (p + 1) % 3
        r = (p + 2) % 3
        largest = S[p, p]
        if not (largest > real(0.0)):
            size = wp.abs(off[0]) + wp.abs(off[1]) + wp.abs(off[2])
            size += wp.abs(diagonal[0]) + wp.abs(diagonal[1]) + wp.abs(diagonal[2])
            if size == real(0.0):
                return mat33()
            return none
        root = wp.sqrt(largest)
        mq = S[p, q] / root
        mr = S[p, r] / root
        # the remainder of the other two axes after the first column
        sqq = S[q, q] - mq * mq
        srr = S[r, r] - mr * mr
        sqr = S[q, r] - mq * mr
        half = real(0.5) * (sqq - srr) / largest
        cross = sqr / largest
        lowest = real(0.5) * (sqq + srr) / largest - wp.sqrt(half * half + cross * cross)
        if not (lowest >= -real(COVARIANCE_TOLERANCE)):
            return none
        if srr > sqq:
            q, r = r, q
            sqq, srr = srr, sqq
            mq, mr = mr, mq
        mqq = real(0.0)
        mrq = real(0.0)
        if sqq > real(0.0):
            mqq = wp.sqrt(sqq)
            mrq = wp.clamp(sqr / mqq, -mqq, mqq)
        M = mat33()
        M[p, 0] = root
        M[q, 0] = mq
        M[r, 0] = mr
        M[q, 1] = mqq
        M[r, 1] = mrq
        M[r, 2] = wp.sqrt(wp.max(srr - mrq * mrq, real(0.0)))
        return M

    # quaternions and rotations: docs/project.md, section 2

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
        w, x, y, z = q[0], q[1], q[2], q[3]
        two = real(2.0)
        return mat33(
            (w * w - z * z) + (x * x - y * y), two * (x * y - w * z), two * (x * z + w * y),
            two * (x * y + w * z), (w * w - z * z) - (x * x - y * y), two * (y * z - w * x),
            two * (x * z - w * y), two * (y * z + w * x), (w * w + z * z) - (x * x + y * y),
        )  # fmt: skip

    @wp.func
    def rotation_backward(q: vec4, v: mat33) -> vec4:
        # gradient of sum(v * rotation(q)) by q, not constrained to unit length
        w, x, y, z = q[0], q[1], q[2], q[3]
        two = real(2.0)
        four = real(4.0)
        v_w = two * (x * (v[2, 1] - v[1, 2]) + y * (v[0, 2] - v[2, 0]) + z * (v[1, 0] - v[0, 1]))
        v_x = two * (w * (v[2, 1] - v[1, 2]) + y * (v[0, 1] + v[1, 0]) + z * (v[0, 2] + v[2, 0])) - four * x * (
            v[1, 1] + v[2, 2]
        )
        v_y = two * (w * (v[0, 2] - v[2, 0]) + x * (v[0, 1] + v[1, 0]) + z * (v[1, 2] + v[2, 1])) - four * y * (
            v[0, 0] + v[2, 2]
        )
        v_z = two * (w * (v[1, 0] - v[0, 1]) + x * (v[0, 2] + v[2, 0]) + y * (v[1, 2] + v[2, 1])) - four * z * (
            v[0, 0] + v[1, 1]
        )
        return vec4(v_w, v_x, v_y, v_z)

    @wp.func
    def rotation_of(view: mat44) -> mat33:
        """Return the rotation of a view matrix."""
        return mat33(view[0, 0], view[0, 1], view[0, 2], view[1, 0], view[1, 1], view[1, 2], view[2, 0], view[2, 1], view[2, 2])

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
        return (v[0] - v[0]) + (v[1] - v[1]) + (v[2] - v[2]) == real(0.0)  # isfinite would be a function call on a CPU

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
        mean: vec3, q: vec4, log_scale: vec3, view: mat44, K: mat33, lens: Reals,
        width: real, height: real, near: real, low_pass: real,
    ) -> Ellipse:  # fmt: skip
        e = Ellipse()
        e.valid = 0
        of_view = rotation_of(view)
        e.position = of_view * mean + vec3(view[0, 3], view[1, 3], view[2, 3])
        # Guards are phrased so that a NaN fails them.
        before = camera.in_range(e.position, lens, near)
        if wp.static(not lanes) and not before:
            return e
        pixel = camera.pixel_of(e.position, K, lens)
        near_image = wp.abs(pixel[0]) <= real(FARTHEST_PIXEL) and wp.abs(pixel[1]) <= real(FARTHEST_PIXEL)
        if wp.static(not lanes) and not near_image:
            return e
        e.pixel = pixel
        e.expansion_point = camera.expansion_point(pixel, width, height)
        turned = wp.bool(True)
        sized = wp.bool(True)
        if wp.static(parameters == "covariances"):
            e.axes = of_view * factor(q, log_scale)  # NaN without a factor; culled below
        else:
            e.quat_length = quat_length(q)
            turned = e.quat_length >= real(SHORTEST_QUAT) and e.quat_length * real(SHORTEST_QUAT) <= real(1.0)
            if wp.static(not lanes) and not turned:
                return e
            e.quat = q / e.quat_length
            e.scales = scales_of(log_scale)
            sized = finite3(e.scales)  # the logarithm of 0 is -inf, and no error
            if wp.static(not lanes) and not sized:
                return e
            e.axes = of_view * rotation(e.quat) * wp.diag(e.scales)
        rows = camera.project_axes(e.position, K, lens, e.expansion_point, e.axes)
        m1 = rows.first
        m2 = rows.second
        finite = finite3(m1) and finite3(m2)
        if wp.static(not lanes) and not finite:
            return e
        # det grows with the fourth power of the axes: shrink them below 2^16 px by exact powers of two.
        largest = wp.max(wp.max(wp.abs(m1)), wp.max(wp.abs(m2)))
        short = largest <= real(LARGEST_AXIS)
        if wp.static(not lanes) and not short:
            return e
        shrink = real(1.0)
        for _ in range(wp.static(SHRINKS)):
            times = wp.where(largest > real(65536.0), real(1.0 / 65536.0), real(1.0))
            largest *= times
            shrink *= times
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
        centered = mean + wp.transpose(rotation_of(view)) * vec3(view[0, 3], view[1, 3], view[2, 3])
        largest = wp.max(wp.abs(centered))
        apart = wp.where(largest > real(0.0), largest - largest == real(0.0), False)
        d = centered / largest
        length = wp.sqrt(wp.dot(d, d))
        d = d / length
        none = real(0.0)
        return vec4(
            wp.where(apart, d[0], none), wp.where(apart, d[1], none), wp.where(apart, d[2], none),
            wp.where(apart, length * largest, none),
        )  # fmt: skip

    own = named(Ellipse, ellipse, factor_of, compensation, sigmoid, opacity_of, scales_of, direction, finite3)
    return SimpleNamespace(**vars(camera) | vars(named(factor, rotation, rotation_backward, rotation_of)) | vars(own))


@functools.cache
def make_spans(real):
    """Make the functions that decide which tiles a projected Gaussian touches, for one scalar type (docs/tiles.md)."""
    # Counting and emitting call the same functions. Every bound is widened by a margin that covers the rounding of its own
    # arithmetic, so a pixel that blending would change is never missed; a tile listed in excess changes nothing.
    vec2, vec3, *_ = types_of(real)
    vec2i = wp.types.vector(2, wp.int32)

    @wp.func
    def tile_range(lo: real, hi: real, begin: wp.int32, size: wp.int32, tile_size: wp.int32) -> vec2i:
        """Return the first tile of the image, and one past the last, with pixel centres of [lo, hi] in the window."""
        limit = real(begin + size)
        # clipped before the cast to int
        first = wp.ceil(wp.clamp(lo - real(0.5), real(begin), limit))
        last = wp.floor(wp.clamp(hi - real(0.5), real(begin) - real(1.0), limit - real(1.0)))
        side = real(tile_size)  # divisions of integers do not vectorise; those of floats below 2^24 round to no other integer
        end = wp.where(last < first, 0, int(last / side) + 1)
        return vec2i(wp.where(last < first, 0, int(first / side)), end)

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

    return named(tile_range, tile_rows, tile_columns, reach_of, half_sides, vec2i=vec2i)


# Gradients of one projected Gaussian, for all backward kernels of `project`. Comments name sections of docs/project.md.


@functools.cache
def make_functions(real, camera_model: str, parameters: str, antialiased: bool, bases: int, lanes: bool = False):
    """Make the functions that compute a Gaussian's gradients from that of the projected Gaussian."""
    # With ``lanes``, they take a projected Gaussian and its gradient as vectors, not as rows of arrays.
    m = make_projection(real, camera_model, parameters, lanes)
    vec2, vec3, vec4, mat33, mat44, Reals = types_of(real)
    basis = sh.make_functions(real, bases)

    row = wp.types.vector(PROJECTED_SIZE, real) if lanes else wp.array2d(dtype=real)

    @wp.func
    def covariance_gradient(first: vec3, second: vec3, v11: real, v12: real, v22: real):
        """Return the gradient of Sigma from those of the projected covariance; ``first`` and ``second`` are J R."""
        V = v11 * wp.outer(first, first) + v12 * (wp.outer(first, second) + wp.outer(second, first))
        V += v22 * wp.outer(second, second)
        off = vec4(V[0, 1] + V[1, 0], V[0, 2] + V[2, 0], V[1, 2] + V[2, 1], real(0.0))
        return off, vec3(V[0, 0], V[1, 1], V[2, 2])

    @wp.func
    def at(values: row, i: int, k: int) -> real:
        """Return a number of a projected Gaussian."""
        if wp.static(lanes):
            return values[k]
        else:
            return values[i, k]

    @wp.struct
    class ShapeGradient:
        """Gradients through the projected mean, the factor and the depth of one projected Gaussian."""

        mean: vec3  # without the part through the colour
        quat: vec4
        log_scale: vec3
        position: vec3  # of the position in the camera
        turned: mat33  # of camera rotation times Gaussian rotation, or times the factor of the covariance
        unit: vec4  # no gradient, but the unit quaternion; unused for covariances
        K: mat33

    @wp.func
    def covariance_2d(e: m.Ellipse, projected: row, v_projected: row, i: int, low_pass: real) -> vec3:
        """Return the gradients of xx, of each xy and of yy of the projected covariance [px^2] (section 9)."""
        u11, u12, u22 = at(projected, i, 2), at(projected, i, 3), at(projected, i, 4)
        h11 = at(v_projected, i, 2) * u11 + at(v_projected, i, 3) * u12
        h12 = at(v_projected, i, 3) * u22
        h22 = at(v_projected, i, 4) * u22
        V = real(-0.5) * vec3(
            h11 * u11 * u11, (h11 * u12 + h12 * u22) * u11, (h11 * u12 + real(2.0) * h12 * u22) * u12 + h22 * u22 * u22
        )
        if wp.static(antialiased):
            compensation = m.compensation(e)
            if compensation > real(0.0):
                aa = wp.dot(e.m1, e.m1)
                cc = wp.dot(e.m2, e.m2)
                by_opacity = real(0.5) * at(v_projected, i, 5) * (at(projected, i, 5) / compensation) / compensation
                by_opacity *= low_pass * e.shrink * e.shrink * e.shrink * e.shrink / e.det
                V += by_opacity * (vec3(cc * e.c + e.b * e.b, -e.b * (cc + e.a), aa * e.a + e.b * e.b) / e.det)
        return V

    @wp.func
    def shape(
        mean: vec3, quat: vec4, log_scale: vec3, view: mat44, K: mat33, lens: Reals,
        width: real, height: real, near: real, low_pass: real,
        projected: row, v_projected: row, i: int,
    ) -> ShapeGradient:  # fmt: skip
        g = ShapeGradient()
        e = m.ellipse(mean, quat, log_scale, view, K, lens, width, height, near, low_pass)
        rotation = m.rotation_of(view)

        # factor -> projected axes (section 4); v_u and u are both per shrunk pixel
        inv_c = real(1.0) / wp.sqrt(e.c)
        inv_det = real(1.0) / wp.sqrt(e.det)
        t11 = at(v_projected, i, 2) * e.shrink * (e.c * inv_c * inv_det)
        t12 = at(v_projected, i, 3) * e.shrink * (-e.b * inv_c * inv_det)
        t22 = at(v_projected, i, 4) * e.shrink * inv_c
        # twice v_det det and v_c c, times shrink; det and c divide vectors of their own size, or needles overflow
        s_det = -(t11 + t12) * e.shrink
        s_c = (t11 - t12 - t22) * e.shrink
        v_b = -at(v_projected, i, 3) * e.shrink * inv_c * (e.shrink * inv_det)
        blur = low_pass * e.shrink * e.shrink
        normal = wp.cross(e.m1, e.m2)
        per_det = real(1.0) / e.det
        per_c = real(1.0) / e.c
        v_m1 = s_det * (per_det * (wp.cross(e.m2, normal) + blur * e.m1)) + v_b * e.m2
        v_m2 = s_det * (per_det * (wp.cross(normal, e.m1) + blur * e.m2)) + v_b * e.m1 + s_c * (per_c * e.m2)
        if wp.static(antialiased):  # compensation -> projected axes (section 4)
            compensation = m.compensation(e)
            if compensation > real(0.0):
                unit = wp.normalize(normal / wp.max(wp.abs(normal)))  # divided, since its square could underflow
                v_compensation = at(v_projected, i, 5) * (at(projected, i, 5) / compensation) * e.shrink
                by_normal = blur * (wp.dot(e.m1, e.m1) + wp.dot(e.m2, e.m2) + blur) * per_det * inv_det
                by_blur = compensation * (blur * per_det)
                v_m1 += v_compensation * (by_normal * wp.cross(e.m2, unit) - by_blur * e.m1)
                v_m2 += v_compensation * (by_normal * wp.cross(unit, e.m1) - by_blur * e.m2)

        # projected axes -> camera axes (section 3)
        v_axes = m.axes_backward(e.position, K, lens, e.expansion_point, v_m1, v_m2)
        axes = e.axes
        if wp.static(parameters == "activated"):  # the axes divided by the scales, which may be 0
            axes = rotation * m.rotation(e.quat)
        v_turned = v_axes  # gradient of camera rotation times Gaussian rotation, or of camera rotation times factor
        if wp.static(parameters == "covariances"):
            V = covariance_2d(e, projected, v_projected, i, low_pass)
            rows = m.project_axes(e.position, K, lens, e.expansion_point, rotation)
            off, diagonal = covariance_gradient(rows.first, rows.second, V[0], V[1], V[2])
            g.quat = off
            g.log_scale = diagonal
        else:
            g.log_scale = wp.cw_mul(v_axes[0], axes[0]) + wp.cw_mul(v_axes[1], axes[1]) + wp.cw_mul(v_axes[2], axes[2])
            v_turned = v_axes * wp.diag(e.scales)
            v_unit = m.rotation_backward(e.quat, wp.transpose(rotation) * v_turned)
            g.quat = (v_unit - e.quat * wp.dot(e.quat, v_unit)) / e.quat_length

        # mean in the image, Jacobian and depth -> position in the camera (section 3)
        v_pixel = vec2(at(v_projected, i, 0), at(v_projected, i, 1))
        p = m.position_backward(
            e.position, K, lens, e.pixel, e.expansion_point, e.axes, v_m1, v_m2, v_pixel, at(v_projected, i, 9)
        )  # fmt: skip
        g.position = p.v_position
        g.mean = wp.transpose(rotation) * g.position
        g.turned = v_turned
        g.unit = e.quat
        g.K = p.v_K
        return g

    @wp.func
    def color(projected: row, v_projected: row, i: int) -> vec3:
        """Return the gradient of the colour before its clamp at zero (section 5)."""
        v_color = vec3(at(v_projected, i, 6), at(v_projected, i, 7), at(v_projected, i, 8))
        for channel in range(3):
            if not (at(projected, i, 6 + channel) > real(0.0)):  # clamped at zero
                v_color[channel] = real(0.0)
        return v_color

    @wp.func
    def centered(d: vec4, w: basis.values) -> vec3:
        """Return the gradient of the mean through its viewing direction ``d``; ``w`` is that of the basis (section 5)."""
        unit = vec3(d[0], d[1], d[2])
        v_unit = basis.basis_backward(unit, w)
        return (v_unit - unit * wp.dot(unit, v_unit)) / wp.where(d[3] > real(0.0), d[3], real(wp.inf))

    @wp.func
    def logit(projected: row, v_projected: row, i: int, logit_opacity: real) -> real:
        """Return the gradient of the opacity's logit, or of the opacity itself (section 6)."""
        if wp.static(parameters != "stored"):
            return at(v_projected, i, 5) * (at(projected, i, 5) / logit_opacity)  # the factor of the opacity, or 1
        return at(v_projected, i, 5) * at(projected, i, 5) * m.sigmoid(-logit_opacity)

    @wp.func
    def view_gradient(
        view: mat44, mean: vec3, quat: vec4, log_scale: vec3, position: vec3, turned: mat33, unit: vec4, v_centered: vec3
    ) -> mat44:  # fmt: skip
        """Return the gradient of the view matrix; arguments are a Gaussian, fields of its ShapeGradient, and `centered`."""
        rotation = m.rotation_of(view)
        t = vec3(view[0, 3], view[1, 3], view[2, 3])
        if wp.static(parameters == "covariances"):
            turning = m.factor(quat, log_scale)
        else:
            turning = m.rotation(unit)
        v_rotation = wp.outer(position, mean) + wp.outer(t, v_centered) + turned * wp.transpose(turning)
        v_t = position + rotation * v_centered
        v_view = mat44()
        for row in range(3):
            for column in range(3):
                v_view[row, column] = v_rotation[row, column]
            v_view[row, 3] = v_t[row]
        return v_view

    return named(ShapeGradient, shape, color, centered, logit, view_gradient)
