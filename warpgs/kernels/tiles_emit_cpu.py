"""The kernel in plain Warp that writes the (Gaussian, tile) instances on a CPU.

As in `project_cpu`, a task processes `LANES` Gaussians; loops that the compiler vectorises find their rows and columns.
"""

import functools

import warp as wp

from warpgs.kernels.compiler import EXACT
from warpgs.kernels.functions import make_spans
from warpgs.kernels.project_lanes import LANES
from warpgs.kernels.tiles_emit import make_write


@functools.cache
def make_emit(real, slotted: bool):
    """Make the kernel; arguments are those of `tiles_emit.make_emit`."""
    s = make_spans(real, lanes=True)
    vec3 = wp.types.vector(3, real)
    lane_reals = wp.types.vector(LANES, real)
    lane_ints = wp.types.vector(LANES, wp.int32)
    lanes = wp.constant(LANES)
    write = make_write(slotted)

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT)
    def emit(
        begin: int, projected: wp.array2d(dtype=real), order: wp.array(dtype=int), tile_counts: wp.array(dtype=int),
        ends: wp.array(dtype=wp.int64), count: int, per_camera: int,
        origin_x: int, origin_y: int, width: int, height: int, tile_size: int,
        alpha_cut: real, square_sigma: real, columns: int, tiles: int, no_tile: int, capacity: int,
        # outputs
        starts: wp.array(dtype=int), keys: wp.array(dtype=int), slots: wp.array(dtype=int), owners: wp.array(dtype=int),
        overflow: wp.array(dtype=int),
    ):  # fmt: skip
        first = (begin + wp.tid()) * lanes
        used = wp.min(lanes, count - first)
        corner = (origin_y // tile_size) * columns + origin_x // tile_size  # rows and columns count from the image's corner
        owner = lane_ints()
        first_tile = lane_ints()
        slot = lane_ints()
        end = lane_ints()
        x = lane_reals()
        y = lane_reals()
        u11 = lane_reals()
        u12 = lane_reals()
        u22 = lane_reals()
        reach = lane_reals()
        half_width = lane_reals()
        half_height = lane_reals()
        for lane in range(used):
            i = order[first + lane]
            touched = tile_counts[i]
            last = ends[first + lane]
            if last > wp.int64(capacity):  # the lists are cut, and must not be used; see `bin_tiles`
                overflow[0] = 1
                touched = int(wp.max(wp.int64(touched) - (last - wp.int64(capacity)), wp.int64(0)))
                last = wp.int64(capacity)
                tile_counts[i] = touched
            owner[lane] = i
            first_tile[lane] = (i // per_camera) * tiles - corner
            end[lane] = int(last)
            slot[lane] = int(last) - touched
            starts[i] = int(last) - touched
            x[lane] = projected[i, 0]
            y[lane] = projected[i, 1]
            u11[lane] = projected[i, 2]
            u12[lane] = projected[i, 3]
            u22[lane] = projected[i, 4]
            reach[lane] = projected[i, 5]
            half_width[lane] = projected[i, 10]
            half_height[lane] = projected[i, 11]
        begin_row = lane_ints()
        end_row = lane_ints()
        begin_column = lane_ints()
        end_column = lane_ints()
        for lane in range(lanes):
            rows = s.tile_rows(y[lane], half_height[lane], origin_y, height, tile_size)
            touches = slot[lane] < end[lane]
            begin_row[lane] = wp.where(touches, rows[0], 0)
            end_row[lane] = wp.where(touches, rows[1], 0)
        most = int(0)
        for lane in range(used):
            most = wp.max(most, end_row[lane] - begin_row[lane])
            if slot[lane] < end[lane]:
                reach[lane] = s.reach_of(reach[lane], alpha_cut, square_sigma)
        for k in range(most):
            for lane in range(lanes):
                row = begin_row[lane] + k
                span = s.tile_columns(
                    x[lane], y[lane], vec3(u11[lane], u12[lane], u22[lane]), reach[lane], half_width[lane], half_height[lane],
                    row, origin_x, width, tile_size,
                )  # fmt: skip
                begin_column[lane] = span[0]
                end_column[lane] = wp.where(row < end_row[lane], span[1], 0)
            for lane in range(used):
                to = slot[lane]
                key = first_tile[lane] + (begin_row[lane] + k) * columns + begin_column[lane]
                until = wp.min(to + end_column[lane] - begin_column[lane], end[lane])
                while to < until:
                    write(to, key, owner[lane], keys, slots, owners)
                    to += 1
                    key += 1
                slot[lane] = to
        # Two compilations of one formula may round differently; then a tile at the margin is counted but not found again.
        for lane in range(used):
            to = slot[lane]
            while to < end[lane]:
                write(to, no_tile, owner[lane], keys, slots, owners)
                to += 1

    return emit
