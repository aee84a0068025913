"""Checks that a path lies below a folder once its links are resolved."""

from __future__ import annotations

import os
from pathlib import Path

from warpgs.errors import DataError


def inside(path: Path, root: Path, noun: str) -> Path:
    """Return a path after a check that no link in it points outside ``root``; ``noun`` is its name in messages.

    Raises:
        DataError: A link points outside.
    """
    if not is_below(path, root):
        raise DataError(f"{path}: a link points outside {noun}; put the files inside of it, or pass --allow-outside")
    return path


def is_below(path: Path, root: Path) -> bool:
    """Return True if a path is below ``root``, links followed; a circular link is not followed."""
    return Path(os.path.realpath(path)).is_relative_to(os.path.realpath(root))
