"""What the blending kernels share: settings, the falloff of a Gaussian, batches and records."""

import functools
import math
from dataclasses import dataclass

import warp as wp
from warp.types import vector

from warpgs.constants import TILE_SIZE, Rule
from warpgs.kernels import sh
from warpgs.kernels.cameras import named
from warpgs.kernels.native import Ints
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
class Pass:
    """Everything besides tensors that a pass of the rasterizer depends on: projection, binning and blending."""

    size: tuple[int, int]
    """Width and height of the whole image [px]."""
    window: tuple[int, int, int, int]
    """Left, top, width and height [px] of the part that is rendered; left and top are multiples of ``tile_size``."""
    rule: Rule
    """Cut-offs."""
    sh_count: int = 1
    """Number of spherical-harmonics coefficients per channel that are used."""
    tile_size: int = TILE_SIZE
    """Side of a tile [px]."""
    camera_model: str = "pinhole"
    """Name of the camera model."""
    parameters: str = "stored"
    """Parameters in `ProjectInputs`: ``stored`` log scales and logits, ``activated`` scales and opacities, or ``covariances``
    (as `packed_covariances` returns them) and opacities."""
    antialiased: bool = False
    """True to multiply each opacity by sqrt(det(cov2d) / det(cov2d + low_pass I)) (docs/project.md)."""
    deterministic: bool = True
    """True to sum gradients in a fixed order on every device."""
    absgrad: bool = False
    """True to sum magnitudes of the mean's gradient over pixels, too; the gradient of the box holds these sums."""
    max_error: float = 0.0
    """Largest error of a colour against the same pass with 0, in images without gradients; 0 for none."""

    def variant(self) -> tuple[str, str, bool, int]:
        """Return the settings that are compiled into the kernels of the projection."""
        return self.camera_model, self.parameters, self.antialiased, sh.bases_for(self.sh_count)

    @functools.lru_cache(maxsize=256)  # noqa: B019 - to make it takes 20 us, and steps ask for the same ones again
    def struct(self, tile_size: int, real):
        """Return the struct for blending kernels of one scalar type, and tiles of ``tile_size`` px; not to be changed."""
        found = make_struct(real)()
        found.origin_x, found.origin_y, found.width, found.height = self.window
        columns, rows = grid(*self.window[2:], tile_size)
        found.columns, found.tiles = columns, columns * rows
        rule = self.rule
        found.alpha_cut, found.alpha_max, found.stop = rule.alpha_cut, rule.alpha_max, rule.transmittance_stop
        found.inclusive, found.whole_tiles = int(rule.inclusive_stop), int(rule.square_sigma > 0)
        return found

    def rounding(self) -> float:
        """Return the largest error of a colour by rounding with ``max_error``, as a fraction of the largest colour behind."""
        # of a half; of two sums over all layers in front of the stop, and at their ends; of weights (docs/numerics.md)
        layers = 16 - math.log(self.rule.transmittance_stop) / self.rule.alpha_cut
        return 2.0**-11 + (2 * layers + 4 / self.rule.alpha_cut) * 2.0**-24


LARGEST_STOP = 0.5
"""Largest transmittance at which a pixel is finished because of `Pass.max_error`."""

STRIP = 8
"""Pixels of a row that are processed together. With more, the sums of a strip would not fit the 16 registers of AVX2."""
ABREAST = 4
"""Falloffs that are computed side by side, since each is a chain of twenty operations that wait for one another."""


@functools.cache
def make_falloffs(real, count: int):
    """Make exp(-x / 2) for ``count`` numbers x >= 0: a polynomial in float32, since calls to the C library do not vectorise."""
    reals = vector(count, real)

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
    one = vector(1, real)
    falloffs = make_falloffs(real, 1)

    @wp.func
    def falloff(x: real) -> real:
        return falloffs(one(x))[0]

    return falloff


@functools.cache
def make_functions(real):
    """Make the functions for one scalar type."""
    vec2 = vector(2, real)
    half_strip = wp.constant(real((STRIP - 1) / 2))
    Blending = make_struct(real)

    @wp.func
    def place_of(tile: wp.int32, side: wp.int32, settings: Blending):
        """Return the number of a tile's image, and left and top of the tile in the window [px]."""
        image = tile // settings.tiles
        in_image = tile - image * settings.tiles
        row = in_image // settings.columns
        return image, (in_image - row * settings.columns) * side, row * side

    @wp.func
    def apart(product: real) -> real:
        """Return the product, rounded, so that the compiler cannot fuse it with a sum.

        A product that the compiler moves out of a loop is rounded in any case. If others were fused, two passes could see
        different alphas.
        """
        return wp.where(real(1.0e30) < product, real(1.0e30), product)

    @wp.func(inline=True)
    def never(index: wp.int32) -> bool:
        """Return False, for an index that is never negative: a loop that may end early is not vectorised."""
        # Vectorised, loads at such indices would be slow gathers, and stores slow scatters.
        return index < 0

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

    of_several = {"falloff": make_falloff(real), "falloffs": make_falloffs(real, ABREAST), "abreast": vector(ABREAST, real)}
    return named(Blending, place_of, apart, never, bounds_of, reaches, **of_several)


BATCH = 64
"""Gaussians that are copied together, so that many loads overlap."""
TOGETHER = 16
"""Gaussians of a batch that are tested together, in a loop that vectorises; divides `BATCH`."""


@functools.cache
def make_batches(real, tile_size: int, channels: int):
    """Make the record of a batch and its functions, for one scalar type, tile size and number of channels."""
    # A tile is stored in columns as wide as a strip, one after the other. The strips of a column that a Gaussian reaches are
    # contiguous, since an ellipse is convex. So only the first of their rows and one past the last are stored.
    f = make_functions(real)
    sizes = 9 + channels, BATCH, tile_size, STRIP, TOGETHER, (tile_size + ABREAST) * STRIP
    record, batch_reals, row_reals, strip_reals, lane_reals, column_reals = (vector(n, real) for n in sizes)
    batch_rows, strip_ints = (vector((tile_size // STRIP) * n, wp.int32) for n in (BATCH, tile_size))
    side, parts, abreast, place_z = map(wp.constant, (tile_size, tile_size // STRIP, ABREAST, 6 + channels))
    bits, row_bits = wp.constant(BATCH - 1), wp.constant(tile_size - 1)

    @wp.struct
    class Batch:
        """Values of the Gaussians of a batch."""

        x: batch_reals
        y: batch_reals
        u11: batch_reals
        u12: batch_reals
        u22: batch_reals
        opacity: batch_reals
        color: vector(channels * BATCH, real)
        z: batch_reals
        aside: batch_reals  # see `falloff.make_functions`
        limit: batch_reals
        begin: batch_rows  # first row that is reached in each column of strips
        end: batch_rows  # and one past the last

    @wp.struct
    class Rows:
        """Values of a Gaussian on each row of a tile."""

        dy: row_reals  # from the mean [px]
        e12: row_reals  # u12 dy
        e22: row_reals  # square of e2
        ramp: strip_reals  # e1 of the pixels of a strip, less that of the first pixel

    @wp.func(inline=True)
    def at(entry: wp.ref[real]) -> real:
        """Return an entry of a vector of a record that is taken by reference; Warp would copy the vector otherwise."""
        return entry

    @wp.func(inline=True)
    def at_int(entry: wp.ref[wp.int32]) -> wp.int32:
        return entry

    @wp.func(inline=True)
    def load_channels(projected: wp.array(dtype=record), i: wp.int32, j: wp.int32, b: wp.ref[Batch]):
        """Load the channels of a Gaussian."""
        for c in range(wp.static(channels)):
            b.color[c * BATCH + j] = projected[i][6 + c]

    @wp.func(inline=True)
    def load(
        projected: wp.array(dtype=record), gaussian_ids: Ints, first: wp.int32, way: wp.int32, count: wp.int32,
        whole_tiles: wp.int32, b: wp.ref[Batch],
    ):  # fmt: skip
        """Load the Gaussians of ``count`` instances from the first on, forwards or backwards (``way`` 1 or -1)."""
        j = int(0)
        while j < count:
            i = gaussian_ids[wp.max(first + way * j, 0)]
            if f.never(i):
                break
            b.x[j & bits] = projected[i][0]
            b.y[j & bits] = projected[i][1]
            b.u11[j & bits] = projected[i][2]
            b.u12[j & bits] = projected[i][3]
            b.u22[j & bits] = projected[i][4]
            b.opacity[j & bits] = projected[i][5]
            load_channels(projected, i, j & bits, b)
            b.z[j & bits] = projected[i][place_z]
            bounds = f.bounds_of(
                at(b.x[j & bits]), projected[i][1], projected[i][2], projected[i][4],
                projected[i][place_z + 1], projected[i][place_z + 2], whole_tiles,
            )  # fmt: skip
            b.aside[j & bits] = bounds[0]
            b.limit[j & bits] = bounds[1]
            j += 1

    @wp.func(inline=True)
    def find_rows(left: wp.int32, top: wp.int32, last: wp.int32, count: wp.int32, until: wp.ref[strip_ints], b: wp.ref[Batch]):
        """Find the rows that the Gaussians reach; an instance skips strips whose ``until`` is not above its number."""
        e12 = lane_reals()
        e22 = lane_reals()
        group = int(0)
        while group < count:
            j = group & bits
            group += TOGETHER
            for part in range(parts):
                for lane in range(TOGETHER):
                    b.begin[part * BATCH + j + lane] = side
                    b.end[part * BATCH + j + lane] = 0
            for row in range(side):
                y = real(top + row) + real(0.5)
                for lane in range(TOGETHER):
                    dy = y - at(b.y[j + lane])
                    e2 = at(b.u22[j + lane]) * dy
                    e12[lane] = f.apart(at(b.u12[j + lane]) * dy)
                    e22[lane] = f.apart(e2 * e2)
                for part in range(parts):
                    x = real(left + part * STRIP) + real(0.5)
                    strip_end = at_int(until[part * side + row])
                    for lane in range(TOGETHER):
                        u11 = at(b.u11[j + lane])
                        start = f.apart(u11 * (x - at(b.x[j + lane]))) + e12[lane]
                        seen = last - (j + lane) < strip_end
                        hit = f.reaches(start, u11, e22[lane], at(b.aside[j + lane]), at(b.limit[j + lane])) and seen
                        o = part * BATCH + j + lane
                        b.begin[o] = wp.min(at_int(b.begin[o]), wp.where(hit, row, side))
                        b.end[o] = wp.max(at_int(b.end[o]), wp.where(hit, row + 1, 0))

    @wp.func(inline=True)
    def find_row_values(y: real, u11: real, u12: real, u22: real, top: wp.int32, rows: wp.ref[Rows]):
        """Compute the values of a Gaussian on all rows."""
        for row in range(side):
            dy = real(top + row) + real(0.5) - y
            e2 = u22 * dy
            rows.dy[row] = dy
            rows.e12[row] = f.apart(u12 * dy)
            rows.e22[row] = f.apart(e2 * e2)
        for lane in range(STRIP):
            rows.ramp[lane] = f.apart(u11 * real(lane))

    @wp.func(inline=True)
    def find_falloffs(at_left: real, first: wp.int32, end: wp.int32, rows: wp.ref[Rows], falloffs: wp.ref[column_reals]):
        """Compute the falloffs on the strips of a column, from row ``first`` on; ``at_left`` is e1 at the left, less e12."""
        # in a loop of their own, several strips at a time, since each is a long chain of dependent operations
        e1 = f.abreast()
        squares = f.abreast()
        k = int(0)
        while k < end - first:
            for lane in range(STRIP):
                for n in range(abreast):
                    e1[n] = at_left + at(rows.e12[(first + k + n) & row_bits]) + at(rows.ramp[lane])
                    squares[n] = at(rows.e22[(first + k + n) & row_bits])
                found = f.falloffs(wp.cw_mul(e1, e1) + squares)
                for n in range(abreast):
                    falloffs[(k + n) * STRIP + lane] = found[n]
            k += abreast  # the last few may lie beyond the end; their values are not read

    types = {"record": record, "strip_ints": strip_ints, "column_reals": column_reals}
    return named(Batch, Rows, at, at_int, load, find_rows, find_row_values, find_falloffs, **types)


COLORS = 3
"""Number of channels of a projected Gaussian as `project` makes it: a colour."""
VALUES = 10
"""Number of gradient values of an instance with a colour: all values of a projected Gaussian but the last two, its box."""
WIDTHS = (COLORS, 7, 11)
"""Numbers of channels for which kernels are compiled: with nine other values a projected Gaussian fills whole 16-byte loads."""
