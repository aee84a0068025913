"""The folder of compiled kernels: Warp's default, if this user and no other can write to it; else a private folder.

Warp runs the kernels that it finds there, so anyone with write access can run code as this user.
"""

from __future__ import annotations

import functools
import os
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

from warpgs.errors import ResourceError
from warpgs.runtime.folders import cache_home, private_folder
from warpgs.runtime.permissions import open_to_others
from warpgs.runtime.terminal import say

REMEDY = "Set WARP_CACHE_PATH to a folder of your own to keep compiled kernels"


class KernelCache(NamedTuple):
    """Folder of compiled kernels."""

    folder: Path
    """Folder, without the subfolder that names Warp's version."""
    refused: str
    """Reason why the usual folder is not used; empty if it is used."""


@functools.cache
def prepare_kernel_cache() -> KernelCache:
    """Choose the folder, and set it in Warp's settings before `wp.init`; print a line on stderr if the folder is private.

    Raises:
        ResourceError: There is no writable folder.
    """
    import warp

    chosen = choose_kernel_cache(warp.config.kernel_cache_dir)
    if chosen.refused:
        say(
            f"warpgs: {chosen.refused}; kernels are compiled into {chosen.folder} for this process only, which takes a "
            f"minute or two. {REMEDY}",
            error=True,
        )
    if chosen.refused or warp.config.kernel_cache_dir is None:
        warp.config.kernel_cache_dir = str(chosen.folder)
    return chosen


def choose_kernel_cache(configured: str | None = None) -> KernelCache:
    """Choose ``configured``, else WARP_CACHE_PATH, else Warp's default; a private folder if the chosen one is unusable.

    Args:
        configured: Value of ``warp.config.kernel_cache_dir``: set by the user's program, or by Warp once started.

    Raises:
        ResourceError: Neither the usual nor the private folder can be written.
    """
    folder, refused = _usual(configured)
    if folder is not None:
        refused = _fault(folder)
        if not refused:
            return KernelCache(folder, "")
    try:
        own = private_folder() / "kernels"
        own.mkdir(exist_ok=True)
        return KernelCache(own, refused)
    except (ResourceError, OSError) as e:
        raise ResourceError(f"no folder for compiled kernels can be written: {refused}, and {e}. {REMEDY}") from e


def _usual(configured: str | None) -> tuple[Path | None, str]:
    """Return the requested folder or Warp's default; or None, and the reason."""
    asked = configured or os.environ.get("WARP_CACHE_PATH")
    if asked:
        folder = Path(os.path.expanduser(asked))  # as a shell does, but not within quotes
        if asked.startswith("~") and not folder.is_absolute():
            return None, f"the kernel cache {asked} is in an unknown home folder"
        return folder.resolve(), ""
    home = cache_home()
    if home is None:
        return None, "no home folder for a kernel cache"
    # where Warp's appdirs would put it; Warp adds its version
    return home.joinpath(*(("NVIDIA", "warp", "Cache") if sys.platform == "win32" else ("warp",))).resolve(), ""


def _fault(folder: Path) -> str:
    """Return why a folder cannot be used, or an empty text if it can; a missing folder is made."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as f:
            f.write(b"0")
            f.flush()
        others = open_to_others(folder, depth=3)  # its versions, the modules in them, and their files
    except OSError as e:
        return f"the kernel cache {folder} cannot be written ({e.strerror or e})"
    return f"the kernel cache {folder} is not safe: other users can write to {others}" if others else ""
