"""A private folder that the machines of a cluster share, in which a farm and its jobs exchange trusted files."""

from __future__ import annotations

import contextlib
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from warpgs.errors import ResourceError, UsageError
from warpgs.runtime.folders import cache_home
from warpgs.runtime.permissions import open_to_others

LOCK = "lock"
WAIT_FOR_OTHERS = 60.0
"""Longest wait while another farm makes its own folder [s]."""


@contextlib.contextmanager
def private_shared_folder(base: Path | None) -> Iterator[Path]:
    """Make a new folder with a random name that only this user can enter (mode 0700), and remove it after the block.

    Folders of killed farms, whose locks are free, are removed as well.

    Args:
        base: Parent of the new folder; None for ``warpgs/slurm`` in the user's cache.

    Raises:
        ResourceError: The folder cannot be written or locked.
        UsageError: There is no home folder, or other users can write to ``base`` or to a folder above it.
    """
    home = cache_home()
    if base is None and home is None:
        raise UsageError("--engine slurm needs a home folder for its job files; name another folder with --slurm-folder")
    base = (base or home / "warpgs" / "slurm").absolute()
    try:
        base.mkdir(mode=0o700, parents=True, exist_ok=True)
        base = base.resolve()
        others = open_to_others(base)
        if others is not None:
            raise UsageError(
                f"{base}: not safe for Slurm's job files: other users can write to {others} and could run code as you; "
                "name a private folder that all nodes see with --slurm-folder"
            )
        with FileLock(base / LOCK, timeout=WAIT_FOR_OTHERS, mode=0o600):  # no other farm is between making and locking its own
            _sweep(base)
            made = Path(tempfile.mkdtemp(dir=base))
            lock = FileLock(made / LOCK, mode=0o600)
            lock.acquire()
    except (OSError, NotImplementedError, Timeout) as e:
        raise ResourceError(
            f"{base}: Slurm's job files cannot be written ({getattr(e, 'strerror', None) or e}); name another private folder "
            "that all nodes see with --slurm-folder"
        ) from e
    try:
        yield made
    finally:
        lock.release()
        shutil.rmtree(made, ignore_errors=True)


def _sweep(base: Path) -> None:
    """Remove the folders of farms that have ended."""
    for old in base.iterdir():
        if old.is_dir() and not old.is_symlink():
            try:
                with FileLock(old / LOCK, blocking=False):
                    pass
            except Timeout:
                continue
            shutil.rmtree(old, ignore_errors=True)
