"""Between torch and Warp: scalar types, zero-copy views, checks, streams, and launches spread over CPU threads."""

from __future__ import annotations

import contextlib
import functools
import itertools
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import torch
import warp as wp

wp.config.log_level = wp.LOG_WARNING  # its banner and compile notes are not for our users


@contextlib.contextmanager
def _without_driver_notice():
    """Warp's native code prints a warning where there is no CUDA driver; on a machine without one that is no news."""
    if torch.cuda.is_available():
        yield
        return
    sys.stderr.flush()
    saved, sink = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(sink)


with _without_driver_notice():
    wp.init()  # device_from_torch fails before this

REALS = {torch.float32: wp.float32, torch.float64: wp.float64}

CHUNKS_PER_THREAD = 8
"""A CPU launch is cut into this many ranges per thread, so that a few heavy tiles do not hold up the rest."""

SERIAL_WORK = 20_000
"""Launches with less work than this (items times cost) stay on the calling thread: a hand-over costs about 50 us."""


def real_of(tensor: torch.Tensor) -> type:
    """Warp scalar type of a tensor: float32 or float64; TypeError for any other."""
    if tensor.dtype not in REALS:
        raise TypeError(f"kernels take float32 or float64 tensors, not {tensor.dtype}")
    return REALS[tensor.dtype]


def set_threads(count: int) -> None:
    """Let CPU launches use this many threads (at least 1). The number is torch's own, so both agree."""
    torch.set_num_threads(count)


@functools.cache
def _pool(count: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(count, thread_name_prefix="warpgs")


def view(tensor: torch.Tensor, dtype) -> wp.array:
    """The tensor's memory as a Warp array of that element type, without a copy and without gradient."""
    return wp.from_torch(tensor.detach(), dtype=dtype, requires_grad=False)


@contextlib.contextmanager
def stream_of(device: torch.device):
    """Run Warp's work on torch's current stream of that device; nothing to do on a CPU."""
    if device.type == "cuda":
        with wp.ScopedStream(wp.stream_from_torch(torch.cuda.current_stream(device)), sync_enter=False):
            yield
    else:
        yield


def launch(kernel, count: int, inputs: Sequence, device: torch.device, *, cost: int = 1, block_dim: int = 256) -> None:
    """Run ``kernel`` over ``count`` independent items; its first argument is the number of the first item.

    On a CPU the items are cut into ranges over torch's number of threads. That is safe and repeatable because every
    kernel here writes to memory that its item alone owns.

    Args:
        kernel: Warp kernel whose item number is ``begin + wp.tid()``.
        count: Number of items.
        inputs: Arguments after ``begin``.
        device: Where the arrays live.
        cost: Rough work of an item in units of 10 ns, to decide whether threads pay.
        block_dim: CUDA threads per block.
    """
    if count == 0:
        return
    if device.type == "cuda":
        wp.launch(kernel, count, inputs=[0, *inputs], device=wp.device_from_torch(device), block_dim=block_dim)
        return
    threads = torch.get_num_threads()
    if threads == 1 or count == 1 or count * cost < SERIAL_WORK:
        wp.launch(kernel, count, inputs=[0, *inputs], device="cpu", record_tape=False)
        return
    # Compiling from several threads at once is not safe; launches on a CPU are compiled for blocks of one thread.
    kernel.module.load("cpu", block_dim=1)
    chunks = min(count, threads * CHUNKS_PER_THREAD)
    bounds = [count * i // chunks for i in range(chunks + 1)]

    def run(begin: int, end: int) -> None:
        wp.launch(kernel, end - begin, inputs=[begin, *inputs], device="cpu", record_tape=False)

    for done in [_pool(threads).submit(run, a, b) for a, b in itertools.pairwise(bounds)]:
        done.result()


def check(**tensors: tuple[torch.Tensor, str]) -> dict[str, int]:
    """Check shapes, scalar types and devices of named tensors against patterns such as ``means=(means, "N 3")``.

    A capital letter stands for a size that must agree wherever it occurs. Returns the sizes by letter.

    Raises:
        TypeError: something is no tensor, or its scalar type is neither float32 nor float64, or types differ.
        ValueError: a shape or a device disagrees; the message names the argument, what was wanted and what was found.
    """
    sizes: dict[str, int] = {}
    first_name, first = "", None
    for name, (tensor, pattern) in tensors.items():
        if not isinstance(tensor, torch.Tensor):
            raise TypeError(f"{name} must be a torch tensor, not {type(tensor).__name__}")
        real_of(tensor)
        if first is None:
            first_name, first = name, tensor
        if tensor.dtype != first.dtype:
            raise TypeError(f"{name} is {tensor.dtype} but {first_name} is {first.dtype}; give both the same type")
        if tensor.device != first.device:
            raise ValueError(f"{name} is on {tensor.device} but {first_name} is on {first.device}; move one of them")
        wanted = pattern.split()
        found = tuple(tensor.shape)
        fits = len(wanted) == len(found)
        for symbol, size in zip(wanted, found):
            expected = int(symbol) if symbol.isdigit() else sizes.setdefault(symbol, size)
            fits = fits and expected == size
        if not fits:
            known = ", ".join(f"{k}={v}" for k, v in sizes.items())
            raise ValueError(f"{name} must have shape [{', '.join(wanted)}] ({known}), not {list(found)}")
    return sizes
