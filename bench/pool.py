"""Fits in worker processes: several at a time on one device, none begun after a time limit, failures as results."""

from __future__ import annotations

import multiprocessing
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool

Work = Callable[[object], dict]


def finished(
    work: Work, tasks: Sequence, jobs: int, seconds: float, first: Callable[[], object] | None = None
) -> Iterator[tuple[object, dict]]:
    """Yield each task with what ``work`` returned for it, as they finish; ``{"error": ...}`` where it raised or died.

    Args:
        work: Function of a module, called in a worker process.
        tasks: Its arguments, the longest first.
        jobs: Tasks at a time.
        seconds: After this long no further task is begun [s].
        first: Function of a module, called in one worker before any task begins: compiles kernels once for all.
    """
    began, waiting = time.monotonic(), deque(tasks)
    while waiting and time.monotonic() - began < seconds:
        with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
            running: dict[Future, object] = {}
            broken = first is not None and isinstance(pool.submit(first).exception(), BrokenProcessPool)
            first = None
            while not broken:
                while waiting and len(running) < jobs and time.monotonic() - began < seconds:
                    task = waiting.popleft()
                    running[pool.submit(work, task)] = task
                if not running:
                    break
                for future in wait(running, return_when=FIRST_COMPLETED).done:
                    error, task = future.exception(), running.pop(future)
                    broken |= isinstance(error, BrokenProcessPool)  # a worker died and took all others along
                    yield task, {"error": f"{type(error).__name__}: {error}"} if error else future.result()
            for future, task in running.items():
                yield task, {"error": f"{type(future.exception()).__name__}: {future.exception()}"}
