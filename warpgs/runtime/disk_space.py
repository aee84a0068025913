"""Detection of full disks, from the error output of a failed process or from the free space."""

from __future__ import annotations

import errno
import os
import shutil
from pathlib import Path

from warpgs.files import FULL

WORDS = (*map(os.strerror, FULL), "disk is full", f"[Errno {errno.ENOSPC}]", f"[Errno {errno.EDQUOT}]")
"""Parts of the messages that systems, SQLite and Python give for a full disk."""
MIN_FREE = 2**16
"""Free space below which a disk counts as full [bytes]: some libraries fail without naming the full disk."""


def disk_is_full(folder: Path, said: str) -> bool:
    """Return whether a process failed because the disk of a folder that it wrote into is full.

    Args:
        folder: The folder.
        said: What the process wrote to stderr.
    """
    if any(words in said for words in WORDS):
        return True
    try:
        return shutil.disk_usage(folder).free < MIN_FREE
    except OSError:
        return False
