"""The clock of a fit: where the wall time of its process goes."""

import contextlib
import math
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

FIRST_LINE = time.perf_counter()
"""Time when the command line imported this module, before anything large."""
STARTUP = 3.0
"""Longest time from the start of a process to the first line [s]. A process that is older was a shell before it was warpgs."""


class Clock:
    """Wall time of one thread by section, without gaps: the innermost open section counts, ``other`` outside of all.

    Nothing waits for the device: work that a section only queued counts where its results are read.
    """

    def __init__(self, before: float = 0.0, now: Callable[[], float] = time.perf_counter):
        """Start; ``before`` is the time that already passed, for imports [s]."""
        self._now, self._times, self._open = now, {"import": before} if before else {}, ["other"]
        self._since = now()

    def _lap(self) -> None:
        """Give the time since the last change to the innermost open section."""
        now, name = self._now(), self._open[-1]
        self._times[name] = self._times.get(name, 0.0) + now - self._since
        self._since = now

    @contextlib.contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        """Count the body as a section, and not as the section around it."""
        self._lap()
        self._times.setdefault(name, 0.0)  # in the order in which they begin
        self._open.append(name)
        try:
            yield
        finally:
            self._lap()
            self._open.pop()

    def seconds(self) -> dict[str, float]:
        """Return the time of each section up to now, then that of no section (``other``), and their sum (``total``) [s]."""
        self._lap()
        times = {name: s for name, s in self._times.items() if name != "other"} | {"other": self._times.get("other", 0.0)}
        return times | {"total": sum(times.values())}


class _Running(threading.local):
    clock: Clock | None = None


_RUNNING = _Running()


@contextlib.contextmanager
def timed(clock: Clock | None = None) -> Iterator[Clock]:
    """Yield the clock of this thread: the one that runs, else ``clock`` or a new one, which runs until the block ends."""
    before = _RUNNING.clock
    _RUNNING.clock = running = before or clock or Clock()
    try:
        yield running
    finally:
        _RUNNING.clock = before


def section(name: str) -> contextlib.AbstractContextManager[None]:
    """Count the block as a section of this thread's clock, if one runs."""
    return contextlib.nullcontext() if _RUNNING.clock is None else _RUNNING.clock(name)


def _age() -> float:
    """Return the time since the start of this process [s]; NaN where the system does not tell."""
    with contextlib.suppress(OSError, ValueError, IndexError, AttributeError):
        ticks = int(Path("/proc/self/stat").read_text("utf-8", "replace").rpartition(")")[2].split()[19])
        return time.clock_gettime(time.CLOCK_BOOTTIME) - ticks / os.sysconf("SC_CLK_TCK")
    return math.nan


def since_start(now: Callable[[], float] = time.perf_counter) -> float:
    """Return the time since the start of this process [s], or since the first line if the start is unknown."""
    here, age = now() - FIRST_LINE, _age()
    return age if here <= age <= here + STARTUP else here


def _parts(times: dict[str, float]) -> dict[str, float]:
    return {name: s for name, s in times.items() if name != "total"}


def largest(times: dict[str, float], count: int = 3) -> str:
    """Return the largest parts of `Clock.seconds` in words, those of all phases as one."""
    parts: dict[str, float] = {}
    for name, s in _parts(times).items():
        parts[name.partition(" (")[0]] = parts.get(name.partition(" (")[0], 0.0) + s
    return ", ".join(f"{name} {s:.0f} s" for name, s in sorted(parts.items(), key=lambda p: -p[1])[:count])


def times_line(times: dict[str, float]) -> str:
    """Return all parts of `Clock.seconds` as one line for the report."""
    parts = ", ".join(f"{name} {s:.2f} s" for name, s in _parts(times).items())
    return f"wall time until this page was written: {times['total']:.2f} s: {parts}"
