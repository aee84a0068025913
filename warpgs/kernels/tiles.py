"""Bin projected Gaussians into image tiles, front to back: depth sort, emission, stable tile sort (docs/tiles.md)."""

import functools
import os
from dataclasses import dataclass
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.constants import Rule
from warpgs.errors import ResourceError
from warpgs.kernels import bridge
from warpgs.kernels.functions import make_spans

BYTES_PER_INSTANCE = 24 + 40
"""Two sort buffers of (key, slot), owner and sorted id; and the gradient slot of the backward pass in float32."""

MAX_INSTANCES = 2**31 - 1
"""Warp's array sizes and thread numbers are signed 32-bit."""


@dataclass(frozen=True)
class Tiles:
    """(Gaussian, tile) instances, sorted by tile and within a tile by depth; ties go by Gaussian number.

    ``i`` below is a flat Gaussian number in [0, C N), a tile number is ``camera * tiles + row * columns + column``.
    """

    size: int
    """Side of a tile [px]."""
    ranges: torch.Tensor
    """First instance of each tile and one past its last, int32, shape [C * tiles, 2]."""
    splat_ids: torch.Tensor
    """Flat Gaussian number of each instance, int32, shape [M]."""
    slots: torch.Tensor
    """Where an instance stood before the tile sort, int32, shape [M]: there the instances of a Gaussian are neighbours,
    so each owns a row that gradients can be written to and then summed in a fixed order, without atomics."""
    starts: torch.Tensor
    """First slot of each Gaussian, int32, shape [C * N]."""
    counts: torch.Tensor
    """Number of slots of each Gaussian, int32, shape [C * N]."""


def grid(width: int, height: int, tile_size: int) -> tuple[int, int]:
    """Columns and rows of tiles that cover an image."""
    return -(-width // tile_size), -(-height // tile_size)


@functools.cache
def make_kernels(real):
    """Kernels for one scalar type."""
    s = make_spans(real)
    vec3 = wp.types.vector(3, real)

    @wp.kernel(enable_backward=False, module=f"warpgs.kernels.tiles.{real.__name__}")
    def depth_keys(
        begin: int, splats: wp.array2d(dtype=real), tile_counts: wp.array(dtype=int),
        # outputs
        keys: wp.array(dtype=real), ids: wp.array(dtype=int),
    ):  # fmt: skip
        i = begin + wp.tid()
        ids[i] = i
        if tile_counts[i] > 0:
            keys[i] = splats[i, 9]
        else:
            keys[i] = real(wp.inf)

    @wp.kernel(enable_backward=False, module=f"warpgs.kernels.tiles.{real.__name__}")
    def emit(
        begin: int, splats: wp.array2d(dtype=real), order: wp.array(dtype=int), tile_counts: wp.array(dtype=int),
        starts: wp.array(dtype=int), per_camera: int, width: int, height: int, tile_size: int,
        alpha_cut: real, square_sigma: real, columns: int, tiles: int, no_tile: int,
        # outputs
        keys: wp.array(dtype=int), slots: wp.array(dtype=int), owners: wp.array(dtype=int),
    ):  # fmt: skip
        i = order[begin + wp.tid()]
        if tile_counts[i] == 0:
            return
        slot = starts[i]
        end = slot + tile_counts[i]
        base = (i // per_camera) * tiles
        factor = vec3(splats[i, 2], splats[i, 3], splats[i, 4])
        reach = s.reach_of(splats[i, 5], alpha_cut, square_sigma)
        rows = s.tile_rows(splats[i, 1], splats[i, 11], height, tile_size)
        for row in range(rows[0], rows[1]):
            span = s.tile_columns(
                splats[i, 0], splats[i, 1], factor, reach, splats[i, 10], splats[i, 11], row, width, tile_size
            )
            for column in range(span[0], span[1]):
                if slot < end:
                    keys[slot] = base + row * columns + column
                    slots[slot] = slot
                    owners[slot] = i
                    slot += 1
        # Two compilations of one formula may round apart, and then a margin tile is counted but not found again.
        while slot < end:
            keys[slot] = no_tile
            slots[slot] = slot
            owners[slot] = i
            slot += 1

    @wp.kernel(enable_backward=False, module="warpgs.kernels.tiles.ranges")
    def find_ranges(
        begin: int, keys: wp.array(dtype=int), slots: wp.array(dtype=int), owners: wp.array(dtype=int), count: int,
        no_tile: int,
        # outputs; ranges zero on entry
        ids: wp.array(dtype=int), ranges: wp.array2d(dtype=int),
    ):  # fmt: skip
        i = begin + wp.tid()
        ids[i] = owners[slots[i]]
        tile = keys[i]
        if tile == no_tile:
            return
        if i == 0 or keys[wp.max(i - 1, 0)] != tile:
            ranges[tile, 0] = i
        if i == count - 1 or keys[wp.min(i + 1, count - 1)] != tile:
            ranges[tile, 1] = i + 1

    return SimpleNamespace(depth_keys=depth_keys, emit=emit, find_ranges=find_ranges)


def available_bytes(device: torch.device) -> int:
    """Memory that is free now on a device [bytes]."""
    if device.type == "cuda":
        free, _ = torch.cuda.mem_get_info(device)
        return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")


def _checked_total(counts: torch.Tensor, ends: torch.Tensor, tiles: int, budget_bytes: int | None) -> int:
    total = int(ends[-1])
    budget = available_bytes(counts.device) * 4 // 5 if budget_bytes is None else budget_bytes
    needed = total * BYTES_PER_INSTANCE
    # below 16 MB the question is not worth asking the system
    if total <= MAX_INSTANCES and (needed <= budget or (budget_bytes is None and needed < 2**24)):
        return total
    visible = int((counts > 0).sum())
    limit = f"{MAX_INSTANCES:,} instances" if total > MAX_INSTANCES else f"{budget / 2**30:.2f} GiB"
    raise ResourceError(
        f"binning {visible:,} visible Gaussians into tiles makes {total:,} (Gaussian, tile) instances, "
        f"{total / max(visible, 1):.0f} of {tiles} tiles each on average, which needs {needed / 2**30:.2f} GiB; the limit is "
        f"{limit}. Many Gaussians are probably far too large: check their scales, or render smaller images, fewer cameras "
        "at once, or raise the memory budget."
    )


def bin_tiles(
    splats: torch.Tensor,
    tile_counts: torch.Tensor,
    *,
    width: int,
    height: int,
    tile_size: int = 16,
    rule: Rule,
    budget_bytes: int | None = None,
) -> Tiles:
    """List for every tile the Gaussians that touch it, front to back. Not differentiable.

    Args:
        splats: Records of `project`, shape [C, N, 12].
        tile_counts: Tiles that each touches, int32, shape [C, N].
        width: Image width [px].
        height: Image height [px].
        tile_size: Side of a tile [px].
        rule: Cut-offs, the same as given to `project`.
        budget_bytes: Memory the instances may take; None for four fifths of what is free.

    Returns:
        The sorted instances.

    Raises:
        ResourceError: The instances, counted in 64 bits before anything is allocated, exceed the budget or 2^31 - 1.
        TypeError: A scalar type is neither float32 nor float64.
        ValueError: A shape disagrees.
    """
    sizes = bridge.check(splats=(splats, "C N 12"))
    if tuple(tile_counts.shape) != (sizes["C"], sizes["N"]) or tile_counts.dtype != torch.int32:
        raise ValueError(f"tile_counts must be int32 of shape {[sizes['C'], sizes['N']]}, not {list(tile_counts.shape)}")
    device, real = splats.device, bridge.real_of(splats)
    k = make_kernels(real)
    columns, rows = grid(width, height, tile_size)
    tiles, count = columns * rows, sizes["C"] * sizes["N"]
    no_tile = sizes["C"] * tiles
    counts = tile_counts.contiguous().view(-1)
    ranges = torch.zeros(no_tile, 2, dtype=torch.int32, device=device)
    empty = torch.zeros(0, dtype=torch.int32, device=device)
    if count == 0:
        return Tiles(tile_size, ranges, empty, empty, empty, counts)

    splats = splats.detach().contiguous().view(count, -1)
    ints = functools.partial(torch.empty, dtype=torch.int32, device=device)
    with bridge.stream_of(device):
        depths, order = torch.empty(2 * count, dtype=splats.dtype, device=device), ints(2 * count)
        depths_view, order_view = bridge.view(depths, real), bridge.view(order, wp.int32)
        splats_view, counts_view = bridge.view(splats, real), bridge.view(counts, wp.int32)
        bridge.launch(k.depth_keys, count, [splats_view, counts_view, depths_view, order_view], device)
        wp.utils.radix_sort_pairs(depths_view, order_view, count)
        order = order[:count]
        sorted_counts = counts[order]
        ends = torch.cumsum(sorted_counts, 0, dtype=torch.int64)
        total = _checked_total(counts, ends, tiles, budget_bytes)
        starts = ints(count)
        starts[order] = (ends - sorted_counts).to(torch.int32)
        if total == 0:
            return Tiles(tile_size, ranges, empty, empty, starts, counts)

        keys, slots, owners, ids = ints(2 * total), ints(2 * total), ints(total), ints(total)
        keys_view, slots_view, owners_view = (bridge.view(t, wp.int32) for t in (keys, slots, owners))
        inputs = [
            splats_view, bridge.view(order, wp.int32), counts_view, bridge.view(starts, wp.int32), sizes["N"],
            width, height, tile_size, rule.alpha_cut, rule.square_sigma, columns, tiles, no_tile,
            keys_view, slots_view, owners_view,
        ]  # fmt: skip
        bridge.launch(k.emit, count, inputs, device, cost=10)
        wp.utils.radix_sort_pairs(keys_view, slots_view, total, end_bit=no_tile.bit_length())
        inputs = [keys_view, slots_view, owners_view, total, no_tile, bridge.view(ids, wp.int32), bridge.view(ranges, wp.int32)]
        bridge.launch(k.find_ranges, total, inputs, device)
    return Tiles(tile_size, ranges, ids, slots[:total].clone(), starts, counts)
