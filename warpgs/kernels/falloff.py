"""What the CPU's blending passes compute alike, to the bit: the rows a Gaussian reaches, and how it falls off."""

import functools
from types import SimpleNamespace

import warp as wp


@functools.cache
def make_falloff(real):
    """exp(-x / 2) for x >= 0. In float32 by a polynomial, because a call to the C library would not vectorise."""
    if real is wp.float64:

        @wp.func
        def falloff64(x: real) -> real:
            return wp.exp(real(-0.5) * x)

        return falloff64

    @wp.func
    def falloff32(x: real) -> real:
        # exp(-x / 2) = 2^n 2^f, |f| <= 1/2. Adding 1.5 * 2^23 rounds to an integer and leaves it in the low bits.
        # The bound keeps the result, times any opacity that can be seen, a normal number: others are slow.
        y = wp.max(x * real(-0.7213475204444817), real(-110.0))
        shifted = y + real(12582912.0)
        f = y - (shifted - real(12582912.0))
        # minimax polynomial of 2^f by relative error, 9.2e-8, with constant term 1
        p = real(1.3264726641879386e-3)
        p = p * f + real(9.671512958571476e-3)
        p = p * f + real(5.550733747694458e-2)
        p = p * f + real(2.4022242080135733e-1)
        p = p * f + real(6.931469775948987e-1)
        p = p * f + real(1.0)
        # 2^n by adding n to the exponent bits
        return wp.cast(wp.cast(p, wp.int32) + (wp.cast(shifted, wp.int32) << 23), wp.float32)

    return falloff32


@functools.cache
def make_functions(real, tile_size: int):
    """The functions for one scalar type and tile size."""
    vec2i = wp.types.vector(2, wp.int32)
    side = wp.constant(tile_size)

    @wp.func
    def rows_of(my: real, half_height: real, whole_tiles: wp.int32, top: wp.int32) -> vec2i:
        """Rows of the tile, counted from its top, whose pixel centres may lie in the Gaussian's box."""
        if whole_tiles != 0:
            return vec2i(0, side)
        margin = real(0.01) + real(2.0e-6) * (wp.abs(my) + half_height)
        center = my - real(top) - real(0.5)
        first = wp.ceil(wp.clamp(center - half_height - margin, real(0.0), real(side)))
        last = wp.floor(wp.clamp(center + half_height + margin, real(-1.0), real(side) - real(1.0)))
        return vec2i(int(first), int(last) + 1)

    @wp.func
    def apart(product: real) -> real:
        """The product itself, rounded: kept from being fused with the sum it goes into.

        Where a compiler moves it out of a loop it is rounded anyway, and then one pass would see another alpha than the other.
        """
        return wp.where(real(1.0e30) < product, real(1.0e30), product)

    return SimpleNamespace(falloff=make_falloff(real), rows_of=rows_of, apart=apart)
