"""Records of the backward blending kernel in plain Warp: what it knows of pixels, strips, a Gaussian, and its gradient."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.kernels.falloff import STRIP

COLORS = 3
"""Channels of a projected Gaussian as `project` makes it: a colour."""
VALUES = 10
"""Gradient values of an instance with a colour: those of a projected Gaussian but for its last two, which are the box."""
WIDTHS = (COLORS, 7, 11)
"""Numbers of channels that kernels are compiled for: with nine other values a projected Gaussian fills whole 16-byte loads."""


@functools.cache
def make_records(real, tile_size: int, channels: int, absgrad: bool):
    """Make the records, and the functions that read an entry of their vectors, for one scalar type, tile size and channels.

    A tile lies in columns as wide as a strip, one beside the other; entries of its pixels follow in that order. Vectors are
    one row longer than the tile: see `blend_cpu.make_forward`. Channels stand one after the other, in a gradient with the
    two magnitudes behind them where ``absgrad`` asks for these.
    """
    count = tile_size * (tile_size // STRIP)
    tile_reals = wp.types.vector(tile_size * (tile_size + 1), real)
    tile_ints = wp.types.vector(tile_size * (tile_size + 1), wp.int32)
    list_reals = wp.types.vector(count, real)
    list_ints = wp.types.vector(count, wp.int32)
    strip_reals = wp.types.vector(STRIP, real)
    tile_channels = wp.types.vector(channels * tile_size * (tile_size + 1), real)
    strip_channels = wp.types.vector((channels + 2 * absgrad) * STRIP, real)
    channel_reals = wp.types.vector(channels, real)

    @wp.struct
    class Pixels:
        """Values of each pixel of a tile."""

        t: tile_reals  # transmittance behind the current instance, then before it
        behind: tile_reals  # sum of w d over what lies behind, background included
        g: tile_channels  # upstream gradient of the channels
        v_z: tile_reals
        v_w: tile_reals
        end: tile_ints  # one past the last instance that was blended
        strip_end: list_ints  # the largest of those in a strip

    @wp.struct
    class Reach:
        """Values of a Gaussian at each strip, and the strips that it reaches."""

        dx: list_reals  # from the mean to the first pixel [px]
        dy: list_reals
        e22: list_reals  # square of e2
        start: list_reals  # e1 of the first pixel
        ramp: strip_reals  # what the other pixels add to it
        hits: list_ints  # 1 where the strip is reached
        order: list_ints  # the strips that are reached, one after the other

    @wp.struct
    class Shades:
        """Values of a Gaussian at each pixel of the strips that it reaches, in their order."""

        alpha: tile_reals
        inverse: tile_reals  # of 1 - alpha
        slope: tile_reals  # falloff where alpha follows it, else 0
        v: tile_reals  # gradient of the falloff
        w: tile_reals  # blending weight

    @wp.struct
    class Gradient:
        """Sums of one instance's gradient, by place in a strip."""

        e1: strip_reals
        y: strip_reals
        xx: strip_reals
        xy: strip_reals
        yy: strip_reals
        opacity: strip_reals
        color: strip_channels
        z: strip_reals

    @wp.struct
    class Projected:
        """A projected Gaussian."""

        x: real
        y: real
        u11: real
        u12: real
        u22: real
        opacity: real
        color: channel_reals
        z: real
        aside: real  # see `falloff.make_functions`
        limit: real

    @wp.func(inline=True)
    def at(entry: wp.ref[real]) -> real:
        """Return an entry of a vector of a record that is taken by reference; Warp would copy the vector otherwise."""
        return entry

    @wp.func(inline=True)
    def at_int(entry: wp.ref[wp.int32]) -> wp.int32:
        return entry

    return SimpleNamespace(
        Pixels=Pixels, Reach=Reach, Shades=Shades, Gradient=Gradient, Projected=Projected, at=at, at_int=at_int
    )  # fmt: skip
