"""Ctrl-C, SIGTERM and SIGHUP end the program in the same way; signals that it was started to ignore stay ignored."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from typing import Any

STOPPING = tuple(s for n in ("SIGINT", "SIGTERM", "SIGHUP") if (s := getattr(signal, n, None)))  # Windows has no SIGHUP
AGAIN = 0.05
"""Time after which a signal that Python discarded is sent again [s]."""


def _heeded() -> list[signal.Signals]:
    """Return the signals that end this process, without those that it was started to ignore (by nohup, or in the background).

    The list is empty in other threads than the main thread, which alone may handle signals.
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


def _send(number: signal.Signals) -> None:
    """Send a signal to the main thread, and wake the thread where the system can do that."""
    if sys.platform == "win32":
        signal.raise_signal(number)
    else:
        main = threading.main_thread().ident
        assert main is not None
        signal.pthread_kill(main, number)


@contextlib.contextmanager
def interrupting_signals() -> Iterator[None]:
    """Raise KeyboardInterrupt in the body when a signal comes.

    Python discards an exception that is raised in a destructor or in a callback of a weak reference. A signal that comes there
    is sent again.
    """
    before = sys.unraisablehook

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    def unraisable(thrown: sys.UnraisableHookArgs) -> None:
        if thrown.exc_type is not KeyboardInterrupt:
            before(thrown)
        elif numbers:  # from a thread: a signal sent here would interrupt this function
            timers.append(threading.Timer(AGAIN, _send, numbers[:1]))
            timers[-1].daemon = True
            timers[-1].start()

    numbers, timers = _heeded(), list[threading.Timer]()
    sys.unraisablehook = unraisable
    try:
        with _handled(interrupt):
            yield
    finally:
        for timer in timers:
            timer.cancel()
        sys.unraisablehook = before


@contextlib.contextmanager
def noted_signals() -> Iterator[Callable[[], bool]]:
    """Note the first signal, so that the body can end normally; a second one raises KeyboardInterrupt in the body.

    Yields a function that returns whether a signal came.
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
    """Drop signals while the body prints the last lines of a program that is already ending."""
    with _handled(signal.SIG_IGN):
        yield
