"""Ctrl-C and SIGTERM: both end the program in the same way, wherever they come. A process that ignores one goes on to."""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from typing import Any

STOPPING = (signal.SIGINT, signal.SIGTERM)


def _heeded() -> list[signal.Signals]:
    """Return the signals that end this process: none that it was started to ignore (nohup, a shell's job in the background).

    Only the main thread may handle signals; in another one they act as ever.
    """
    if threading.current_thread() is not threading.main_thread():
        return []
    return [s for s in STOPPING if signal.getsignal(s) not in (signal.SIG_IGN, None)]


@contextlib.contextmanager
def _handled(handler: Callable[..., Any] | signal.Handlers) -> Iterator[None]:
    """Handle the signals by a function while the body runs."""
    before = {s: signal.signal(s, handler) for s in _heeded()}
    try:
        yield
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def _interrupt(*_: object) -> None:
    raise KeyboardInterrupt


@contextlib.contextmanager
def interrupting_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt in the body when a signal comes."""
    with _handled(_interrupt):
        yield


@contextlib.contextmanager
def noted_signals() -> Iterator[Callable[[], bool]]:
    """Note the first signal, so that the body can end in good order; a second one raises KeyboardInterrupt in it.

    Gives a function that says whether one came.
    """
    came = False

    def note(*_: object) -> None:
        nonlocal came
        if came:
            raise KeyboardInterrupt
        came = True

    with _handled(note):
        yield lambda: came


@contextlib.contextmanager
def ignored_signals() -> Iterator[None]:
    """Let signals pass while the body says the last words of a program that they end already."""
    with _handled(signal.SIG_IGN):
        yield
