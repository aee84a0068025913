"""Spherical harmonics up to degree 3: the basis that projection uses, and the basis as an op of its own."""

import functools
from types import SimpleNamespace

import torch
import warp as wp
from torch.autograd.function import once_differentiable

from warpgs.runtime import interop

MAX_DEGREE = 3

# Normalisations of the real basis: sqrt((2l+1)/(4 pi) (l-|m|)!/(l+|m|)!) times the factor of each polynomial below.
C0 = 0.28209479177387814  # 1/2 sqrt(1/pi)
C1 = 0.4886025119029199  # 1/2 sqrt(3/pi)
C2 = 1.0925484305920792  # 1/2 sqrt(15/pi)
C20 = 0.31539156525252005  # 1/4 sqrt(5/pi)
C22 = 0.5462742152960396  # 1/4 sqrt(15/pi)
C33 = 0.5900435899266435  # 1/4 sqrt(35/(2 pi))
C32 = 2.890611442640554  # 1/2 sqrt(105/pi)
C31 = 0.4570457994644658  # 1/4 sqrt(21/(2 pi))
C30 = 0.3731763325901154  # 1/4 sqrt(7/pi)
C322 = 1.445305721320277  # 1/4 sqrt(105/pi)


def coefficient_count(degree: int) -> int:
    """Number of coefficients per channel up to a degree; ValueError outside 0..3."""
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"spherical-harmonics degree must be 0 to {MAX_DEGREE}, not {degree}")
    return (degree + 1) ** 2


@functools.cache
def make_functions(real):
    """The basis and its gradient for one scalar type, with the signs of Kerbl et al. 2023."""
    vec3 = wp.types.vector(3, real)
    vec16 = wp.types.vector(16, real)

    @wp.func
    def basis(d: vec3) -> vec16:
        """The 16 basis values at a unit direction."""
        x = d[0]
        y = d[1]
        z = d[2]
        xx = x * x
        yy = y * y
        zz = z * z
        return vec16(
            real(C0),
            -real(C1) * y,
            real(C1) * z,
            -real(C1) * x,
            real(C2) * x * y,
            -real(C2) * y * z,
            real(C20) * (real(2.0) * zz - xx - yy),
            -real(C2) * x * z,
            real(C22) * (xx - yy),
            -real(C33) * y * (real(3.0) * xx - yy),
            real(C32) * x * y * z,
            -real(C31) * y * (real(4.0) * zz - xx - yy),
            real(C30) * z * (real(2.0) * zz - real(3.0) * xx - real(3.0) * yy),
            -real(C31) * x * (real(4.0) * zz - xx - yy),
            real(C322) * z * (xx - yy),
            -real(C33) * x * (xx - real(3.0) * yy),
        )

    @wp.func
    def basis_backward(d: vec3, w: vec16) -> vec3:
        """Gradient of sum(w * basis(d)) for a free vector d."""
        x = d[0]
        y = d[1]
        z = d[2]
        xx = x * x
        yy = y * y
        zz = z * z
        two = real(2.0)
        three = real(3.0)
        six = real(6.0)
        v_x = (
            -real(C1) * w[3] + real(C2) * (y * w[4] - z * w[7]) - real(C20) * two * x * w[6] + real(C22) * two * x * w[8]
            - real(C33) * (six * x * y * w[9] + three * (xx - yy) * w[15]) + real(C32) * y * z * w[10]
            + real(C31) * (two * x * y * w[11] - (real(4.0) * zz - three * xx - yy) * w[13])
            - real(C30) * six * x * z * w[12] + real(C322) * two * x * z * w[14]
        )  # fmt: skip
        v_y = (
            -real(C1) * w[1] + real(C2) * (x * w[4] - z * w[5]) - real(C20) * two * y * w[6] - real(C22) * two * y * w[8]
            - real(C33) * (three * (xx - yy) * w[9] - six * x * y * w[15]) + real(C32) * x * z * w[10]
            + real(C31) * (two * x * y * w[13] - (real(4.0) * zz - xx - three * yy) * w[11])
            - real(C30) * six * y * z * w[12] - real(C322) * two * y * z * w[14]
        )  # fmt: skip
        v_z = (
            real(C1) * w[2] - real(C2) * (y * w[5] + x * w[7]) + real(C20) * real(4.0) * z * w[6]
            + real(C32) * x * y * w[10] - real(C31) * real(8.0) * z * (y * w[11] + x * w[13])
            + real(C30) * (six * zz - three * xx - three * yy) * w[12] + real(C322) * (xx - yy) * w[14]
        )  # fmt: skip
        return vec3(v_x, v_y, v_z)

    return SimpleNamespace(basis=basis, basis_backward=basis_backward, vec3=vec3, vec16=vec16)


@functools.cache
def make_kernels(real):
    """Forward and backward of the op for one scalar type."""
    f = make_functions(real)
    vec3 = f.vec3
    vec16 = f.vec16

    @wp.kernel(enable_backward=False, module=f"warpgs.kernels.sh.{real.__name__}")
    def forward(
        begin: int, sh: wp.array2d(dtype=vec3), dirs: wp.array(dtype=vec3), count: int,
        # outputs
        colors: wp.array(dtype=vec3),
    ):  # fmt: skip
        n = begin + wp.tid()
        y = f.basis(dirs[n])
        color = vec3()
        for k in range(16):
            if k < count:
                color += y[k] * sh[n, k]
        colors[n] = color

    @wp.kernel(enable_backward=False, module=f"warpgs.kernels.sh.{real.__name__}")
    def backward(
        begin: int, sh: wp.array2d(dtype=vec3), dirs: wp.array(dtype=vec3), count: int, v_colors: wp.array(dtype=vec3),
        # outputs
        v_sh: wp.array2d(dtype=vec3), v_dirs: wp.array(dtype=vec3),
    ):  # fmt: skip
        n = begin + wp.tid()
        d = dirs[n]
        v = v_colors[n]
        y = f.basis(d)
        w = vec16()
        for k in range(16):
            if k < count:
                v_sh[n, k] = y[k] * v
                w[k] = wp.dot(sh[n, k], v)
        v_dirs[n] = f.basis_backward(d, w)

    return SimpleNamespace(forward=forward, backward=backward, vec3=vec3)


class _EvaluateSh(torch.autograd.Function):
    @staticmethod
    def forward(ctx, sh, dirs, count):
        k = make_kernels(interop.real_of(sh))
        sh, dirs = sh.contiguous(), dirs.contiguous()
        colors = torch.empty_like(dirs)
        with interop.stream_of(sh.device):
            inputs = [interop.view(sh, k.vec3), interop.view(dirs, k.vec3), count, interop.view(colors, k.vec3)]
            interop.launch(k.forward, len(dirs), inputs, sh.device, cost=2)
        ctx.save_for_backward(sh, dirs)
        ctx.count = count
        return colors

    @staticmethod
    @once_differentiable
    def backward(ctx, v_colors):
        sh, dirs = ctx.saved_tensors
        k = make_kernels(interop.real_of(sh))
        v_colors = v_colors.contiguous()
        v_sh, v_dirs = torch.zeros_like(sh), torch.empty_like(dirs)
        arrays = [interop.view(t, k.vec3) for t in (v_colors, v_sh, v_dirs)]
        with interop.stream_of(sh.device):
            inputs = [interop.view(sh, k.vec3), interop.view(dirs, k.vec3), ctx.count, *arrays]
            interop.launch(k.backward, len(dirs), inputs, sh.device, cost=4)
        return v_sh, v_dirs, None


def evaluate_sh(sh: torch.Tensor, dirs: torch.Tensor, degree: int) -> torch.Tensor:
    """Evaluate spherical harmonics, without the 0.5 that projection adds.

    Differentiable in ``sh`` and in ``dirs``, the latter as free vectors. Derivation: docs/sh.md.

    Args:
        sh: Coefficients, shape [N, K, 3] with K at least (degree + 1)^2.
        dirs: Unit directions from the camera to the Gaussian, shape [N, 3].
        degree: Highest degree evaluated, 0 to 3.

    Returns:
        Colours, shape [N, 3].

    Raises:
        TypeError: A scalar type is not float32 or float64, or the two differ.
        ValueError: A shape or device disagrees, or K is too small for the degree.
    """
    count = coefficient_count(degree)
    sizes = interop.check(sh=(sh, "N K 3"), dirs=(dirs, "N 3"))
    if sizes["K"] < count:
        raise ValueError(f"sh holds {sizes['K']} coefficients a channel, degree {degree} needs {count}")
    return _EvaluateSh.apply(sh, dirs, count)
