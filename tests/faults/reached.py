"""Lines of a reader that an input reaches, by which it is known whether an input gets past the first check."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import FrameType

import numpy as np

Line = tuple[str, int]
"""File and number of a line."""

LENGTHS = (0, 61, 4099)
"""Lengths of files of random bytes [bytes]: primes, which no format with records of even length takes."""
SEEDS = (0, 1)


class Reached:
    """Trace of the lines of some files that run in a block, in this thread."""

    def __init__(self, lines: dict[str, set[int]]):
        """Trace these lines, by file."""
        self._wanted = lines
        self._seen: set[Line] = set()

    def __enter__(self) -> Reached:
        self._before = sys.gettrace()
        self._seen.clear()
        sys.settrace(self._called)
        return self

    def __exit__(self, *_: object) -> None:
        sys.settrace(self._before)

    def _called(self, frame: FrameType, event: str, argument: object) -> Callable | None:
        return self._ran if frame.f_code.co_filename in self._wanted else None

    def _ran(self, frame: FrameType, event: str, argument: object) -> Callable:
        self._seen.add((frame.f_code.co_filename, frame.f_lineno))
        return self._ran

    def lines(self) -> set[Line]:
        """Return the lines that ran in the last block."""
        return {(f, n) for f, n in self._seen if n in self._wanted[f]}


def garbage() -> list[bytes]:
    """Return files that no reader can mean anything by: an empty one, and random bytes."""
    return [np.random.default_rng(seed).bytes(n) for seed in SEEDS for n in LENGTHS if n or not seed]
