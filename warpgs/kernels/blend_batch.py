"""Batches of Gaussians in the CPU's backward blending: their values, and the rows of a tile that each Gaussian reaches."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.kernels.falloff import STRIP, make_functions

BATCH = 64
"""Gaussians that are copied together, so that many loads overlap."""
TOGETHER = 16
"""Gaussians of a batch that are tested together, in a loop that vectorises; divides `BATCH`."""


@functools.cache
def make_batches(real, tile_size: int, channels: int):
    """Make the record of a batch and its functions, for one scalar type, tile size and number of channels.

    A tile is stored in columns as wide as a strip (`STRIP` pixels), one after the other. The strips of a column that a Gaussian
    reaches are contiguous, since an ellipse is convex. So only the first of their rows and one past the last are stored.
    """
    f = make_functions(real)
    record = wp.types.vector(9 + channels, real)
    batch_reals = wp.types.vector(BATCH, real)
    batch_channels = wp.types.vector(channels * BATCH, real)
    batch_rows = wp.types.vector((tile_size // STRIP) * BATCH, wp.int32)
    row_reals = wp.types.vector(tile_size, real)
    strip_reals = wp.types.vector(STRIP, real)
    lane_reals = wp.types.vector(TOGETHER, real)
    strip_ints = wp.types.vector(tile_size * (tile_size // STRIP), wp.int32)
    batch = wp.constant(BATCH)
    together = wp.constant(TOGETHER)
    side = wp.constant(tile_size)
    strip = wp.constant(STRIP)
    parts = wp.constant(tile_size // STRIP)
    bits = wp.constant(BATCH - 1)
    place_z = wp.constant(6 + channels)

    @wp.struct
    class Batch:
        """Values of the Gaussians of a batch."""

        x: batch_reals
        y: batch_reals
        u11: batch_reals
        u12: batch_reals
        u22: batch_reals
        opacity: batch_reals
        color: batch_channels
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
            b.color[c * batch + j] = projected[i][6 + c]

    @wp.func(inline=True)
    def load(
        projected: wp.array(dtype=record), gaussian_ids: wp.array(dtype=int), last: wp.int32, count: wp.int32,
        whole_tiles: wp.int32, b: wp.ref[Batch],
    ):  # fmt: skip
        """Load the Gaussians of ``count`` instances, from the last on backwards."""
        j = int(0)
        while j < count:  # a loop of its own, so that many loads are under way at once
            i = gaussian_ids[wp.max(last - j, 0)]
            if i < 0:
                break  # never true; a loop that may end early is not vectorised, which here avoids slow gathers
            b.x[j & bits] = projected[i][0]
            j += 1
        j = int(0)
        while j < count:
            i = gaussian_ids[wp.max(last - j, 0)]
            if i < 0:
                break  # never
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
    def find_rows(
        left: wp.int32, top: wp.int32, last: wp.int32, count: wp.int32, until: wp.ref[strip_ints],
        b: wp.ref[Batch],
    ):  # fmt: skip
        """Find the rows that the Gaussians reach; an instance skips strips whose ``until`` is not above its number."""
        e12 = lane_reals()
        e22 = lane_reals()
        group = int(0)
        while group < count:
            j = group & bits
            group += together
            for part in range(parts):
                for lane in range(together):
                    b.begin[part * batch + j + lane] = side
                    b.end[part * batch + j + lane] = 0
            for row in range(side):
                y = real(top + row) + real(0.5)
                for lane in range(together):
                    dy = y - at(b.y[j + lane])
                    e2 = at(b.u22[j + lane]) * dy
                    e12[lane] = f.apart(at(b.u12[j + lane]) * dy)
                    e22[lane] = f.apart(e2 * e2)
                for part in range(parts):
                    x = real(left + part * strip) + real(0.5)
                    strip_end = at_int(until[part * side + row])
                    for lane in range(together):
                        u11 = at(b.u11[j + lane])
                        start = f.apart(u11 * (x - at(b.x[j + lane]))) + e12[lane]
                        seen = last - (j + lane) < strip_end
                        hit = f.reaches(start, u11, e22[lane], at(b.aside[j + lane]), at(b.limit[j + lane])) and seen
                        o = part * batch + j + lane
                        b.begin[o] = wp.min(at_int(b.begin[o]), wp.where(hit, row, side))
                        b.end[o] = wp.max(at_int(b.end[o]), wp.where(hit, row + 1, 0))

    @wp.func(inline=True)
    def find_row_values(j: wp.int32, top: wp.int32, b: wp.ref[Batch], rows: wp.ref[Rows]):
        """Compute the values of a Gaussian on all rows."""
        u11 = at(b.u11[j])
        u12 = at(b.u12[j])
        u22 = at(b.u22[j])
        y = at(b.y[j])
        for row in range(side):
            dy = real(top + row) + real(0.5) - y
            e2 = u22 * dy
            rows.dy[row] = dy
            rows.e12[row] = f.apart(u12 * dy)
            rows.e22[row] = f.apart(e2 * e2)
        for lane in range(strip):
            rows.ramp[lane] = f.apart(u11 * real(lane))

    return SimpleNamespace(
        record=record, Batch=Batch, Rows=Rows, strip_ints=strip_ints, at=at, at_int=at_int, load=load, find_rows=find_rows,
        find_row_values=find_row_values,
    )  # fmt: skip
