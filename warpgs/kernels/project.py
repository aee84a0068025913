"""Project 3D Gaussians to image-space ellipses: activations, EWA covariance, its factor, colour, and tile counts."""

import functools

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from warpgs.constants import Rule
from warpgs.kernels import bridge, sh
from warpgs.kernels.functions import make_projection, make_spans
from warpgs.kernels.native import BLOCK
from warpgs.kernels.native import make_functions as make_native

RECORD = 12
"""Floats of a projected Gaussian ("splat"), 16-byte aligned in float32:
0:2 mean [px], 2:5 factor u11 u12 u22 [1/px], 5 opacity, 6:9 colour, 9 z-depth [u],
10:12 half width and half height [px] of the box that holds every pixel with alpha at or above the cut."""


@functools.cache
def make_forward(real, native: bool):
    """The forward kernel for one scalar type; ``native`` for CUDA and float32."""
    m = make_projection(real)
    s = make_spans(real)
    basis = sh.make_functions(real).basis
    vec3 = m.vec3
    color_of = make_native().color if native else None

    @wp.kernel(enable_backward=False, module=f"warpgs.kernels.project.forward.{real.__name__}.{int(native)}")
    def forward(
        begin: int,
        means: wp.array(dtype=m.vec3), quats: wp.array(dtype=m.vec4), log_scales: wp.array(dtype=m.vec3),
        logit_opacities: wp.array(dtype=real), coefficients: wp.array2d(dtype=m.vec3),
        viewmats: wp.array(dtype=m.mat44), Ks: wp.array(dtype=m.mat33),
        width: int, height: int, tile_size: int, sh_count: int,
        near: real, low_pass: real, alpha_cut: real, square_sigma: real,
        # outputs, zero on entry
        splats: wp.array2d(dtype=real), tile_counts: wp.array(dtype=int),
    ):  # fmt: skip
        i = begin + wp.tid()
        count = means.shape[0]
        camera = i // count
        n = i - camera * count
        view = viewmats[camera]
        e = m.ellipse(
            means[n], quats[n], log_scales[n], view, Ks[camera], real(width), real(height), near, low_pass
        )  # fmt: skip
        if e.valid == 0:
            return
        opacity = m.sigmoid(logit_opacities[n])
        if not (opacity > real(0.0) and opacity >= alpha_cut):
            return
        d = m.direction(means[n], view)
        y = basis(vec3(d[0], d[1], d[2]))
        color = vec3(real(0.5), real(0.5), real(0.5))
        if wp.static(native):
            for k in range(16):
                if k >= sh_count:
                    y[k] = real(0.0)
            color += color_of(coefficients, n, sh_count, y)
        else:
            for k in range(16):
                if k < sh_count:
                    color += y[k] * coefficients[n, k]
        if not m.finite3(color):
            return

        inv_c = real(1.0) / wp.sqrt(e.c)
        inv_det = real(1.0) / wp.sqrt(e.det)
        factor = vec3(e.c * inv_c * inv_det, -e.b * inv_c * inv_det, inv_c) * e.shrink
        if not m.finite3(factor):
            return

        reach = s.reach_of(opacity, alpha_cut, square_sigma)
        half_width = real(1.0e30)  # without a cut every tile is touched
        half_height = real(1.0e30)
        if square_sigma > real(0.0):
            middle = real(0.5) * (e.a + e.c)
            longest = middle + wp.sqrt(real(0.25) * (e.a - e.c) * (e.a - e.c) + e.b * e.b)
            half_width = wp.ceil(square_sigma * wp.sqrt(longest) / e.shrink)
            half_height = half_width
        elif alpha_cut > real(0.0):
            half_width = reach * wp.sqrt(e.a) / e.shrink
            half_height = reach * wp.sqrt(e.c) / e.shrink

        rows = s.tile_rows(e.pixel[1], half_height, height, tile_size)
        tiles = int(0)
        for row in range(rows[0], rows[1]):
            columns = s.tile_columns(e.pixel[0], e.pixel[1], factor, reach, half_width, half_height, row, width, tile_size)
            tiles += columns[1] - columns[0]
        if tiles == 0:
            return
        splats[i, 0] = e.pixel[0]
        splats[i, 1] = e.pixel[1]
        splats[i, 2] = factor[0]
        splats[i, 3] = factor[1]
        splats[i, 4] = factor[2]
        splats[i, 5] = opacity
        splats[i, 6] = wp.max(color[0], real(0.0))
        splats[i, 7] = wp.max(color[1], real(0.0))
        splats[i, 8] = wp.max(color[2], real(0.0))
        splats[i, 9] = e.position[2]
        splats[i, 10] = half_width
        splats[i, 11] = half_height
        tile_counts[i] = tiles

    return forward


@functools.cache
def make_backward(real, native: bool):
    """The backward kernel for one scalar type: one thread per Gaussian, over all cameras, so no sum needs atomics.

    ``native`` is for CUDA and float32: the Gaussians that some camera sees are dealt to the first threads of each block.
    """
    m = make_projection(real)
    functions = sh.make_functions(real)
    vec3 = m.vec3
    vec4 = m.vec4
    vec16 = functions.vec16
    mat33 = m.mat33
    compact = make_native().compact if native else None
    color_backward = make_native().color_backward if native else None

    @wp.kernel(enable_backward=False, module=f"warpgs.kernels.project.backward.{real.__name__}.{int(native)}")
    def backward(
        begin: int,
        means: wp.array(dtype=m.vec3), quats: wp.array(dtype=m.vec4), log_scales: wp.array(dtype=m.vec3),
        logit_opacities: wp.array(dtype=real), coefficients: wp.array2d(dtype=m.vec3),
        viewmats: wp.array(dtype=m.mat44), Ks: wp.array(dtype=m.mat33),
        width: int, height: int, sh_count: int, near: real, low_pass: real,
        splats: wp.array2d(dtype=real), tile_counts: wp.array(dtype=int), v_splats: wp.array2d(dtype=real),
        camera_gradients: int,
        # outputs, zero on entry
        v_means: wp.array(dtype=m.vec3), v_quats: wp.array(dtype=m.vec4), v_log_scales: wp.array(dtype=m.vec3),
        v_logit_opacities: wp.array(dtype=real), v_coefficients: wp.array2d(dtype=m.vec3),
        v_viewmats: wp.array2d(dtype=m.mat44), v_Ks: wp.array2d(dtype=m.mat33),
    ):  # fmt: skip
        n = begin + wp.tid()
        count = means.shape[0]
        if wp.static(native):
            seen = int(0)
            if n < count:
                for camera in range(viewmats.shape[0]):
                    seen += tile_counts[camera * count + n]
            n = compact(n, seen)
            if n < 0:
                return
        v_mean = vec3()
        v_quat = vec4()
        v_log_scale = vec3()
        v_logit = real(0.0)
        for camera in range(viewmats.shape[0]):
            i = camera * count + n
            if tile_counts[i] > 0:
                view = viewmats[camera]
                K = Ks[camera]
                e = m.ellipse(means[n], quats[n], log_scales[n], view, K, real(width), real(height), near, low_pass)
                x = e.position[0]
                y = e.position[1]
                z = e.position[2]
                rotation = mat33(
                    view[0, 0], view[0, 1], view[0, 2],
                    view[1, 0], view[1, 1], view[1, 2],
                    view[2, 0], view[2, 1], view[2, 2],
                )  # fmt: skip

                # factor -> projected axes (section 4); v_u and u are both per shrunk pixel
                inv_c = real(1.0) / wp.sqrt(e.c)
                inv_det = real(1.0) / wp.sqrt(e.det)
                t11 = v_splats[i, 2] * e.shrink * (e.c * inv_c * inv_det)
                t12 = v_splats[i, 3] * e.shrink * (-e.b * inv_c * inv_det)
                t22 = v_splats[i, 4] * e.shrink * inv_c
                v_det = real(-0.5) * (t11 + t12) / e.det
                v_c = real(0.5) * (t11 - t12 - t22) / e.c
                v_b = -v_splats[i, 3] * e.shrink * inv_c * inv_det
                blur = low_pass * e.shrink * e.shrink
                normal = wp.cross(e.m1, e.m2)
                two = real(2.0)
                v_m1 = two * v_det * (wp.cross(e.m2, normal) + blur * e.m1) + v_b * e.m2
                v_m2 = two * v_det * (wp.cross(normal, e.m1) + blur * e.m2) + v_b * e.m1 + two * v_c * e.m2
                v_m1 = v_m1 * e.shrink
                v_m2 = v_m2 * e.shrink

                # projected axes -> camera axes and Jacobian (section 3)
                fx = K[0, 0]
                fy = K[1, 1]
                inv_z = real(1.0) / z
                jx = fx * inv_z
                jy = fy * inv_z
                jxz = (K[0, 2] - e.clamped[0]) * inv_z
                jyz = (K[1, 2] - e.clamped[1]) * inv_z
                axes0 = vec3(e.axes[0, 0], e.axes[0, 1], e.axes[0, 2])
                axes1 = vec3(e.axes[1, 0], e.axes[1, 1], e.axes[1, 2])
                axes2 = vec3(e.axes[2, 0], e.axes[2, 1], e.axes[2, 2])
                v_jx = wp.dot(v_m1, axes0)
                v_jxz = wp.dot(v_m1, axes2)
                v_jy = wp.dot(v_m2, axes1)
                v_jyz = wp.dot(v_m2, axes2)
                g0 = jx * v_m1
                g1 = jy * v_m2
                g2 = jxz * v_m1 + jyz * v_m2
                v_axes = mat33(g0[0], g0[1], g0[2], g1[0], g1[1], g1[2], g2[0], g2[1], g2[2])
                v_log_scale += wp.cw_mul(g0, axes0) + wp.cw_mul(g1, axes1) + wp.cw_mul(g2, axes2)
                v_turned = v_axes * wp.diag(e.scales)  # gradient of camera rotation times Gaussian rotation
                v_unit = m.rotation_backward(e.quat, wp.transpose(rotation) * v_turned)
                v_quat += (v_unit - e.quat * wp.dot(e.quat, v_unit)) / e.quat_length

                # mean in the image, Jacobian and depth -> position in the camera (section 3)
                v_px = v_splats[i, 0]
                v_py = v_splats[i, 1]
                v_K = mat33()
                v_x = v_px * jx
                v_y = v_py * jy
                v_z = (
                    -(v_px * jx * x + v_py * jy * y + v_jx * jx + v_jy * jy + v_jxz * jxz + v_jyz * jyz) * inv_z
                    + v_splats[i, 9]
                )
                v_K[0, 0] = (v_px * x + v_jx) * inv_z
                v_K[1, 1] = (v_py * y + v_jy) * inv_z
                v_K[0, 2] = v_px
                v_K[1, 2] = v_py
                if e.clamped[0] == e.pixel[0]:  # the Jacobian moves with the mean: cx - px = -fx x / z
                    v_x -= v_jxz * jx * inv_z
                    v_z += v_jxz * jx * x * inv_z * inv_z
                    v_K[0, 0] = v_K[0, 0] - v_jxz * x * inv_z * inv_z
                else:
                    v_K[0, 2] = v_K[0, 2] + v_jxz * inv_z
                if e.clamped[1] == e.pixel[1]:
                    v_y -= v_jyz * jy * inv_z
                    v_z += v_jyz * jy * y * inv_z * inv_z
                    v_K[1, 1] = v_K[1, 1] - v_jyz * y * inv_z * inv_z
                else:
                    v_K[1, 2] = v_K[1, 2] + v_jyz * inv_z
                v_position = vec3(v_x, v_y, v_z)
                v_mean += wp.transpose(rotation) * v_position

                # colour -> coefficients and direction (section 5)
                d = m.direction(means[n], view)
                unit = vec3(d[0], d[1], d[2])
                basis = functions.basis(unit)
                v_color = vec3(v_splats[i, 6], v_splats[i, 7], v_splats[i, 8])
                for channel in range(3):
                    if not (splats[i, 6 + channel] > real(0.0)):  # clamped at zero
                        v_color[channel] = real(0.0)
                w = vec16()
                if wp.static(native):
                    for k in range(16):
                        if k >= sh_count:
                            basis[k] = real(0.0)
                    w = color_backward(coefficients, n, sh_count, basis, v_color, camera, v_coefficients)
                else:
                    for k in range(16):
                        if k < sh_count:
                            v_coefficients[n, k] = v_coefficients[n, k] + basis[k] * v_color
                            w[k] = wp.dot(coefficients[n, k], v_color)
                v_centered = vec3()
                if d[3] > real(0.0):
                    v_unit_direction = functions.basis_backward(unit, w)
                    v_centered = (v_unit_direction - unit * wp.dot(unit, v_unit_direction)) / d[3]
                v_mean += v_centered

                # opacity
                opacity = splats[i, 5]
                v_logit += v_splats[i, 5] * opacity * m.sigmoid(-logit_opacities[n])

                if camera_gradients != 0:
                    t = vec3(view[0, 3], view[1, 3], view[2, 3])
                    v_rotation = (
                        wp.outer(v_position, means[n]) + wp.outer(t, v_centered)
                        + v_turned * wp.transpose(m.rotation(e.quat))
                    )  # fmt: skip
                    v_t = v_position + rotation * v_centered
                    v_view = m.mat44()
                    for row in range(3):
                        for column in range(3):
                            v_view[row, column] = v_rotation[row, column]
                        v_view[row, 3] = v_t[row]
                    v_viewmats[camera, n] = v_view
                    v_Ks[camera, n] = v_K
        v_means[n] = v_mean
        v_quats[n] = v_quat
        v_log_scales[n] = v_log_scale
        v_logit_opacities[n] = v_logit

    return backward


def _inputs(means, quats, log_scales, logit_opacities, coefficients, viewmats, Ks) -> list[wp.array]:
    m = make_projection(bridge.real_of(means))
    types = (m.vec3, m.vec4, m.vec3, bridge.real_of(means), m.vec3, m.mat44, m.mat33)
    tensors = (means, quats, log_scales, logit_opacities, coefficients, viewmats, Ks)
    return [bridge.view(t, dtype) for t, dtype in zip(tensors, types)]


def _native(tensor: torch.Tensor) -> bool:
    return tensor.is_cuda and tensor.dtype == torch.float32


class _Project(torch.autograd.Function):
    @staticmethod
    def forward(ctx, means, quats, log_scales, logit_opacities, coefficients, viewmats, Ks, size, sh_count, rule, tile):
        real = bridge.real_of(means)
        tensors = [t.contiguous() for t in (means, quats, log_scales, logit_opacities, coefficients, viewmats, Ks)]
        count = len(viewmats) * len(means)
        zeros = torch.zeros((RECORD + 1) * count, dtype=torch.int32, device=means.device)
        if real is wp.float32:  # one allocation for both
            splats, tile_counts = zeros[: RECORD * count].view(means.dtype).view(count, RECORD), zeros[RECORD * count :]
        else:
            splats, tile_counts = means.new_zeros(count, RECORD), zeros[:count]
        inputs = [
            *_inputs(*tensors), *size, tile, sh_count,
            rule.near, rule.low_pass, rule.alpha_cut, rule.square_sigma,
            bridge.view(splats, real), bridge.view(tile_counts, wp.int32),
        ]  # fmt: skip
        bridge.launch(make_forward(real, _native(means)), count, inputs, means.device, cost=5)
        ctx.save_for_backward(*tensors, splats, tile_counts)
        ctx.size, ctx.sh_count, ctx.rule = size, sh_count, rule
        ctx.mark_non_differentiable(tile_counts)
        return splats.view(len(viewmats), len(means), RECORD), tile_counts.view(len(viewmats), len(means))

    @staticmethod
    @once_differentiable
    def backward(ctx, v_splats, _):
        *tensors, splats, tile_counts = ctx.saved_tensors
        real = bridge.real_of(splats)
        m = make_projection(real)
        device = splats.device
        v_splats = v_splats.contiguous().view(-1, RECORD)
        # One allocation for the five, each from a multiple of 16 bytes on, as kernels that read four at a time want it.
        sizes = [-(-t.numel() // 4) * 4 for t in tensors[:5]]
        flat = splats.new_zeros(sum(sizes)).split(sizes)
        gradients = [part[: t.numel()].view(t.shape) for part, t in zip(flat, tensors)]
        cameras, count = len(tensors[5]), len(tensors[0])
        wants_camera = ctx.needs_input_grad[5] or ctx.needs_input_grad[6]
        rows = (cameras, count) if wants_camera else (0, 0)
        make = splats.new_zeros if wants_camera else splats.new_empty
        v_viewmats, v_Ks = make(*rows, 4, 4), make(*rows, 3, 3)
        outputs = [bridge.view(g, t) for g, t in zip(gradients, (m.vec3, m.vec4, m.vec3, real, m.vec3))]
        inputs = [
            *_inputs(*tensors), *ctx.size, ctx.sh_count, ctx.rule.near, ctx.rule.low_pass,
            bridge.view(splats, real), bridge.view(tile_counts, wp.int32), bridge.view(v_splats, real),
            int(wants_camera), *outputs, bridge.view(v_viewmats, m.mat44), bridge.view(v_Ks, m.mat33),
        ]  # fmt: skip
        native = _native(splats)
        threads = -(-count // BLOCK) * BLOCK if native else count
        bridge.launch(make_backward(real, native), threads, inputs, device, cost=10 * cameras, block_dim=BLOCK)
        camera_gradients = (v_viewmats.sum(1), v_Ks.sum(1)) if wants_camera else (None, None)
        return *gradients, *camera_gradients, None, None, None, None


def project(
    means: torch.Tensor,
    quats: torch.Tensor,
    log_scales: torch.Tensor,
    logit_opacities: torch.Tensor,
    sh_coefficients: torch.Tensor,
    viewmats: torch.Tensor,
    Ks: torch.Tensor,
    *,
    width: int,
    height: int,
    degree: int,
    rule: Rule,
    tile_size: int = 16,
) -> tuple[torch.Tensor, torch.Tensor]:
    """Project N Gaussians into C cameras (EWA, first order).

    Differentiable in every tensor. A Gaussian is culled, with an all-zero record and zero gradients, where its depth is
    below ``rule.near``, its opacity below the cut, its box outside the image, or anything it needs is not finite. The
    largest scale that renders is the one whose projected axes are finite in the scalar type: 3.4e38 px in float32.
    Derivation of the backward pass: docs/project.md.

    Args:
        means: World positions [u], shape [N, 3].
        quats: Rotations wxyz of any non-zero length, shape [N, 4].
        log_scales: Logarithm of the axis lengths [u], shape [N, 3].
        logit_opacities: Inverse sigmoid of the opacity, shape [N].
        sh_coefficients: Colour coefficients, shape [N, K, 3].
        viewmats: camera_from_world, shape [C, 4, 4].
        Ks: Intrinsics [px] with zero skew, shape [C, 3, 3].
        width: Image width [px].
        height: Image height [px].
        degree: Spherical-harmonics degree used, 0 to 3.
        rule: Cut-offs.
        tile_size: Side of a tile [px].

    Returns:
        ``splats`` [C, N, 12], records laid out as ``RECORD`` says, and ``tile_counts`` [C, N] int32, the number of tiles
        each touches (0 where culled; no gradient).

    Raises:
        TypeError: A scalar type is neither float32 nor float64, or they differ.
        ValueError: A shape or device disagrees; the message names argument, wanted and found.
    """
    sh_count = sh.coefficient_count(degree)
    sizes = bridge.check(
        means=(means, "N 3"), quats=(quats, "N 4"), log_scales=(log_scales, "N 3"),
        logit_opacities=(logit_opacities, "N"), sh=(sh_coefficients, "N K 3"),
        viewmats=(viewmats, "C 4 4"), Ks=(Ks, "C 3 3"),
    )  # fmt: skip
    if sizes["K"] < sh_count:
        raise ValueError(f"sh holds {sizes['K']} coefficients a channel, degree {degree} needs {sh_count}")
    if width < 1 or height < 1:
        raise ValueError(f"the image must be at least 1 x 1 px, not {width} x {height}")
    return _Project.apply(
        means, quats, log_scales, logit_opacities, sh_coefficients, viewmats, Ks, (width, height), sh_count, rule, tile_size
    )
