"""Kernels of binning that write the (Gaussian, tile) instances, and find each tile's instances in the sorted lists."""

import functools

import warp as wp

from warpgs.kernels.functions import make_spans
from warpgs.kernels.native import make_functions as make_native

EACH = 4
"""Number of items per thread in short kernels on CUDA: with one item, waiting for its load would take longer than the work."""


@functools.cache
def make_find_ranges(slotted: bool, native: bool):
    """Make the kernel that finds the instances of each tile in the sorted keys; arguments are those of `make_emit`.

    A thread takes `EACH` instances on CUDA (``native``), else one. The instances of a thread lie far apart, so that
    neighbouring threads read neighbouring instances.
    """
    each = wp.constant(EACH if native else 1)
    ints = wp.types.vector(each, wp.int32)
    module = f"warpgs.kernels.tiles.ranges.{int(slotted)}.{int(native)}"

    @wp.kernel(enable_backward=False, grid_stride=False, module=module)
    def find_ranges(
        begin: int, keys: wp.array(dtype=int), slots: wp.array(dtype=int), owners: wp.array(dtype=int), count: int,
        no_tile: int,
        # outputs; ranges zero on entry
        ids: wp.array(dtype=int), ranges: wp.array2d(dtype=int),
    ):  # fmt: skip
        first = begin + wp.tid()
        apart = (count + each - 1) // each
        tile = ints()
        before = ints()
        after = ints()
        owner = ints()
        # all is loaded before anything is used or stored: the waits overlap
        for k in range(wp.static(each)):
            i = wp.min(first + k * apart, count - 1)
            tile[k] = keys[i]
            before[k] = keys[wp.max(i - 1, 0)]
            after[k] = keys[wp.min(i + 1, count - 1)]
            if wp.static(slotted):
                owner[k] = slots[i]
        if wp.static(slotted):
            for k in range(wp.static(each)):
                if tile[k] != no_tile:
                    owner[k] = owners[owner[k]]
        for k in range(wp.static(each)):
            i = first + k * apart
            if i < count:
                if tile[k] == no_tile:
                    ids[i] = 0
                else:
                    if wp.static(slotted):
                        ids[i] = owner[k]
                    if i == 0 or before[k] != tile[k]:
                        ranges[tile[k], 0] = i
                    if i == count - 1 or after[k] != tile[k]:
                        ranges[tile[k], 1] = i + 1

    return find_ranges


@functools.cache
def make_write(slotted: bool):
    """Make the function that writes an instance; arguments are those of `make_emit`."""

    @wp.func
    def write(
        slot: int, key: int, owner: int, keys: wp.array(dtype=int), slots: wp.array(dtype=int), owners: wp.array(dtype=int)
    ):
        keys[slot] = key
        if wp.static(slotted):
            slots[slot] = slot
            owners[slot] = owner
        else:
            slots[slot] = owner

    return write


@functools.cache
def make_emit(real, slotted: bool):
    """Make the kernel for CUDA that writes the instances of each Gaussian, row by row of tiles (for a CPU: `tiles_emit_cpu`).

    A warp shares the rows and then the tiles of its 32 Gaussians evenly among its lanes. Unused slots get the tile number
    ``no_tile``.

    Args:
        real: wp.float32 or wp.float64.
        slotted: True to write the slot and the Gaussian number of each instance; False to write the number in place of the
            slot.
    """
    s = make_spans(real)
    vec3 = wp.types.vector(3, real)
    vec2i = s.vec2i
    lanes = make_native()
    write = make_write(slotted)

    @wp.func
    def span_of(
        projected: wp.array2d(dtype=real), i: int, row: int, alpha_cut: real, square_sigma: real,
        origin_x: int, width: int, tile_size: int,
    ) -> vec2i:  # fmt: skip
        factor = vec3(projected[i, 2], projected[i, 3], projected[i, 4])
        reach = s.reach_of(projected[i, 5], alpha_cut, square_sigma)
        return s.tile_columns(
            projected[i, 0], projected[i, 1], factor, reach, projected[i, 10], projected[i, 11], row, origin_x, width, tile_size
        )

    module = f"warpgs.kernels.tiles.emit.{real.__name__}.{int(slotted)}"

    # five blocks to a multiprocessor
    @wp.kernel(enable_backward=False, grid_stride=False, cuda_max_registers=48, module=module)
    def emit(
        begin: int, projected: wp.array2d(dtype=real), order: wp.array(dtype=int), tile_counts: wp.array(dtype=int),
        ends: wp.array(dtype=wp.int64), count: int, per_camera: int,
        origin_x: int, origin_y: int, width: int, height: int, tile_size: int,
        alpha_cut: real, square_sigma: real, columns: int, tiles: int, no_tile: int, capacity: int,
        # outputs
        starts: wp.array(dtype=int), keys: wp.array(dtype=int), slots: wp.array(dtype=int), owners: wp.array(dtype=int),
        overflow: wp.array(dtype=int),
    ):  # fmt: skip
        j = begin + wp.tid()
        corner = (origin_y // tile_size) * columns + origin_x // tile_size  # rows and columns count from the image's corner
        i = int(0)
        touched = int(0)
        slot = int(0)
        end = int(0)
        if j < count:
            i = order[j]
            touched = tile_counts[i]
            last_slot = ends[j]
            if last_slot > wp.int64(capacity):  # the lists are cut, and must not be used; see `bin_tiles`
                overflow[0] = 1
                touched = int(wp.max(wp.int64(touched) - (last_slot - wp.int64(capacity)), wp.int64(0)))
                last_slot = wp.int64(capacity)
                tile_counts[i] = touched
            end = int(last_slot)
            slot = end - touched
            starts[i] = slot
        rows = vec2i(0, 0)
        if touched > 0:
            rows = s.tile_rows(projected[i, 1], projected[i, 11], origin_y, height, tile_size)
        first_tile = (i // per_camera) * tiles - corner
        # The warp writes the rows of its 32 Gaussians together: a lane finds the columns of a row, then each a tile.
        lane = wp.tid() % 32
        row_end = lanes.running_sum(rows[1] - rows[0])
        row_begin = row_end - (rows[1] - rows[0])
        row_count = lanes.broadcast(row_end, 31)
        batch = int(0)
        while batch < row_count:
            owner = lanes.holder(row_end, batch + lane)
            g = lanes.broadcast(i, owner)
            row = lanes.broadcast(rows[0], owner) + batch + lane - lanes.broadcast(row_begin, owner)
            span = vec2i(0, 0)
            if batch + lane < row_count:
                span = span_of(projected, g, row, alpha_cut, square_sigma, origin_x, width, tile_size)
            tile_end = lanes.running_sum(span[1] - span[0])
            tile_begin = tile_end - (span[1] - span[0])
            tile_count = lanes.broadcast(tile_end, 31)
            # a Gaussian's slots go on from where its rows of the last batch ended
            first = wp.max(row_begin - batch, 0)
            to_slot = lanes.broadcast(slot, owner) - lanes.broadcast(tile_begin, lanes.broadcast(first, owner))
            to_key = lanes.broadcast(first_tile, owner) + row * columns + span[0] - tile_begin
            limit = lanes.broadcast(end, owner)
            done = int(0)
            while done < tile_count:
                at = lanes.holder(tile_end, done + lane)
                to = done + lane + lanes.broadcast(to_slot, at)
                key = done + lane + lanes.broadcast(to_key, at)
                owner_of = lanes.broadcast(g, at)
                if to < lanes.broadcast(limit, at) and done + lane < tile_count:
                    write(to, key, owner_of, keys, slots, owners)
                done += 32
            written = lanes.broadcast(tile_end, wp.clamp(row_end - batch - 1, 0, 31))
            written -= lanes.broadcast(tile_begin, wp.min(first, 31))
            if row_begin < batch + 32 and row_end > batch and rows[1] > rows[0]:
                slot += written
            batch += 32
        # Two compilations of one formula may round differently; then a tile at the margin is counted but not found again.
        while slot < end:
            write(slot, no_tile, i, keys, slots, owners)
            slot += 1
        if j < count:  # slots of the unused capacity belong to no tile
            slot = j + int(wp.min(ends[count - 1], wp.int64(capacity)))
            while slot < capacity:
                keys[slot] = no_tile
                slot += count

    return emit
