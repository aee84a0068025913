"""CUDA functions that plain Warp cannot express: exchange between the threads of a warp or block, and 16-byte loads."""

import functools
from types import SimpleNamespace

import warp as wp

from warpgs.runtime.cuda_source import source

BLOCK = 128
"""Threads of a block in kernels that call `compact` or `clear_rows`."""


@functools.cache
def make_functions():
    """Make the functions, for CUDA; `make_color` makes the functions on colours."""
    vec12 = wp.types.vector(12, wp.float32)

    @wp.func_native(source("native_compact.cu", BLOCK=BLOCK))
    def compact(item: int, wanted: int) -> int:
        """Return the wanted items of the block's threads, assigned to its first threads in order; -1 for other threads.

        All BLOCK threads of the block must call it.
        """
        ...

    @wp.func_native(source("native_store_row.cu"))
    def store_row(records: wp.array2d(dtype=float), i: int, v: vec12):
        """Write row i of an array of rows of 12 floats, 16-byte aligned."""
        ...

    @wp.func_native(source("native_clear_rows.cu", BLOCK=BLOCK))
    def clear_rows(item: int, kept: int, sh: wp.array2d(dtype=wp.vec3)):
        """Set the rows of the block's items to zero, except those that are kept. All BLOCK threads must call it."""
        ...

    @wp.func_native(source("native_broadcast.cu"))
    def broadcast(value: int, lane: int) -> int:
        """Return the value that a lane of the warp holds. All 32 lanes of the warp must call this and the next three."""
        ...

    @wp.func_native(source("native_running_sum.cu"))
    def running_sum(value: int) -> int:
        """Return the sum over this lane of the warp and those before it."""
        ...

    @wp.func_native(source("native_whole_sum.cu"))
    def whole_sum(value: wp.int64) -> wp.int64:
        """Return the sum over all lanes of the warp."""
        ...

    @wp.func_native(source("native_holder.cu"))
    def holder(running_sum: int, item: int) -> int:
        """Return the first lane of the warp whose running sum exceeds ``item``, or the last lane."""
        ...

    return SimpleNamespace(
        compact=compact, store_row=store_row, clear_rows=clear_rows, broadcast=broadcast,
        running_sum=running_sum, whole_sum=whole_sum, holder=holder,
    )  # fmt: skip


@functools.cache
def make_color(bases: int):
    """Make the functions on colours, for CUDA and float32, and for a number of basis values (`sh.bases_for`)."""
    values = wp.types.vector(bases, wp.float32)

    @wp.func_native(source("native_color.cu", BASES=bases))
    def color(sh: wp.array2d(dtype=wp.vec3), n: int, count: int, weights: values) -> wp.vec4:
        """Return the weighted sum of the first ``count`` coefficients of row n, and their largest magnitude (ignoring NaN)."""
        ...

    @wp.func_native(source("native_color_backward.cu", BASES=bases))
    def color_backward(
        sh: wp.array2d(dtype=wp.vec3), n: int, count: int, weights: values, v: wp.vec3, add: int,
        v_sh: wp.array2d(dtype=wp.vec3),
    ) -> values:  # fmt: skip
        """Return the weights' gradient of `color` for upstream ``v``; store (0 past ``count``) or add the row's gradient."""
        ...

    return SimpleNamespace(color=color, color_backward=color_backward)
