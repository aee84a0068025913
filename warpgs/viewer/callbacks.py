"""Callbacks of the viewer's controls: they report an error in one line, where viser would print a traceback."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

from warpgs.errors import WarpgsError
from warpgs.runtime.terminal import say


def said(error: BaseException) -> str:
    """Return an error as one line, shortened; with its type unless it is a `WarpgsError`."""
    line = (str(error).strip().splitlines() or [""])[0][:200]
    return line if isinstance(error, WarpgsError) else f"{type(error).__name__}: {line}"


def guarded(callback: Callable[..., Any]) -> Callable[..., None]:
    """Wrap a callback: if it raises an error, print one line on stderr."""

    @functools.wraps(callback)
    def call(*args: Any) -> None:
        try:
            callback(*args)
        except Exception as e:  # any error of a browser's request; the viewer continues
            say(f"the viewer could not serve a request of a browser ({said(e)})", error=True)

    return call
