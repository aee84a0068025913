"""Binning: which Gaussians touch which tile, in the order of their depth."""

import functools
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from warpgs.constants import LARGEST_HALF, TILE_SIZE
from warpgs.device import BINNING, BLENDING, FLOAT, LOSS, SAMPLING, Needs, StepSizes, format_bytes, free_for
from warpgs.errors import ResourceError
from warpgs.kernels import launch, native as cuda
from warpgs.kernels.cameras import named
from warpgs.kernels.ellipse import PROJECTED_SIZE, make_spans
from warpgs.kernels.graphs import TORCH, Allocator
from warpgs.kernels.native import EXACT, SCALE, IntRows, Ints, Longs, make_prefetch, source
from warpgs.kernels.project_cpu import LANES, make_lanes

EACH = 4
"""Number of items per thread in short kernels on CUDA: with one item, waiting for its load would take longer than the work."""


@functools.cache
def make_find_ranges(slotted: bool, native: bool):
    """Make the kernel that finds the instances of each tile in the sorted keys; arguments are those of `make_emit`."""
    # A thread's instances lie far apart, so that neighbouring threads read neighbouring instances.
    each = EACH if native else 1
    ints = wp.types.vector(each, wp.int32)
    prefetch = make_prefetch(wp.int32)
    module = f"warpgs.kernels.tiles.ranges.{int(slotted)}.{int(native)}"

    @wp.kernel(enable_backward=False, grid_stride=False, module=module)
    def find_ranges(
        begin: int, keys: Ints, slots: Ints, owners: Ints, count: int, no_tile: int,
        # outputs; ranges zero on entry
        ids: Ints, ranges: IntRows,
    ):  # fmt: skip
        first = begin + wp.tid()
        apart = (count + each - 1) // each
        if wp.static(slotted and not native):
            prefetch(owners, slots[wp.min(first + 64, count - 1)])
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
    def write(slot: int, key: int, owner: int, keys: Ints, slots: Ints, owners: Ints):
        keys[slot] = key
        if wp.static(slotted):
            slots[slot] = slot
            owners[slot] = owner
        else:
            slots[slot] = owner

    return write


@functools.cache
def make_emit(real, slotted: bool, ranked: bool = False):
    """Make the kernel for CUDA that writes the instances of each Gaussian, row by row of tiles (for a CPU: `make_emit_cpu`)."""
    # A warp shares the rows and then the tiles of its 32 Gaussians evenly among its lanes. Unused slots get the tile
    # ``no_tile``. Without ``slotted``, the number of the Gaussian takes the place of the slot. With ``ranked``, its place in
    # the order of depth does, and ``owners`` are `Tiles.packed`.
    s = make_spans(real)
    vec3, Rows = wp.types.vector(3, real), wp.array2d(dtype=real)
    vec2i = s.vec2i
    write = make_write(slotted)

    @wp.func_native(source("blend_pack.cu", SCALE=SCALE, LARGEST_HALF=f"{LARGEST_HALF}f"))
    def pack(j: int, i: int, count: int, projected: Rows, records: Ints): ...

    module = f"warpgs.kernels.tiles.emit.{real.__name__}.{int(slotted)}{'.ranked' * ranked}"

    # five blocks to a multiprocessor
    @wp.kernel(enable_backward=False, grid_stride=False, cuda_max_registers=48, module=module)
    def emit(
        begin: int, projected: Rows, order: Ints, tile_counts: Ints, ends: Longs, count: int, per_camera: int, origin_x: int,
        origin_y: int, width: int, height: int, tile_size: int, alpha_cut: real, square_sigma: real, columns: int, tiles: int,
        no_tile: int, capacity: int,
        # outputs
        starts: Ints, keys: Ints, slots: Ints, owners: Ints, overflow: Ints,
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
            if wp.static(not ranked):
                starts[i] = slot
        if wp.static(ranked):
            pack(j, i, count, projected, owners)
        rows = vec2i(0, 0)
        if touched > 0:
            rows = s.tile_rows(projected[i, 1], projected[i, 11], origin_y, height, tile_size)
        first_tile = (i // per_camera) * tiles - corner
        # The warp writes the rows of its 32 Gaussians together: a lane finds the columns of a row, then each a tile.
        lane = wp.tid() % 32
        row_end = cuda.running_sum(rows[1] - rows[0])
        row_begin = row_end - (rows[1] - rows[0])
        row_count = cuda.broadcast(row_end, 31)
        batch = int(0)
        while batch < row_count:
            owner = cuda.holder(row_end, batch + lane)
            g = cuda.broadcast(i, owner)
            row = cuda.broadcast(rows[0], owner) + batch + lane - cuda.broadcast(row_begin, owner)
            span = vec2i(0, 0)
            if batch + lane < row_count:
                factor = vec3(projected[g, 2], projected[g, 3], projected[g, 4])
                reach = s.reach_of(projected[g, 5], alpha_cut, square_sigma)
                span = s.tile_columns(
                    projected[g, 0], projected[g, 1], factor, reach, projected[g, 10], projected[g, 11],
                    row, origin_x, width, tile_size,
                )  # fmt: skip
            tile_end = cuda.running_sum(span[1] - span[0])
            tile_begin = tile_end - (span[1] - span[0])
            tile_count = cuda.broadcast(tile_end, 31)
            # a Gaussian's slots go on from where its rows of the last batch ended
            first = wp.max(row_begin - batch, 0)
            to_slot = cuda.broadcast(slot, owner) - cuda.broadcast(tile_begin, cuda.broadcast(first, owner))
            to_key = cuda.broadcast(first_tile, owner) + row * columns + span[0] - tile_begin
            limit = cuda.broadcast(end, owner)
            done = int(0)
            while done < tile_count:
                at = cuda.holder(tile_end, done + lane)
                to = done + lane + cuda.broadcast(to_slot, at)
                key = done + lane + cuda.broadcast(to_key, at)
                owner_of = cuda.broadcast(g, at)
                if wp.static(ranked):
                    owner_of = j - lane + cuda.broadcast(owner, at)
                if to < cuda.broadcast(limit, at) and done + lane < tile_count:
                    write(to, key, owner_of, keys, slots, owners)
                done += 32
            written = cuda.broadcast(tile_end, wp.clamp(row_end - batch - 1, 0, 31))
            written -= cuda.broadcast(tile_begin, wp.min(first, 31))
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


# The kernel in plain Warp that writes the (Gaussian, tile) instances on a CPU.
#
# As in `project_cpu`, a task processes `LANES` Gaussians; loops that the compiler vectorises find their rows and
# columns.


@functools.cache
def make_emit_cpu(real, slotted: bool):
    """Make the kernel; arguments are those of `make_emit`."""
    s = make_spans(real)
    vec3, Rows = wp.types.vector(3, real), wp.array2d(dtype=real)
    lane_reals, lane_ints = (wp.types.vector(LANES, kind) for kind in (real, wp.int32))
    lanes, row = LANES, make_lanes(real, PROJECTED_SIZE)
    write, prefetch, prefetch_count = make_write(slotted), make_prefetch(real, 2), make_prefetch(wp.int32)

    @wp.kernel(enable_backward=False, module="unique", module_options=EXACT)
    def emit(
        begin: int, projected: Rows, order: Ints, tile_counts: Ints, ends: Longs, count: int, per_camera: int, origin_x: int,
        origin_y: int, width: int, height: int, tile_size: int, alpha_cut: real, square_sigma: real, columns: int, tiles: int,
        no_tile: int, capacity: int,
        # outputs
        starts: Ints, keys: Ints, slots: Ints, owners: Ints, overflow: Ints,
    ):  # fmt: skip
        first = (begin + wp.tid()) * lanes
        used = wp.min(lanes, count - first)
        for later in range(first + 2 * lanes, wp.min(first + 3 * lanes, count)):
            prefetch(projected, order[later])
            prefetch_count(tile_counts, order[later])
        corner = (origin_y // tile_size) * columns + origin_x // tile_size  # rows and columns count from the image's corner
        owner = lane_ints()
        first_tile = lane_ints()
        slot = lane_ints()
        end = lane_ints()
        gaussians = row.vectors()
        reach = lane_reals()
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
            row.load(projected, i, lane, gaussians)
        begin_row = lane_ints()
        end_row = lane_ints()
        begin_column = lane_ints()
        end_column = lane_ints()
        for lane in range(lanes):
            p = row.get(gaussians, lane)
            rows = s.tile_rows(p[1], p[11], origin_y, height, tile_size)
            touches = slot[lane] < end[lane]
            begin_row[lane] = wp.where(touches, rows[0], 0)
            end_row[lane] = wp.where(touches, rows[1], 0)
        most = int(0)
        for lane in range(used):
            most = wp.max(most, end_row[lane] - begin_row[lane])
            if slot[lane] < end[lane]:
                reach[lane] = s.reach_of(projected[owner[lane], 5], alpha_cut, square_sigma)
        for k in range(most):
            for lane in range(lanes):
                at_row = begin_row[lane] + k
                p = row.get(gaussians, lane)
                factor = vec3(p[2], p[3], p[4])
                span = s.tile_columns(p[0], p[1], factor, reach[lane], p[10], p[11], at_row, origin_x, width, tile_size)
                begin_column[lane] = span[0]
                end_column[lane] = wp.where(at_row < end_row[lane], span[1], 0)
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


def _of_sum(native: bool) -> tuple[int, int]:
    """Return the number of threads per entry of the running sums, and of items per thread."""
    return (32, EACH) if native else (1, 1)


def sum_entries(count: int, native: bool) -> tuple[int, int]:
    """Return the numbers of running sums for ``count`` items, and of threads (on CUDA a multiple of the block size, 256)."""
    width, each = _of_sum(native)
    entries = -(-count // (width * each))
    return entries, -(-entries * width // 256) * 256 if native else entries


@functools.cache
def make_kernels(real, native: bool):
    """Make the kernels for one scalar type; ``native`` is True for CUDA, where each warp has one entry of the running sums."""
    width, each = _of_sum(native)
    ints, reals = wp.types.vector(each, wp.int32), wp.types.vector(each, real)
    Reals, Rows = wp.array(dtype=real), wp.array2d(dtype=real)
    module = f"warpgs.kernels.tiles.{real.__name__}.{int(native)}"

    @wp.kernel(enable_backward=False, grid_stride=False, module=module)
    def depth_keys(
        begin: int, projected: Rows, tile_counts: Ints,
        # outputs
        keys: Reals, ids: Ints,
    ):  # fmt: skip
        i = begin + wp.tid()
        ids[i] = i
        if tile_counts[i] > 0:
            keys[i] = projected[i, 9]
        else:
            keys[i] = real(wp.inf)

    @wp.kernel(enable_backward=False, grid_stride=False, module=module)
    def pack_counts(
        begin: int, tile_counts: Ints, bits: int,
        # outputs
        packed: Longs,
    ):  # fmt: skip
        thread = begin + wp.tid()
        entry = thread // width
        first = entry * width * each + thread % width
        last = tile_counts.shape[0] - 1
        own = wp.int64(0)
        for k in range(wp.static(each)):
            i = first + k * width
            touched = tile_counts[wp.min(i, last)]
            if i <= last and touched > 0:
                own += (wp.int64(1) << wp.int64(bits)) + wp.int64(touched)
        if wp.static(native):
            own = cuda.whole_sum(own)
        if thread % width == 0 and first <= last:
            packed[entry] = own

    @wp.kernel(enable_backward=False, grid_stride=False, module=module)
    def visible_keys(
        begin: int, projected: Rows, tile_counts: Ints, packed: Longs, bits: int, limit: int,
        # outputs
        keys: Reals, ids: Ints,
    ):  # fmt: skip
        thread = begin + wp.tid()
        entry = thread // width
        first = entry * width * each + thread % width
        last = tile_counts.shape[0] - 1
        entries = packed.shape[0]
        touched = ints()
        key = reals()
        for k in range(wp.static(each)):  # all is loaded before anything is used: the waits overlap
            i = first + k * width
            touched[k] = wp.where(i <= last, tile_counts[wp.min(i, last)], 0)
        passed = int(packed[wp.min(entry, entries - 1)] >> wp.int64(bits))  # visible ones up to an item
        all_visible = int(packed[entries - 1] >> wp.int64(bits))
        byte = int(0)  # one for each of the thread's items: of a warp at most 32 are visible
        for k in range(wp.static(each)):
            key[k] = real(wp.inf)
            if touched[k] > 0:
                key[k] = projected[first + k * width, 9]
                byte += 1 << (8 * k)
        upto = byte
        whole = byte
        if wp.static(native):
            upto = cuda.running_sum(byte)
            whole = cuda.broadcast(upto, 31)
        for k in range(wp.static(each)):
            passed -= (whole >> (8 * k)) & 255
        for k in range(wp.static(each)):
            i = first + k * width
            here = passed + ((upto >> (8 * k)) & 255)
            j = here - 1
            if touched[k] == 0:  # behind all visible ones, within the limit
                j = all_visible + i - here
            if i <= last and j < limit:
                keys[j] = key[k]
                ids[j] = i
            passed += (whole >> (8 * k)) & 255

    @wp.kernel(enable_backward=False, grid_stride=False, module=module)
    def ordered_counts(
        begin: int, order: Ints, tile_counts: Ints,
        # outputs
        counts: Longs,
    ):  # fmt: skip
        j = begin + wp.tid()
        counts[j] = wp.int64(tile_counts[order[j]])

    return named(depth_keys, pack_counts, visible_keys, ordered_counts)


def running_counts(counts: Tensor, real, allocator: Allocator = TORCH, out: Tensor | None = None) -> Tensor:
    """Return running sums int64 [S] of counts [C * N]; a visible Gaussian adds its count and 2^`sum_bits` (see `split_sum`)."""
    device, count, native = counts.device, len(counts), counts.is_cuda
    sums, threads = sum_entries(count, native)
    packed = allocator.workspace((sums,), torch.int64, device) if out is None else out
    launch.launch(make_kernels(real, native).pack_counts, threads, [counts, sum_bits(count), packed], device)
    return torch.cumsum(packed, 0, out=packed)


def sum_bits(count: int) -> int:
    """Return how many low bits of a running sum count instances; the other bits count up to ``count`` visible Gaussians."""
    return 63 - count.bit_length()


def sums_fit(count: int, tiles: int) -> bool:
    """Return whether running sums can count the instances of ``count`` Gaussians in all ``tiles`` tiles of an image."""
    return count * tiles < 2 ** sum_bits(count)


def split_sum(total: int, count: int) -> tuple[int, int]:
    """Split the last of the `running_counts` of ``count`` Gaussians into numbers of visible Gaussians and of instances."""
    return divmod(total, 2 ** sum_bits(count))


RECORD_SIZE = 8
"""Number of floats of a packed Gaussian, see `Tiles.packed`."""
LIST_BYTES = 20
"""Bytes of an instance while the lists are made: two sort buffers of (key, slot), and the Gaussian number."""
BYTES_PER_INSTANCE = LIST_BYTES + 48 + 80
"""Bytes of an instance with its gradient slot and its part of the saved states (blend_cuda.CHUNKS) on CUDA."""

MAX_INSTANCES = launch.MAX_SIZE // 2
"""Largest number of instances: a radix sort needs one array of twice that size."""


@dataclass(frozen=True)
class Tiles:
    """(Gaussian, tile) instances, sorted by tile and within a tile by depth; equal depths are in the order of Gaussian numbers.

    A flat Gaussian number is ``camera * N + n`` for Gaussian n, a tile number is ``camera * tiles + row * columns + column``.
    """

    size: int
    """Side of a tile [px]."""
    ranges: Tensor
    """First instance of each tile and one past its last, int32, shape [C * tiles, 2]."""
    gaussian_ids: Tensor
    """Flat Gaussian number of each instance, int32, shape [M]."""
    slots: Tensor
    """Position of an instance before the tile sort, int32, shape [M]. Before the sort, the instances of a Gaussian are
    neighbours. So each instance owns a row for its gradient, and the rows are summed in a fixed order, without atomics."""
    starts: Tensor
    """First slot of each Gaussian that has any, int32, shape [C * N]."""
    counts: Tensor
    """Number of slots of each Gaussian, int32, shape [C * N]."""
    tile_ids: Tensor
    """Tile of each instance, int32, shape [M]; C * tiles for an entry that belongs to no tile."""
    total: Tensor
    """Actual number of instances, int64, shape [1], for kernels; with a capacity, M is the capacity."""
    visible: int = 0
    """Number of Gaussians that have instances; with a capacity, an upper bound."""
    packed: Tensor | None = None
    """With `Pass.max_error` on CUDA in float32: records of the visible Gaussians in order of depth (blend_pack.cu), float32,
    shape [8 V + 8]; the last one starts with the largest colour. ``gaussian_ids`` are then places in this order."""

    def tensors(self) -> tuple[Tensor, ...]:
        """Return all tensors [...], in the order of the constructor."""
        return self.ranges, self.gaussian_ids, self.slots, self.starts, self.counts, self.tile_ids, self.total


@dataclass(frozen=True)
class InstanceMemory:
    """Memory that the (Gaussian, tile) instances of a render may take."""

    budget: int | None = None
    """Bytes; None for four fifths of the free memory."""
    capacity: int | None = None
    """Number of instances to allocate for. The actual number is then not read from the device, so the work can be captured as a
    CUDA graph. None for the actual number. Unused entries have a tile number that no tile has."""
    overflow: Tensor | None = None
    """Set to 1 where there are more instances than the capacity: the lists are then cut short and must not be used. Int32,
    shape [1]; needed with a capacity."""
    allocator: Allocator = TORCH
    """Provider of the lists' memory."""
    visible: tuple[Tensor, int] | None = None
    """Running sums of `running_counts` [S], and the number of visible Gaussians to allocate for, if instances have a capacity
    too; None to sort all Gaussians. If the last of the sums shows more of them, the lists must not be used."""


AS_NEEDED = InstanceMemory()
"""Memory for as many instances as there are."""


def grid(width: int, height: int, tile_size: int) -> tuple[int, int]:
    """Return the columns and rows of tiles that cover an image."""
    return -(-width // tile_size), -(-height // tile_size)


def step_bytes(sizes: StepSizes) -> Needs:
    """Return the bytes of the lists at each moment of a step; owners (Gaussian numbers) are freed after the sort."""
    columns, rows = grid(sizes.width, sizes.height, TILE_SIZE)
    ranges = 2 * FLOAT * columns * rows + (FLOAT + 8) * sizes.count  # of each tile; first slots and ends of each Gaussian
    sorting = (2 * 2 * FLOAT + 2 * 8) * sizes.count  # depths and order twice, two running sums of int64
    lists, kept = LIST_BYTES * sizes.instances, (LIST_BYTES - FLOAT) * sizes.instances
    waiting = 0 if sizes.chunked else ranges + kept  # no buffer of a chunk is kept for the backward pass
    return {BINNING: ranges + sorting + lists, LOSS: waiting, BLENDING: ranges + kept, SAMPLING: ranges + lists}


def _check_total(total: int, device: torch.device, budget_bytes: int | None) -> None:
    """Raise ResourceError where the instances exceed the budget, or the number that kernels can index."""
    needed = total * BYTES_PER_INSTANCE
    countable = total <= MAX_INSTANCES
    budget = 0.8 * free_for(needed, device) if budget_bytes is None else budget_bytes
    if countable and needed <= budget:
        return
    limit = format_bytes(budget) if countable else f"{MAX_INSTANCES:,} instances"
    needs = f"{total:,} (Gaussian, tile) instances need {format_bytes(needed)}, and the limit is {limit}"
    raise ResourceError(f"{needs}. Check the Gaussians' scales, render smaller images, or raise the memory budget")


def _depth_order(projected: Tensor, counts: Tensor, tiles: int, memory: InstanceMemory) -> tuple[Tensor, int, int]:
    """Return Gaussian numbers from front to back, int32; how many of them are visible; and the number of instances."""
    # With a capacity nothing is read from the device: all Gaussians count as visible, or as many as the capacity holds.
    # Invisible ones come last, and the number of instances is the capacity.
    device, count, real, native = projected.device, len(counts), launch.real_of(projected), projected.is_cuda
    k = make_kernels(real, native)
    packed = None
    if memory.capacity is not None:
        visible, total = count, memory.capacity
        if memory.visible is not None:
            packed, visible = memory.visible
    else:
        if not sums_fit(count, tiles):
            _check_total(int(counts.sum(dtype=torch.int64)), device, memory.budget)
        # One read from the device, before the sorts, returns the numbers of visible Gaussians and of touched tiles.
        packed = running_counts(counts, real, memory.allocator)
        visible, total = split_sum(int(packed[-1]), count)
        _check_total(total, device, memory.budget)
    depths, order = (memory.allocator.workspace((2 * visible,), t, device) for t in (projected.dtype, torch.int32))
    if packed is None:
        launch.launch(k.depth_keys, count, [projected, counts, depths, order], device)
    else:
        inputs = [projected, counts, packed, sum_bits(count), visible, depths, order]
        launch.launch(k.visible_keys, sum_entries(count, native)[1], inputs, device)
    launch.sort_pairs(depths, order, visible)
    return order, visible, total


def bin_tiles(
    projected: Tensor, tile_counts: Tensor, settings: Any, memory: InstanceMemory = AS_NEEDED,
    slotted: bool = True, listed: Tensor | None = None,
) -> Tiles:  # fmt: skip
    """Return for every tile of the window the Gaussians [C, N, 12] that touch it, front to back. Not differentiable."""
    # ``settings`` are a `falloff.Pass`. Without ``slotted``, which gradients and `contributions` need, slots stay empty.
    # ``listed`` [C * tiles] is True for the tiles that get instances; None for all.
    cameras, per_camera, _ = projected.shape
    (*origin, width, height), tile_size, rule = settings.window, settings.tile_size, settings.rule
    columns, rows = grid(width, height, tile_size)
    no_tile = int(cameras * columns * rows)  # sizes of numpy have no bit_length
    if no_tile > launch.MAX_SIZE:
        raise ResourceError(f"{cameras:,} images of {width} x {height} px have too many tiles; render fewer at once")
    counts = tile_counts.contiguous().view(-1)
    device, real, native, allocator = projected.device, launch.real_of(projected), projected.is_cuda, memory.allocator
    ranges = allocator.saved((no_tile, 2), torch.int32, device).zero_()
    if len(counts) == 0:
        return Tiles(tile_size, ranges, counts, counts, counts, counts, counts, counts.new_zeros(1, dtype=torch.int64))

    projected = projected.detach().contiguous().view(len(counts), -1)
    with launch.stream_of(device):
        order, visible, total = _depth_order(projected, counts, columns * rows, memory)
        ends = allocator.saved((max(visible, 1),), torch.int64, device)
        launch.launch(make_kernels(real, native).ordered_counts, visible, [order, counts, ends], device)
        ends = torch.cumsum(ends, 0, out=ends) if visible > 0 else ends.zero_()
        starts, keys, slots = (allocator.saved((n,), torch.int32, device) for n in (len(counts), 2 * total, 2 * total))
        packs = settings.max_error > 0 and native and real is wp.float32 and not slotted
        owned = (visible + 1) * RECORD_SIZE if packs else total if slotted else 0
        owners = allocator.workspace((owned,), torch.int32, device)
        if memory.capacity is not None and not native:  # the CUDA kernel fills the unused capacity
            keys[:total].fill_(no_tile)
        overflow = starts if memory.capacity is None else memory.overflow
        inputs = [
            projected, order, counts, ends, visible, per_camera, *origin, width, height, tile_size, rule.alpha_cut,
            rule.square_sigma, columns, columns * rows, no_tile, total, starts, keys, slots, owners, overflow,
        ]  # fmt: skip
        if packs:
            owners[-RECORD_SIZE:].zero_()
        if native:
            launch.launch(make_emit(real, slotted, packs), -(-visible // 256) * 256, inputs, device)
        else:
            launch.launch(make_emit_cpu(real, slotted), -(-visible // LANES), inputs, device, cost=10 * LANES)
        if listed is not None:
            own, kept = keys[:total], torch.cat([listed, listed.new_zeros(1)])
            own.masked_fill_(~kept[own.long()], no_tile)
        launch.sort_pairs(keys, slots, total, end_bit=no_tile.bit_length())
        ids = slots[total:] if slotted else slots[:total]  # the second half of the buffers is free again
        inputs = [keys, slots, owners, total, no_tile, ids, ranges]
        launch.launch(make_find_ranges(slotted, native), -(-total // EACH) if native else total, inputs, device)
    own_slots, packed = slots[: total if slotted else 0], owners.view(torch.float32) if packs else None
    return Tiles(tile_size, ranges, ids, own_slots, starts, counts, keys[:total], ends[-1:], visible, packed)
