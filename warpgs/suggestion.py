"""Suggestions in messages: the known name nearest to a mistyped one, and how to install an extra."""

import difflib
import os
from collections.abc import Iterable
from pathlib import Path

MAX_COMPARED = 60
"""Letters of a mistyped name that are compared."""


def did_you_mean(word: str, known: Iterable[str]) -> str:
    """Return the question "did you mean ...?" for the nearest of the ``known`` names; empty if none is near."""
    plain = {name.lstrip("-"): name for name in known}  # dashes would make all short flags alike
    near = difflib.get_close_matches(word.lstrip("-")[:MAX_COMPARED], plain, 1)
    return f"did you mean {plain[near[0]]}?" if near else ""


def similar_folder(path: Path) -> str:
    """Return `did_you_mean` for the name of a missing folder among the folders beside it."""
    try:
        with os.scandir(path.parent) as entries:
            return did_you_mean(path.name, [e.name for e in entries if e.is_dir()])
    except OSError:  # without the folder around it there is nothing to suggest
        return ""


def install_extras(*names: str) -> str:
    """Return the words on how to install extras: from the repository, since warpgs is on no package index."""
    return f"`pip install '.[{','.join(names)}]'` in your copy of the repository"
