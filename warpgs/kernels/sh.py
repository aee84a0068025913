"""Spherical harmonics up to degree 4: constants, the basis, and its gradient (docs/sh.md)."""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.scene import C0

MAX_DEGREE = 4
"""Highest degree of the basis."""

# Normalisations of the real basis: sqrt((2l+1)/(4 pi) (l-|m|)!/(l+|m|)!) times the factor of each polynomial below.
C1 = 0.4886025119029199  # 1/2 sqrt(3/pi)
C2 = 1.0925484305920792  # 1/2 sqrt(15/pi)
C20 = 0.31539156525252005  # 1/4 sqrt(5/pi)
C22 = 0.5462742152960396  # 1/4 sqrt(15/pi)
C33 = 0.5900435899266435  # 1/4 sqrt(35/(2 pi))
C32 = 2.890611442640554  # 1/2 sqrt(105/pi)
C31 = 0.4570457994644658  # 1/4 sqrt(21/(2 pi))
C30 = 0.3731763325901154  # 1/4 sqrt(7/pi)
C322 = 1.445305721320277  # 1/4 sqrt(105/pi)
C44 = 2.5033429417967046  # 3/4 sqrt(35/pi)
C43 = 1.7701307697799304  # 3/4 sqrt(35/(2 pi))
C42 = 0.9461746957575601  # 3/4 sqrt(5/pi)
C41 = 0.6690465435572892  # 3/4 sqrt(5/(2 pi))
C40 = 0.10578554691520431  # 3/16 sqrt(1/pi)
C422 = 0.47308734787878004  # 3/8 sqrt(5/pi)
C444 = 0.6258357354491761  # 3/16 sqrt(35/pi)

BASES = 16
"""Number of basis values that kernels hold for degrees 0 to 3; see `bases_for` for degree 4."""


def coefficient_count(degree: int) -> int:
    """Return the number of coefficients per channel up to a degree; ValueError unless it is 0 to 4."""
    if not 0 <= degree <= MAX_DEGREE:
        raise ValueError(f"spherical-harmonics degree must be 0 to {MAX_DEGREE}, not {degree}")
    return (degree + 1) ** 2


def bases_for(count: int) -> int:
    """Return the number of basis values that the kernels for ``count`` coefficients a channel hold: 16, or 25 for degree 4."""
    return BASES if count <= BASES else (MAX_DEGREE + 1) ** 2


def basis(directions: torch.Tensor) -> torch.Tensor:
    """Return the 25 basis values [N, 25] at unit directions [N, 3], for reference results; kernels use `make_functions`."""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    values = [
        C0 * torch.ones_like(x), -C1 * y, C1 * z, -C1 * x,
        C2 * x * y, -C2 * y * z, C20 * (2 * zz - xx - yy), -C2 * x * z, C22 * (xx - yy),
        -C33 * y * (3 * xx - yy), C32 * x * y * z, -C31 * y * (4 * zz - xx - yy),
        C30 * z * (2 * zz - 3 * xx - 3 * yy), -C31 * x * (4 * zz - xx - yy), C322 * z * (xx - yy),
        -C33 * x * (xx - 3 * yy),
        C44 * x * y * (xx - yy), -C43 * y * z * (3 * xx - yy), C42 * x * y * (6 * zz - xx - yy),
        -C41 * y * z * (4 * zz - 3 * xx - 3 * yy), C40 * (8 * zz * zz - 24 * zz * (xx + yy) + 3 * (xx + yy) ** 2),
        -C41 * x * z * (4 * zz - 3 * xx - 3 * yy), C422 * (xx - yy) * (6 * zz - xx - yy), -C43 * x * z * (xx - 3 * yy),
        C444 * (xx * xx - 6 * xx * yy + yy * yy),
    ]  # fmt: skip
    return torch.stack(values, -1)


@functools.cache
def make_functions(real, bases: int = BASES):
    """Make the basis and its gradient for one scalar type and a number of basis values, with the signs of Kerbl et al. 2023."""
    vec3, vec16, values = (wp.types.vector(size, real) for size in (3, 16, bases))

    @wp.func
    def up_to_3(d: vec3) -> vec16:
        """Return the 16 basis values of degrees 0 to 3 at a unit direction."""
        x, y, z = d[0], d[1], d[2]
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
    def up_to_4(d: vec3) -> values:
        """Return the 25 basis values at a unit direction."""
        x, y, z = d[0], d[1], d[2]
        xx = x * x
        yy = y * y
        zz = z * z
        three = real(3.0)
        lower = up_to_3(d)
        v = values()
        for k in range(16):
            v[k] = lower[k]
        v[16] = real(C44) * x * y * (xx - yy)
        v[17] = -real(C43) * y * z * (three * xx - yy)
        v[18] = real(C42) * x * y * (real(6.0) * zz - xx - yy)
        v[19] = -real(C41) * y * z * (real(4.0) * zz - three * (xx + yy))
        v[20] = real(C40) * (real(8.0) * zz * zz - real(24.0) * zz * (xx + yy) + three * (xx + yy) * (xx + yy))
        v[21] = -real(C41) * x * z * (real(4.0) * zz - three * (xx + yy))
        v[22] = real(C422) * (xx - yy) * (real(6.0) * zz - xx - yy)
        v[23] = -real(C43) * x * z * (xx - three * yy)
        v[24] = real(C444) * (xx * xx - real(6.0) * xx * yy + yy * yy)
        return v

    @wp.func
    def basis_backward(d: vec3, w: values) -> vec3:
        """Return the gradient of sum(w * basis(d)) by d, not constrained to unit length."""
        x, y, z = d[0], d[1], d[2]
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
        if wp.static(bases > BASES):
            four = real(4.0)
            nine = real(9.0)
            twelve = real(12.0)
            v_x += (
                real(C44) * y * (three * xx - yy) * w[16] - real(C43) * z * (six * x * y * w[17] + three * (xx - yy) * w[23])
                + real(C42) * y * (six * zz - three * xx - yy) * w[18]
                + real(C41) * z * (six * x * y * w[19] - (four * zz - nine * xx - three * yy) * w[21])
                + real(C40) * twelve * x * (xx + yy - four * zz) * w[20] + real(C422) * four * x * (three * zz - xx) * w[22]
                + real(C444) * four * x * (xx - three * yy) * w[24]
            )  # fmt: skip
            v_y += (
                real(C44) * x * (xx - three * yy) * w[16] - real(C43) * z * (three * (xx - yy) * w[17] - six * x * y * w[23])
                + real(C42) * x * (six * zz - xx - three * yy) * w[18]
                + real(C41) * z * (six * x * y * w[21] - (four * zz - three * xx - nine * yy) * w[19])
                + real(C40) * twelve * y * (xx + yy - four * zz) * w[20] - real(C422) * four * y * (three * zz - yy) * w[22]
                + real(C444) * four * y * (yy - three * xx) * w[24]
            )  # fmt: skip
            v_z += (
                -real(C43) * (y * (three * xx - yy) * w[17] + x * (xx - three * yy) * w[23])
                + real(C42) * twelve * x * y * z * w[18]
                - real(C41) * (twelve * zz - three * (xx + yy)) * (y * w[19] + x * w[21])
                + real(C40) * real(16.0) * z * (real(2.0) * zz - three * (xx + yy)) * w[20]
                + real(C422) * twelve * z * (xx - yy) * w[22]
            )  # fmt: skip
        return vec3(v_x, v_y, v_z)

    basis = up_to_3 if bases == BASES else up_to_4
    return SimpleNamespace(basis=basis, basis_backward=basis_backward, vec3=vec3, values=values)
