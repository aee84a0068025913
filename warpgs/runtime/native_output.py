"""Output of this process, including native libraries: hidden where it would confuse the user, or redirected."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator

from warpgs.runtime.output_streams import open_missing_descriptors


@contextlib.contextmanager
def hidden_stderr() -> Iterator[None]:
    """Hide the output to stderr in the block, also that of native libraries and other threads."""
    open_missing_descriptors()
    _flush(2)
    saved, sink = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    os.dup2(sink, 2)
    try:
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)
        os.close(sink)


@contextlib.contextmanager
def output_to(descriptor: int) -> Iterator[None]:
    """Send stdout and stderr in the block to an open file, also for native libraries and other threads."""
    open_missing_descriptors()
    _flush(1, 2)
    saved = [os.dup(number) for number in (1, 2)]
    try:
        for number in (1, 2):
            os.dup2(descriptor, number)
        yield
    finally:
        _flush(1, 2)
        for number, old in zip((1, 2), saved, strict=True):
            os.dup2(old, number)
            os.close(old)


def _flush(*numbers: int) -> None:
    """Flush stdout (1) or stderr (2), if there is one and it can be written."""
    for number in numbers:
        stream = (sys.stdout, sys.stderr)[number - 1]
        if stream is not None:
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
