"""Timing: warm-up, then repeats of all programs in turn; median and quartiles, one row per task.

Compared programs run in turn, one repeat each, so that other load on the machine affects all of them alike. Only programs far
slower than the others run after them.
"""

from __future__ import annotations

import gc
import math
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import psutil
import torch
import warp as wp

from bench.lib.roofline import Cost

REPEATS = 30
WARM_UP = 3
WARM_UP_SECONDS = 0.1
"""Duration of the warm-up of short work [s], so that clocks and caches settle."""

OURS = "warpgs"
APART = 30
"""A program this many times slower than another one runs after it instead of in turn. Pairing does not improve such a ratio,
and a long run was seen to make a short one after it several times slower, through caches and freed memory."""
DISTURBED = 0.2
"""Number of cores used by other programs above which a measurement counts as disturbed."""
IN_WARP = (OURS, "naive")
"""Programs whose scratch memory comes from Warp's pool."""


@dataclass(frozen=True)
class Task:
    """One thing to time, inputs loaded."""

    program: str
    """Name of the program: warpgs, or a peer."""
    direction: str
    """forward, backward, both (one after the other) or step."""
    run: Callable[[], object]
    cost: Cost | None = None
    """Least bytes and operations of the task; None if unknown."""
    facts: dict = field(default_factory=dict)
    """Other entries of the row, such as the number of instances."""


def _drain(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def _timed(work: Callable[[], object], device: torch.device) -> tuple[float, float | None]:
    """Return wall time and, on CUDA, GPU time of one call [ms].

    Wall time runs from an idle device to an idle device. GPU time runs between two events around the call, so it leaves
    out the host's work before the first and after the last kernel, but not the gaps in between.
    """
    _drain(device)
    events = [torch.cuda.Event(enable_timing=True) for _ in range(2)] if device.type == "cuda" else []
    begin = time.perf_counter()
    if events:
        events[0].record()
    work()
    if events:
        events[1].record()
    _drain(device)
    wall = 1000 * (time.perf_counter() - begin)
    return wall, events[0].elapsed_time(events[1]) if events else None


def _warm_up(work: Callable[[], object], device: torch.device, limit_ms: float, whole: bool) -> float:
    """Run work `WARM_UP` times, or if ``whole`` at least for `WARM_UP_SECONDS`; return the shortest time of a call [ms].

    Stops after the second call if both took longer than the limit.
    """
    begin, times = time.perf_counter(), []
    while len(times) < WARM_UP or (whole and time.perf_counter() - begin < WARM_UP_SECONDS):
        times.append(_timed(work, device)[0])
        if len(times) > 1 and min(times) > limit_ms:
            break
    return min(times)


def others_seconds() -> float | None:
    """Return the CPU time of all other processes since the machine started [s]; None if unknown."""
    try:
        times = psutil.cpu_times()
    except (OSError, RuntimeError):
        return None
    busy = sum(getattr(times, name, 0.0) for name in ("user", "nice", "system", "irq", "softirq", "steal"))
    return busy - time.process_time()


def measure_in_turn(
    works: Sequence[Callable[[], object]],
    device: torch.device,
    repeats: int = REPEATS,
    limit_ms: float = math.inf,
) -> list[dict]:
    """Return median, quartiles and minimum of each work's wall time [ms], and on CUDA the median of its GPU time [ms].

    A work that takes longer than ``limit_ms`` in the warm-up is not timed: its row has ``warm_up_ms`` only. ``others_cores`` is
    the number of cores that other programs used at the same time.
    """
    begin, before = time.perf_counter(), others_seconds()
    shortest = [_warm_up(work, device, limit_ms, repeats >= REPEATS) for work in works]
    gc.collect()
    gc.freeze()  # so that later collections are short
    samples = [[] for _ in works]
    in_turn = [i for i, least in enumerate(shortest) if least <= limit_ms]
    apart = [i for i in in_turn if shortest[i] > APART * min(shortest)]
    for group in ([i for i in in_turn if i not in apart], *([i] for i in apart)):
        for _ in range(repeats):
            for i in group:
                gc.collect()  # memory that a program leaves in reference cycles is freed before the next one begins
                samples[i].append(_timed(works[i], device))
    gc.unfreeze()
    rows = []
    for own, least in zip(samples, shortest):
        if not own:
            rows.append({"warm_up_ms": least})
            continue
        low, middle, high = statistics.quantiles([wall for wall, _ in own], n=4)
        row = {"median_ms": round(middle, 4), "quartiles_ms": [round(low, 4), round(high, 4)]}
        row |= {"least_ms": round(min(wall for wall, _ in own), 4), "repeats": repeats}
        if device.type == "cuda":
            row["gpu_ms"] = round(statistics.median(gpu for _, gpu in own), 4)
        rows.append(row)
    if before is not None:
        used, wall = others_seconds() - before, time.perf_counter() - begin
        # the clock ticks every 10 ms: less than a few ticks are no evidence
        cores = round(max(0.0, used) / wall, 2) if used > 0.05 else 0.0
        rows = [row | {"others_cores": cores} for row in rows]
    return rows


def measure(work: Callable[[], object], device: torch.device, repeats: int = REPEATS) -> dict:
    """Return the figures of `measure_in_turn` for a single work."""
    return measure_in_turn([work], device, repeats)[0]


def peak_bytes(task: Task, device: torch.device) -> int:
    """Return the device memory of one run in addition to the loaded inputs, on CUDA [bytes].

    It is the sum of two values. Torch's allocator keeps an exact high-water mark, which is reset before the run; peers allocate
    only there. Warp's pool serves the sorts, and keeps their scratch memory for the next call. The pool's mark cannot be reset,
    so its whole size after the run counts for programs that use it. This is an upper bound, since a larger earlier call may
    have enlarged the pool. Context and compiled kernels are not included. Sampling the free memory in a thread instead would
    show blocks that the allocators keep, 2 to 20 MiB each, and would miss short peaks.
    """
    gc.collect()
    _drain(device)
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device)
    result = task.run()
    _drain(device)
    peak = torch.cuda.max_memory_allocated(device) - before
    del result
    pool = wp.device_from_torch(device)
    if task.program in IN_WARP and wp.is_mempool_enabled(pool):
        peak += wp.get_mempool_used_mem_current(pool)
    return peak


def backward_of(outputs: torch.Tensor, inputs: Sequence[torch.Tensor]) -> Callable[[], object]:
    """Return the work that runs the backward pass of ``outputs`` for a fixed random upstream gradient."""
    upstream = torch.rand_like(outputs)
    return lambda: torch.autograd.grad(outputs, inputs, upstream, retain_graph=True)


def passes(
    program: str,
    forward: Callable[[], torch.Tensor],
    inputs: Sequence[torch.Tensor],
    wanted: Callable[[str, str], bool],
    costs: tuple[Cost | None, Cost | None] = (None, None),
    facts: dict | None = None,
) -> Iterator[Task]:
    """Yield the forward and backward tasks of a differentiable function, if they are wanted."""
    if wanted(program, "forward"):
        yield Task(program, "forward", forward, costs[0], facts or {})
    if wanted(program, "backward"):
        yield Task(program, "backward", backward_of(forward(), inputs), costs[1], facts or {})
