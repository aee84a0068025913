"""Fits in worker processes: several at a time on one device, none started after a time limit, failures as results."""

from __future__ import annotations

import multiprocessing
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path

import torch

from bench.lib import result_file
from warpgs.errors import UsageError

Work = Callable[[object], dict]
Line = Callable[[dict], str]


def finished(
    work: Work, tasks: Sequence, jobs: int, seconds: float, first: Callable[[], object] | None = None
) -> Iterator[tuple[object, dict]]:
    """Yield each task with its result of ``work``, as they finish; ``{"error": ...}`` if ``work`` raised or the process died.

    No task begins after ``seconds``; ``first`` runs once before all, to compile kernels; give the longest tasks first.
    """
    began, waiting = time.monotonic(), deque(tasks)
    while waiting and time.monotonic() - began < seconds:
        with ProcessPoolExecutor(jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
            running: dict[Future, object] = {}
            broken = first is not None and _died(pool.submit(first))
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


def _died(started: Future) -> bool:
    """Return whether the worker died; raise what the function raised."""
    error = started.exception()
    if error is None or isinstance(error, BrokenProcessPool):
        return error is not None
    raise error


def stored_rows(path: Path | None) -> list[dict]:
    """Return the finished rows of a file, without failed rows; none if there is no file."""
    if path is None or not path.is_file():
        return []
    stored, now = result_file.read(path), result_file.commit_of()
    if stored["commit"] != now:
        raise UsageError(f"{path} was measured with commit {stored['commit']}, not {now}; choose another --out")
    return [row for row in stored["rows"] if "error" not in row]


def measure_all(work: Work, tasks: Sequence, first, a, what: str, device: torch.device, line: Line) -> list[dict]:
    """Run the tasks that a file lacks, write it after each, and return all rows."""
    rows, done = stored_rows(a.out), 0
    todo = [t for t in tasks if not any(t.key.items() <= row.items() for row in rows)]
    for task, figures in finished(work, todo, a.jobs, a.seconds, first):
        rows.append(task.key | {"jobs": a.jobs} | figures)
        done += 1
        failed = f"failed: {figures.get('error')}"
        print(f"{done}/{len(todo)}", *task.key.values(), line(rows[-1]) if "error" not in figures else failed, flush=True)
        result_file.keep(a.out, what, device, rows)
    if done < len(todo):
        left = len(todo) - done
        print(f"{left} fits did not begin, because --seconds {a.seconds:g} had passed; repeat the command for the rest")
    return rows
