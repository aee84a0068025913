"""The known name nearest to a mistyped one."""

import difflib
from collections.abc import Iterable

MAX_COMPARED = 60
"""Letters of a mistyped name that are compared."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return the question "did you mean ...?" for the nearest of the ``known`` names; empty if none is near."""
    plain = {name.lstrip("-"): name for name in known}  # dashes would make all short flags alike
    near = difflib.get_close_matches(word.lstrip("-")[:MAX_COMPARED], plain, 1)
    return f"did you mean {plain[near[0]]}?" if near else ""
