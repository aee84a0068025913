"""GPU time of a function by the driver's tracer, and its peak memory."""

from __future__ import annotations

import gc
import statistics
from collections import Counter
from collections.abc import Callable

import torch
import warp as wp

from warpgs import clear_graph_cache

TRACES = 3
"""Number of traces: several short traces give a spread and, unlike one long trace, lose no events."""
WARM_UP = 5


def gpu_times(work: Callable[[], object], repeats: int, traces: int = TRACES) -> tuple[dict, Counter]:
    """Return the GPU time of a work [ms], the sum of its kernels' durations, with the spread of traces; and [us] by kernel."""
    from torch.profiler import ProfilerActivity, profile

    for _ in range(WARM_UP):
        work()
    torch.cuda.synchronize()
    totals, kernels, each = [], Counter(), max(1, repeats // traces)
    for _ in range(traces):
        with profile(activities=[ProfilerActivity.CUDA]) as trace:
            for _ in range(each):
                work()
            torch.cuda.synchronize()
        total = 0.0
        for event in trace.events():
            if event.device_type == torch.autograd.DeviceType.CUDA:
                total += event.device_time
                kernels[event.name] += event.device_time / (traces * each)
        totals.append(total / each / 1000)
    return {"median": round(statistics.median(totals), 4), "spread": [round(min(totals), 4), round(max(totals), 4)]}, kernels


def _set_aside() -> int:
    """Return the bytes that captured graphs hold and torch counts as free, in whole segments."""
    segments = [s for s in torch.cuda.memory_snapshot() if tuple(s["segment_pool_id"]) != (0, 0)]
    return sum(s["total_size"] - s["active_size"] for s in segments)


def peak_memory(work: Callable[[], object]) -> float:
    """Return the memory above what was loaded before [MiB]: torch's high-water mark, and that of Warp's pool where it grew.

    If ``work`` is captured as a graph, all memory reserved for graphs is added, which torch's mark does not include. It is
    counted in whole segments, which is an upper bound.
    """
    clear_graph_cache()
    gc.collect()
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    device = wp.device_from_torch(torch.device("cuda", torch.cuda.current_device()))
    loaded, pool, aside = torch.cuda.memory_allocated(), wp.get_mempool_used_mem_current(device), _set_aside()
    for _ in range(WARM_UP):
        work()
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    work()
    torch.cuda.synchronize()
    highest, warp_peak = torch.cuda.max_memory_allocated() - loaded, wp.get_mempool_used_mem_high(device) - pool
    unseen = max(0, _set_aside() - aside)
    clear_graph_cache()
    return (highest + unseen + max(0, warp_peak)) / 2**20
