"""Functions that all CPU blending passes share, so that their bits agree: tiles, a Gaussian's pixels and its falloff."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.kernels.blend_settings import make_struct

STRIP = 8
"""Pixels of a row that are processed together. With more, the sums of a strip would not fit the 16 registers of AVX2."""
ABREAST = 4
"""Falloffs that are computed side by side, since each is a chain of twenty operations that wait for one another."""


@functools.cache
def make_falloffs(real, count: int):
    """Make exp(-x / 2) for ``count`` numbers x >= 0: a polynomial in float32, since calls to the C library do not vectorise."""
    reals = wp.types.vector(count, real)

    if real is wp.float64:

        @wp.func
        def falloffs64(x: reals) -> reals:
            found = reals()
            for n in range(wp.static(count)):
                found[n] = wp.exp(real(-0.5) * x[n])
            return found

        return falloffs64

    @wp.func
    def falloffs32(x: reals) -> reals:
        # exp(-x / 2) = 2^n 2^f, |f| <= 1/2. Adding 1.5 * 2^23 rounds to an integer and leaves it in the low bits.
        # The bound keeps the result, times any opacity that can be seen, a normal number: others are slow.
        y = wp.max(x * real(-0.7213475204444817), reals(real(-110.0)))
        shifted = y + reals(real(12582912.0))
        f = y - (shifted - reals(real(12582912.0)))
        # minimax polynomial of 2^f by relative error, 9.2e-8, with constant term 1
        p = reals(real(1.3264726641879386e-3))
        p = wp.cw_mul(p, f) + reals(real(9.671512958571476e-3))
        p = wp.cw_mul(p, f) + reals(real(5.550733747694458e-2))
        p = wp.cw_mul(p, f) + reals(real(2.4022242080135733e-1))
        p = wp.cw_mul(p, f) + reals(real(6.931469775948987e-1))
        p = wp.cw_mul(p, f) + reals(real(1.0))
        # 2^n by adding n to the exponent bits
        for n in range(wp.static(count)):
            p[n] = wp.cast(wp.cast(p[n], wp.int32) + (wp.cast(shifted[n], wp.int32) << 23), wp.float32)
        return p

    return falloffs32


@functools.cache
def make_falloff(real):
    """Make exp(-x / 2) of one number."""
    one = wp.types.vector(1, real)
    falloffs = make_falloffs(real, 1)

    @wp.func
    def falloff(x: real) -> real:
        return falloffs(one(x))[0]

    return falloff


@functools.cache
def make_functions(real):
    """Make the functions for one scalar type."""
    vec2 = wp.types.vector(2, real)
    half_strip = wp.constant(real((STRIP - 1) / 2))
    Blending = make_struct(real)

    @wp.func
    def place_of(tile: wp.int32, side: wp.int32, settings: Blending) -> wp.vec3i:
        """Return the number of a tile's image, and left and top of the tile in the window [px]."""
        image = tile // settings.tiles
        in_image = tile - image * settings.tiles
        row = in_image // settings.columns
        return wp.vec3i(image, (in_image - row * settings.columns) * side, row * side)

    @wp.func
    def apart(product: real) -> real:
        """Return the product, rounded, so that the compiler cannot fuse it with a sum.

        A product that the compiler moves out of a loop is rounded in any case. If others were fused, two passes could see
        different alphas.
        """
        return wp.where(real(1.0e30) < product, real(1.0e30), product)

    @wp.func
    def bounds_of(mx: real, my: real, u11: real, u22: real, half_width: real, half_height: real, whole_tiles: wp.int32) -> vec2:
        """Return how much larger |e1| at the middle of a strip may be than its least there, and the ellipse's |U d|^2."""
        margin = real(0.01) + real(2.0e-6) * (wp.abs(mx) + half_width)
        slack = real(0.01) + real(2.0e-6) * (wp.abs(my) + half_height)
        radius = u22 * (half_height + slack)
        return vec2(wp.abs(u11) * (half_strip + margin), wp.where(whole_tiles != 0, real(wp.inf), radius * radius))

    @wp.func
    def reaches(start: real, u11: real, e22: real, aside: real, limit: real) -> bool:
        """Return whether the ellipse touches a strip whose first pixel has ``start`` for e1 (its least |U d|^2 is inside)."""
        least = wp.max(wp.abs(start + u11 * half_strip) - aside, real(0.0))
        return least * least + e22 <= limit

    return SimpleNamespace(
        Blending=Blending, place_of=place_of, apart=apart, bounds_of=bounds_of, reaches=reaches,
        falloff=make_falloff(real), falloffs=make_falloffs(real, ABREAST), abreast=wp.types.vector(ABREAST, real),
    )  # fmt: skip
