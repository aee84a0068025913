"""What a reader may take of time and memory, and which of its lines ran."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import numpy as np

# Bounds of one input: processor time, wall time as a backstop, and memory beyond the result.

LIMIT = 15.0
"""Processor time that one input may take [s], child processes included. On a slow core, 10,000 sound cameras take 5 s."""
WALL = 60.0
"""Wall time after which an input counts as a hang that takes no processor time [s], such as a read of a pipe."""
MEMORY = 64 * 2**20
"""Memory that a reader may take beyond its result, whatever the file [bytes]."""
ADDRESS_SPACE = 4 * 2**30
"""Address space that a process may take beyond what it has when it begins [bytes]."""
ALLOCATOR = {"MALLOC_MMAP_THRESHOLD_": str(2**18), "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
"""Environment of a process that is measured: glibc returns large blocks at once, so that each input's growth is seen."""


class Hang(BaseException):
    """An input that takes longer than `LIMIT` or `WALL`."""


def spent() -> float:
    """Return the processor time of this process and of its ended children [s]."""
    t = os.times()
    return time.process_time() + t.children_user + t.children_system


@contextlib.contextmanager
def time_limit(on: bool) -> Iterator[None]:
    """Raise `Hang` in the body once it has taken too long, where the system can."""
    timers = {"ITIMER_PROF": LIMIT, "ITIMER_REAL": WALL} if on and hasattr(signal, "setitimer") else {}
    try:
        for name, seconds in timers.items():
            signal.setitimer(getattr(signal, name), seconds)
        yield
    finally:
        for name in timers:
            signal.setitimer(getattr(signal, name), 0)


def bound_process() -> None:
    """Bound the memory of this process, and silence decoders, where the system can."""
    with open(os.devnull, "w") as nothing:
        os.dup2(nothing.fileno(), 2)
    if sys.platform == "linux":
        import resource

        import psutil

        limit = psutil.Process().memory_info().vms + ADDRESS_SPACE
        resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    catch_timers()


def catch_timers() -> None:
    def late(*_: object) -> None:
        raise Hang

    if hasattr(signal, "setitimer"):
        signal.signal(signal.SIGPROF, late)
        signal.signal(signal.SIGALRM, late)


class PeakMemory:
    """Largest memory of this process since it was made; 0 everywhere on systems other than Linux."""

    def __init__(self):
        """Forget the peak of what came before."""
        if sys.platform == "linux":
            with contextlib.suppress(OSError):  # then growth beyond the largest before is seen, and no other
                Path("/proc/self/clear_refs").write_text("5")
        self._before = self._peak()

    @staticmethod
    def _peak() -> int:
        if sys.platform != "linux":
            return 0
        lines = Path("/proc/self/status").read_text().splitlines()
        return 1024 * int(next(line for line in lines if line.startswith("VmHWM")).split()[1])

    def grown(self) -> int:
        """Return the growth of the peak [bytes]."""
        return self._peak() - self._before


def size_of(result: object) -> int:
    """Return the memory that a decoded result holds [bytes]: arrays, tensors, bytes, text, containers and objects of ours."""
    import torch

    total, seen, stack = 0, set(), [result]
    while stack:
        value = stack.pop()
        if id(value) in seen or isinstance(value, type):
            continue
        seen.add(id(value))
        if isinstance(value, np.ndarray):
            total += value.nbytes
        elif isinstance(value, torch.Tensor):
            total += value.numel() * value.element_size()
        else:
            total += sys.getsizeof(value, 0)
            if isinstance(value, dict):
                stack += [*value.keys(), *value.values()]
            elif isinstance(value, (list, tuple, set, frozenset)):
                stack += value
            elif type(value).__module__.startswith("warpgs"):
                stack += vars(value).values() if hasattr(value, "__dict__") else ()
    return total


# Lines of a reader that an input reaches, by which it is known whether an input gets past the first check.

Line = tuple[str, int]
"""File and number of a line."""

LENGTHS = (0, 61, 4099)
"""Lengths of files of random bytes [bytes]: primes, which no format with records of even length takes."""
SEEDS = (0, 1)


class Reached:
    """Trace of the lines of some files that run in a block, in this thread and those that it starts."""

    def __init__(self, lines: dict[str, set[int]]):
        """Trace these lines, by file."""
        self._wanted = lines
        self._seen: set[Line] = set()

    def __enter__(self) -> Reached:
        self._before = sys.gettrace(), threading.gettrace()
        self._seen.clear()
        sys.settrace(self._called)
        threading.settrace(self._called)
        return self

    def __exit__(self, *_: object) -> None:
        here, started = self._before
        sys.settrace(here)
        threading.settrace(started)  # type: ignore[arg-type]  # None for no trace

    def _called(self, frame: FrameType, event: str, argument: object) -> Callable | None:
        return self._ran if frame.f_code.co_filename in self._wanted else None

    def _ran(self, frame: FrameType, event: str, argument: object) -> Callable:
        self._seen.add((frame.f_code.co_filename, frame.f_lineno))
        return self._ran

    def lines(self) -> set[Line]:
        return {(f, n) for f, n in self._seen if n in self._wanted[f]}


def garbage() -> list[bytes]:
    """Return files that no reader can mean anything by: an empty one, and random bytes."""
    return [np.random.default_rng(seed).bytes(n) for seed in SEEDS for n in LENGTHS if n or not seed]
