"""The settings of blending other than tensors, in the forms for callers and for kernels."""

import functools
from dataclasses import dataclass

import warp as wp

from warpgs.constants import Rule
from warpgs.kernels.tiles import grid


@functools.cache
def make_struct(real):
    """Make the struct that all blending kernels of one scalar type take."""

    @wp.struct
    class Blending:
        """Settings of a blending pass."""

        origin_x: wp.int32  # left of the window [px]
        origin_y: wp.int32  # top of the window [px]
        width: wp.int32  # of the window [px]
        height: wp.int32  # of the window [px]
        columns: wp.int32  # tiles in a row of the window
        tiles: wp.int32  # tiles of the window
        alpha_cut: real  # smallest alpha that is blended
        alpha_max: real  # largest alpha
        stop: real  # transmittance below which a pixel is finished
        inclusive: wp.int32  # 1 to blend the Gaussian that crosses the stop, 0 to drop it
        whole_tiles: wp.int32  # 1 where a Gaussian reaches all pixels of its tiles, 0 where its box bounds them

    return Blending


@dataclass(frozen=True)
class BlendSettings:
    """Window, cut-offs and order of sums."""

    origin: tuple[int, int]
    """Left and top of the window [px], at the corner of a tile."""
    width: int
    """Width of the window [px]."""
    height: int
    """Height of the window [px]."""
    rule: Rule
    """Cut-offs."""
    deterministic: bool = True
    """True to sum gradients in a fixed order on every device."""
    absgrad: bool = False
    """True to sum magnitudes of the mean's gradient over pixels, too; the gradient of the box holds these sums."""

    @functools.lru_cache(maxsize=256)  # noqa: B019 - to make it takes 20 us, and steps ask for the same ones again
    def struct(self, tile_size: int, real):
        """Return the struct for kernels of one scalar type and tiles of ``tile_size`` px; callers must not change it."""
        columns, rows = grid(self.width, self.height, tile_size)
        found = make_struct(real)()
        found.origin_x, found.origin_y = self.origin
        found.width, found.height = self.width, self.height
        found.columns, found.tiles = columns, columns * rows
        rule = self.rule
        found.alpha_cut, found.alpha_max, found.stop = rule.alpha_cut, rule.alpha_max, rule.transmittance_stop
        found.inclusive, found.whole_tiles = int(rule.inclusive_stop), int(rule.square_sigma > 0)
        return found
