"""Records of the backward blending kernel in plain Warp: the values of pixels, and the gradient of a Gaussian."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.kernels.blend_batch import TOGETHER
from warpgs.kernels.falloff import ABREAST, STRIP

COLORS = 3
"""Number of channels of a projected Gaussian as `project` makes it: a colour."""
VALUES = 10
"""Number of gradient values of an instance with a colour: all values of a projected Gaussian but the last two, its box."""
WIDTHS = (COLORS, 7, 11)
"""Numbers of channels for which kernels are compiled: with nine other values a projected Gaussian fills whole 16-byte loads."""


@functools.cache
def make_records(real, tile_size: int, channels: int, absgrad: bool):
    """Make the records for one scalar type, tile size and number of channels.

    A tile is stored in columns as wide as a strip, one after the other; entries of its pixels follow in that order. Vectors
    are one row longer than the tile: see `blend_cpu.make_forward`. Channels are stored one after the other. In a gradient, the
    two magnitudes follow the channels if ``absgrad`` is set.
    """
    # The compiler puts records 8 bytes before a cache line; with this vector in front, no strip lies in two lines.
    lead_reals = wp.types.vector(2, real)
    trail_reals = wp.types.vector(14, real)
    tile_reals = wp.types.vector(tile_size * (tile_size + 1), real)
    tile_ints = wp.types.vector(tile_size * (tile_size + 1), wp.int32)
    column_reals = wp.types.vector((tile_size + ABREAST) * STRIP, real)
    strip_reals = wp.types.vector(STRIP, real)
    tile_channels = wp.types.vector(channels * tile_size * (tile_size + 1), real)
    strip_channels = wp.types.vector((channels + 2 * absgrad) * STRIP, real)

    count = VALUES + channels - COLORS + 2 * absgrad
    half_reals = wp.types.vector(TOGETHER * count * (STRIP // 2), real)
    total_reals = wp.types.vector(TOGETHER * count, real)

    @wp.struct
    class Pixels:
        """Values of each pixel of a tile."""

        lead: lead_reals
        t: tile_reals  # transmittance behind the current instance, then before it
        behind: tile_reals  # sum of w d over what lies behind, background included
        g: tile_channels  # upstream gradient of the channels
        v_z: tile_reals
        v_w: tile_reals
        end: tile_ints  # one past the last instance that was blended
        trail: trail_reals

    @wp.struct
    class Shades:
        """Gradient and weight of the current instance at each pixel that it reaches."""

        lead: lead_reals
        falloff: column_reals  # of one column of strips, and of a few rows beyond it
        v: tile_reals  # gradient of the falloff
        w: tile_reals  # blending weight
        trail: trail_reals

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
    class Held:
        """Sums of several instances' gradients, one instance after the other."""

        halves: half_reals  # by place in half a strip
        totals: total_reals

    return SimpleNamespace(Held=Held, Pixels=Pixels, Shades=Shades, Gradient=Gradient)
