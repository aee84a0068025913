"""Folders for files that can be made again: the user's cache, or one that is private to this process and removed at its end."""

from __future__ import annotations

import atexit
import functools
import os
import sys
from pathlib import Path

from warpgs.errors import ResourceError
from warpgs.temporary import temporary_folder


def cache_home() -> Path | None:
    """Return the system's folder for a user's caches; None without a home folder.

    XDG_CACHE_HOME or ~/.cache, ~/Library/Caches on macOS, %LOCALAPPDATA% on Windows. Nothing is created.
    """
    try:
        home = Path.home()
    except (RuntimeError, KeyError):  # HOME is not set, and the system does not know this user
        home = Path("~")
    if sys.platform == "win32":
        found = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    elif sys.platform == "darwin":
        found = home / "Library" / "Caches"
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or "")
        # the XDG rules require relative paths to be ignored
        found = base if base.is_absolute() else home / ".cache"
    # an unknown or relative HOME results in a relative path, such as a folder named ~ in the current folder
    return found if found.is_absolute() else None


@functools.cache
def private_folder() -> Path:
    """Return a new folder that only this user can read or write (mode 0700), removed when Python ends; one for each process.

    Raises:
        ResourceError: No folder for temporary files can be written.
    """
    try:
        made = temporary_folder()
    except OSError as e:
        raise ResourceError(
            f"no folder for temporary files can be written ({e.strerror or e}). Set TMPDIR (TEMP on Windows) to a folder that "
            "you may write to"
        ) from e
    atexit.register(made.remove)
    return made.path
