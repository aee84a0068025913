"""Kernels of binning that order Gaussians by depth, and the running sums that count the visible ones."""

import functools
from types import SimpleNamespace

import torch
import warp as wp

from warpgs.kernels.native import make_functions as make_native
from warpgs.kernels.tiles_emit import EACH
from warpgs.runtime import interop
from warpgs.runtime.allocator import TORCH, Allocator


def _of_sum(native: bool) -> tuple[int, int]:
    """Return the number of threads per entry of the running sums, and of items per thread."""
    return (32, EACH) if native else (1, 1)


def sum_entries(count: int, native: bool) -> tuple[int, int]:
    """Return the number of running sums for ``count`` items, and the number of threads to launch.

    On CUDA, the number of threads is a multiple of 256, the block size.
    """
    width, each = _of_sum(native)
    entries = -(-count // (width * each))
    return entries, -(-entries * width // 256) * 256 if native else entries


@functools.cache
def make_kernels(real, native: bool):
    """Make the kernels for one scalar type; ``native`` is True for CUDA, where each warp has one entry of the running sums."""
    lanes = make_native() if native else None
    width, each = (wp.constant(n) for n in _of_sum(native))
    ints, reals = wp.types.vector(each, wp.int32), wp.types.vector(each, real)
    module = f"warpgs.kernels.tiles.{real.__name__}.{int(native)}"

    @wp.kernel(enable_backward=False, grid_stride=False, module=module)
    def depth_keys(
        begin: int, projected: wp.array2d(dtype=real), tile_counts: wp.array(dtype=int),
        # outputs
        keys: wp.array(dtype=real), ids: wp.array(dtype=int),
    ):  # fmt: skip
        i = begin + wp.tid()
        ids[i] = i
        if tile_counts[i] > 0:
            keys[i] = projected[i, 9]
        else:
            keys[i] = real(wp.inf)

    @wp.kernel(enable_backward=False, grid_stride=False, module=module)
    def pack_counts(
        begin: int, tile_counts: wp.array(dtype=int), bits: int,
        # outputs
        packed: wp.array(dtype=wp.int64),
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
            own = lanes.whole_sum(own)
        if thread % width == 0 and first <= last:
            packed[entry] = own

    @wp.kernel(enable_backward=False, grid_stride=False, module=module)
    def visible_keys(
        begin: int, projected: wp.array2d(dtype=real), tile_counts: wp.array(dtype=int), packed: wp.array(dtype=wp.int64),
        bits: int, limit: int,
        # outputs
        keys: wp.array(dtype=real), ids: wp.array(dtype=int),
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
            upto = lanes.running_sum(byte)
            whole = lanes.broadcast(upto, 31)
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
        begin: int, order: wp.array(dtype=int), tile_counts: wp.array(dtype=int),
        # outputs
        counts: wp.array(dtype=wp.int64),
    ):  # fmt: skip
        j = begin + wp.tid()
        counts[j] = wp.int64(tile_counts[order[j]])

    return SimpleNamespace(
        depth_keys=depth_keys, pack_counts=pack_counts, visible_keys=visible_keys, ordered_counts=ordered_counts
    )  # fmt: skip


def running_counts(
    counts: torch.Tensor, real, allocator: Allocator = TORCH, out: torch.Tensor | None = None
) -> torch.Tensor:  # fmt: skip
    """Return running sums, each of which counts both tiles and visible Gaussians in one number, int64, shape [S].

    A visible Gaussian adds its tile count and 2^`sum_bits`. `split_sum` splits the last sum.

    Args:
        counts: Tiles that each Gaussian touches, int32, shape [C * N], at least one.
        real: Scalar type of the Gaussians, of Warp.
        allocator: Provider of the sums' memory, which is workspace.
        out: Result of an earlier call, shape [S], for reuse of its memory; None for new memory.
    """
    device, count, native = counts.device, len(counts), counts.is_cuda
    sums, threads = sum_entries(count, native)
    packed = allocator.workspace((sums,), torch.int64, device) if out is None else out
    kernel = make_kernels(real, native).pack_counts
    interop.launch(kernel, threads, [interop.view(counts, wp.int32), sum_bits(count), interop.view(packed, wp.int64)], device)
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
