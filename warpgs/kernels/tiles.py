"""Binning of projected Gaussians into tiles, front to back: depth sort, emission, stable tile sort (docs/tiles.md)."""

from dataclasses import dataclass
from typing import NamedTuple

import torch
import warp as wp

from warpgs.constants import TILE_SIZE, Rule
from warpgs.errors import ResourceError
from warpgs.kernels import tiles_emit_cpu
from warpgs.kernels.project_lanes import LANES
from warpgs.kernels.tiles_emit import EACH, make_emit, make_find_ranges
from warpgs.kernels.tiles_order import make_kernels, running_counts, split_sum, sum_bits, sum_entries, sums_fit
from warpgs.runtime import interop
from warpgs.runtime.allocator import TORCH, Allocator
from warpgs.runtime.byte_units import format_bytes
from warpgs.runtime.device_memory import available_bytes, installed_bytes
from warpgs.runtime.sorting import sort_pairs
from warpgs.runtime.step_sizes import BINNING, BLENDING, FLOAT, LOSS, SAMPLING, Needs, StepSizes

LIST_BYTES = 20
"""Bytes of an instance while the lists are made: two sort buffers of (key, slot), and the Gaussian number."""
BYTES_PER_INSTANCE = LIST_BYTES + 48 + 80
"""Bytes of an instance with its gradient slot and its part of the saved states (blend_cuda.CHUNKS) on CUDA."""

MAX_INSTANCES = interop.MAX_SIZE // 2
"""Largest number of instances: a radix sort needs one array of twice that size."""


@dataclass(frozen=True)
class Tiles:
    """(Gaussian, tile) instances, sorted by tile and within a tile by depth; equal depths are in the order of Gaussian numbers.

    A flat Gaussian number is ``camera * N + n`` for Gaussian n, a tile number is ``camera * tiles + row * columns + column``.
    """

    size: int
    """Side of a tile [px]."""
    ranges: torch.Tensor
    """First instance of each tile and one past its last, int32, shape [C * tiles, 2]."""
    gaussian_ids: torch.Tensor
    """Flat Gaussian number of each instance, int32, shape [M]."""
    slots: torch.Tensor
    """Position of an instance before the tile sort, int32, shape [M]. Before the sort, the instances of a Gaussian are
    neighbours. So each instance owns a row for its gradient, and the rows are summed in a fixed order, without atomics."""
    starts: torch.Tensor
    """First slot of each Gaussian that has any, int32, shape [C * N]."""
    counts: torch.Tensor
    """Number of slots of each Gaussian, int32, shape [C * N]."""
    tile_ids: torch.Tensor
    """Tile of each instance, int32, shape [M]; C * tiles for an entry that belongs to no tile."""
    total: torch.Tensor
    """Actual number of instances, int64, shape [1], for kernels; with a capacity, M is the capacity."""
    visible: int = 0
    """Number of Gaussians that have instances; with a capacity, an upper bound."""

    def tensors(self) -> tuple[torch.Tensor, ...]:
        """Return all tensors [...], in the order of the constructor."""
        return self.ranges, self.gaussian_ids, self.slots, self.starts, self.counts, self.tile_ids, self.total


class Visible(NamedTuple):
    """Capacity for visible Gaussians, for renders that read nothing from the device."""

    sums: torch.Tensor
    """Running sums of `running_counts`, int64, shape [S]."""
    capacity: int
    """Number of visible Gaussians to allocate for, at most the number of all Gaussians. If the last of the sums shows more, the
    lists must not be used."""


@dataclass(frozen=True)
class InstanceMemory:
    """Memory that the (Gaussian, tile) instances of a render may take."""

    budget: int | None = None
    """Bytes; None for four fifths of the free memory."""
    capacity: int | None = None
    """Number of instances to allocate for. The actual number is then not read from the device, so the work can be captured as a
    CUDA graph. None for the actual number. Unused entries have a tile number that no tile has."""
    overflow: torch.Tensor | None = None
    """Set to 1 where there are more instances than the capacity: the lists are then cut short and must not be used. Int32,
    shape [1]; needed with a capacity."""
    allocator: Allocator = TORCH
    """Provider of the lists' memory."""
    visible: Visible | None = None
    """Capacity for visible Gaussians, if instances have a capacity too; None to sort all Gaussians."""


AS_NEEDED = InstanceMemory()
"""Memory for as many instances as there are."""


def grid(width: int, height: int, tile_size: int) -> tuple[int, int]:
    """Return the columns and rows of tiles that cover an image."""
    return -(-width // tile_size), -(-height // tile_size)


def _checked_counts(projected: torch.Tensor, tile_counts: torch.Tensor) -> torch.Tensor:
    """Return the tile counts by flat Gaussian number, int32, shape [C * N]; ValueError where a shape or type is wrong."""
    sizes = interop.check(projected=(projected, "C N 12"))
    if tuple(tile_counts.shape) != (sizes["C"], sizes["N"]) or tile_counts.dtype != torch.int32:
        wanted, found = [sizes["C"], sizes["N"]], list(tile_counts.shape)
        raise ValueError(f"tile_counts must be int32 of shape {wanted}, not {tile_counts.dtype} of shape {found}")
    return tile_counts.contiguous().view(-1)


def _checked_tiles(cameras: int, width: int, height: int, tile_size: int) -> int:
    """Return the number of tiles of all images; ResourceError where there are more than kernels can index."""
    columns, rows = grid(width, height, tile_size)
    tiles = cameras * columns * rows
    if tiles > interop.MAX_SIZE:
        raise ResourceError(
            f"{cameras:,} images of {width} x {height} px have {tiles:,} tiles of {tile_size} px, beyond the "
            f"{interop.MAX_SIZE:,} that kernels can index; render fewer cameras at once, or a window of each image"
        )
    return tiles


def step_bytes(sizes: StepSizes) -> Needs:
    """Return the bytes of the lists at each moment of a step; owners (Gaussian numbers) are freed after the sort."""
    columns, rows = grid(sizes.width, sizes.height, TILE_SIZE)
    ranges = 2 * FLOAT * columns * rows + (FLOAT + 8) * sizes.count  # of each tile; first slots and ends of each Gaussian
    sorting = (2 * 2 * FLOAT + 2 * 8) * sizes.count  # depths and order twice, two running sums of int64
    lists, kept = LIST_BYTES * sizes.instances, (LIST_BYTES - FLOAT) * sizes.instances
    waiting = 0 if sizes.chunked else ranges + kept  # no buffer of a chunk is kept for the backward pass
    return {BINNING: ranges + sorting + lists, LOSS: waiting, BLENDING: ranges + kept, SAMPLING: ranges + lists}


def _check_total(total: int, visible: int, device: torch.device, tiles: int, budget_bytes: int | None) -> None:
    """Raise ResourceError where the instances exceed the budget, or the number that kernels can index."""
    needed = total * BYTES_PER_INSTANCE
    # a query of the free memory takes at least 0.1 ms; small requests, below a twentieth of the memory, skip it
    countable = total <= MAX_INSTANCES
    if countable and budget_bytes is None and needed < installed_bytes(device) // 20:
        return
    budget = available_bytes(device) * 4 // 5 if budget_bytes is None else budget_bytes
    if countable and needed <= budget:
        return
    limit = format_bytes(budget) if countable else f"{MAX_INSTANCES:,} instances"
    raise ResourceError(
        f"{visible:,} visible Gaussians touch {total / max(visible, 1):.0f} of {tiles} tiles on average; their {total:,} "
        f"(Gaussian, tile) instances need {format_bytes(needed)}, and the limit is {limit}. Many Gaussians are probably far "
        "too large: check their scales, or render smaller images, fewer cameras at once, or raise the memory budget."
    )


def _depth_order(
    projected: torch.Tensor, counts: torch.Tensor, tiles: int, memory: InstanceMemory
) -> tuple[torch.Tensor, int, int]:
    """Return Gaussian numbers from front to back, int32; how many of them are visible; and the number of instances.

    With a capacity nothing is read from the device: all Gaussians count as visible, or as many as the capacity holds. Invisible
    ones come last, and the number of instances is the capacity. ``projected`` is [C * N, 12], ``counts`` [C * N], ``tiles`` the
    number of tiles of an image.
    """
    device, count, real, native = projected.device, len(counts), interop.real_of(projected), projected.is_cuda
    k = make_kernels(real, native)
    projected_view, counts_view = interop.view(projected, real), interop.view(counts, wp.int32)
    packed = None
    if memory.capacity is not None:
        visible, total = count, memory.capacity
        if memory.visible is not None:
            packed, visible = memory.visible
    else:
        if not sums_fit(count, tiles):
            many = torch.stack([(counts > 0).sum(), counts.sum(dtype=torch.int64)])
            _check_total(*reversed(many.tolist()), device, tiles, memory.budget)
        # One read from the device, before the sorts, returns the numbers of visible Gaussians and of touched tiles.
        packed = running_counts(counts, real, memory.allocator)
        visible, total = split_sum(int(packed[-1]), count)
        _check_total(total, visible, device, tiles, memory.budget)
    depths, order = (memory.allocator.workspace((2 * visible,), t, device) for t in (projected.dtype, torch.int32))
    depths_view, order_view = interop.view(depths, real), interop.view(order, wp.int32)
    if packed is None:
        interop.launch(k.depth_keys, count, [projected_view, counts_view, depths_view, order_view], device)
    else:
        sums_view, bits = interop.view(packed, wp.int64), sum_bits(count)
        inputs = [projected_view, counts_view, sums_view, bits, visible, depths_view, order_view]
        interop.launch(k.visible_keys, sum_entries(count, native)[1], inputs, device)
    sort_pairs(depths_view, order_view, visible)
    return order, visible, total


def _slot_ends(order: torch.Tensor, counts: torch.Tensor, visible: int, kernel, allocator: Allocator) -> torch.Tensor:
    """Return the slot after the last slot of each visible Gaussian, front to back, int64, shape [max(visible, 1)]."""
    ends = allocator.saved((max(visible, 1),), torch.int64, counts.device)
    inputs = [interop.view(order, wp.int32), interop.view(counts, wp.int32), interop.view(ends, wp.int64)]
    interop.launch(kernel, visible, inputs, counts.device)
    return torch.cumsum(ends, 0, out=ends) if visible > 0 else ends.zero_()


def _sort_by_tile(
    keys: torch.Tensor, slots: torch.Tensor, owners: torch.Tensor, ranges: torch.Tensor, total: int, slotted: bool
) -> torch.Tensor:
    """Sort the instances stably by tile, fill in the range of each tile, and return the Gaussian numbers, int32, shape [M].

    ``keys`` and ``slots`` are sort buffers [2 M], ``owners`` [M], or [0] without ``slotted``; ``ranges`` [C * tiles, 2].
    """
    no_tile, ids = len(ranges), slots[total:] if slotted else slots[:total]  # the second half of the buffers is free again
    keys_view, slots_view, *others = (interop.view(t, wp.int32) for t in (keys, slots, owners, ids, ranges))
    sort_pairs(keys_view, slots_view, total, end_bit=no_tile.bit_length())
    inputs = [keys_view, slots_view, others[0], total, no_tile, *others[1:]]
    native = keys.is_cuda
    interop.launch(make_find_ranges(slotted, native), -(-total // EACH) if native else total, inputs, keys.device)
    return ids


def bin_tiles(
    projected: torch.Tensor, tile_counts: torch.Tensor, *, width: int, height: int, rule: Rule, tile_size: int = TILE_SIZE,
    origin: tuple[int, int] = (0, 0), memory: InstanceMemory = AS_NEEDED, slotted: bool = True,
    listed: torch.Tensor | None = None,
) -> Tiles:  # fmt: skip
    """Return for every tile the Gaussians that touch it, front to back. Not differentiable.

    Args:
        projected: Projected Gaussians of `project`, shape [C, N, 12].
        tile_counts: Number of tiles that each Gaussian touches, int32, shape [C, N].
        width: Width of the image or window [px].
        height: Height of the image or window [px].
        rule: Cut-offs, the same as given to `project`.
        tile_size: Side of a tile [px].
        origin: Left and top [px] of the window given to `project`, multiples of ``tile_size``.
        memory: Memory that the (Gaussian, tile) instances may take; if it has a capacity, the lists have this length.
        slotted: True to return ``slots``, which gradients and `contributions` need; False leaves them empty and is faster.
        listed: True for the tiles that get instances, bool, shape [C * tiles]; the others stay empty. None for all tiles.

    Raises:
        ResourceError: The instances, counted in 64 bits before anything is allocated, exceed the budget or 2^30 - 1; or
            there are 2^31 tiles or more.
        TypeError: A scalar type is neither float32 nor float64.
        ValueError: A shape disagrees.
    """
    counts, (columns, rows) = _checked_counts(projected, tile_counts), grid(width, height, tile_size)
    cameras, per_camera = tile_counts.shape
    no_tile = _checked_tiles(cameras, width, height, tile_size)
    device, real, native, allocator = projected.device, interop.real_of(projected), projected.is_cuda, memory.allocator
    ranges = allocator.saved((no_tile, 2), torch.int32, device).zero_()
    if len(counts) == 0:
        return Tiles(tile_size, ranges, counts, counts, counts, counts, counts, counts.new_zeros(1, dtype=torch.int64))

    projected = projected.detach().contiguous().view(len(counts), -1)
    with interop.stream_of(device):
        order, visible, total = _depth_order(projected, counts, columns * rows, memory)
        ends = _slot_ends(order, counts, visible, make_kernels(real, native).ordered_counts, allocator)
        starts, keys, slots = (allocator.saved((n,), torch.int32, device) for n in (len(counts), 2 * total, 2 * total))
        owners = allocator.workspace((total if slotted else 0,), torch.int32, device)
        if memory.capacity is not None and not native:  # the CUDA kernel fills the unused capacity
            keys[:total].fill_(no_tile)
        overflow = starts if memory.capacity is None else memory.overflow
        inputs = [
            interop.view(projected, real), interop.view(order, wp.int32), interop.view(counts, wp.int32),
            interop.view(ends, wp.int64), visible, per_camera, *origin, width, height, tile_size, rule.alpha_cut,
            rule.square_sigma, columns, columns * rows, no_tile, total,
            *(interop.view(t, wp.int32) for t in (starts, keys, slots, owners, overflow)),
        ]  # fmt: skip
        if native:
            interop.launch(make_emit(real, slotted), -(-visible // 256) * 256, inputs, device, cost=10)
        else:
            interop.launch(tiles_emit_cpu.make_emit(real, slotted), -(-visible // LANES), inputs, device, cost=10 * LANES)
        if listed is not None:
            own, kept = keys[:total], torch.cat([listed, listed.new_zeros(1)])
            own.masked_fill_(~kept[own.long()], no_tile)
        ids = _sort_by_tile(keys, slots, owners, ranges, total, slotted)
    own_slots = slots[: total if slotted else 0]
    return Tiles(tile_size, ranges, ids, own_slots, starts, counts, keys[:total], ends[-1:], visible)
