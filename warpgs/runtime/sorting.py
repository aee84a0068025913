"""Stable sorts of pairs of keys and values by Warp, in memory of torch."""

import functools

import torch
import warp as wp

from warpgs.runtime import interop


@functools.lru_cache(maxsize=64)
def _array_at(address: int, size: int, dtype: object, device: torch.device) -> wp.array:
    """Return memory at an address as a Warp array, which does not own it; the caller must keep the tensor."""
    return wp.array(ptr=address, shape=size, dtype=dtype, device=interop.warp_device(device))


def sort_pairs(keys: interop.View, values: interop.View, count: int, **bits: int) -> None:
    """Sort the first ``count`` pairs stably by their keys; the second half of both tensors [2 M] is workspace.

    On a GPU the sort runs on the stream of `interop.stream_of`. ``bits`` are arguments of `wp.utils.radix_sort_pairs`.
    """
    arrays = (_array_at(t.data_ptr(), t.numel(), dtype, t.device) for t, dtype, _ in (keys, values))
    wp.utils.radix_sort_pairs(*arrays, count, **bits)
