"""Lines for the user on the terminal, without control characters from names of files, folders or images."""

from __future__ import annotations

import sys
import unicodedata
from collections.abc import Callable, Iterator, Sequence
from typing import TypeVar

from warpgs.files import readable
from warpgs.runtime.output_streams import say_lost

T = TypeVar("T")

HIDDEN = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Categories of characters that move the cursor, change the direction of text, end a line, or are surrogates."""
JOINERS = "\u200c\u200d"
"""Exceptions to `HIDDEN` that scripts and emoji need; they affect only adjacent letters."""


class Detail(str):
    """A note that needs no action: it goes to the files of a run and the last section of its report, not to the terminal."""

    __slots__ = ()


def printable(text: object) -> str:
    """Return text with codes in place of control characters, such as ESC, and of bytes that are not text."""
    return "".join(
        c.encode("unicode_escape").decode() if unicodedata.category(c) in HIDDEN and c not in JOINERS else c
        for c in readable(str(text))
    )


_quiet = False
_lost = False


def be_quiet() -> None:
    """Print only errors from now on, since another process prints the same lines."""
    global _quiet
    _quiet = True


def say(line: object = "", *, error: bool = False) -> None:
    """Print one `printable` line at once, with codes for letters that the terminal does not have.

    If stdout cannot be written, one line on stderr reports that, and the program continues.

    Args:
        line: The line.
        error: True to print on stderr instead of stdout.
    """
    global _lost
    if _quiet and not error:
        return
    try:
        _print(line, error)
    except OSError as e:
        if not (error or _lost):
            _lost = True
            say_lost("stdout", e)


def answer(line: object) -> None:
    """Print one line to the process that started this one.

    Raises:
        OSError: The other process has ended, so the answer is not needed.
    """
    _print(line, False)


def _print(line: object, error: bool) -> None:
    """Print one line as `say` does."""
    stream = sys.stderr if error else sys.stdout
    encoding = getattr(stream, "encoding", None) or "utf-8"
    print(printable(line).encode(encoding, "backslashreplace").decode(encoding), file=stream, flush=True)


def counted(items: Sequence[T], tell: Callable[[str], object], what: str, unit: str) -> Iterator[T]:
    """Yield items; before each item, print how many are done: ``scoring: 3 of 12 views``.

    Args:
        items: The items.
        tell: Function that takes a line.
        what: Name of the work on the items.
        unit: Plural word for the items.
    """
    for done, item in enumerate(items):
        tell(f"{what}: {done} of {len(items)} {unit}")
        yield item


def accept_all_letters() -> None:
    """Print codes for letters that the terminal does not have, also in the output of other libraries to stdout and stderr."""
    for stream in (sys.stdout, sys.stderr):
        reconfigure = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(errors="backslashreplace")
