"""Temporary files and folders, each locked by its owner; any process may remove unlocked ones.

The system releases a lock when its holder ends, killed or not. So a temporary file of a running process is never removed as a
leftover, and the next command removes the files of a killed process.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import os
import re
import secrets
import stat
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

from filelock import lock_descriptor

from warpgs.output_folders import Folder, open_folder

NAMES = re.compile(r"\.?warpgs-[0-9a-f]{16}\.tmp(\.(mp4|webm|lock))?")
"""Names of temporary files, folders and their locks: short and ASCII, so that every file system accepts them."""
LOCKED = ".lock"
"""End of the name of the lock beside a temporary folder."""
NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL)
"""Errors of file systems without locks."""

_HELD: set[int] = set()
"""Descriptors of the locks of temporary folders of this process."""
_LOCK = threading.Lock()


@contextlib.contextmanager
def shared_locks() -> Iterator[tuple[int, ...]]:
    """Give descriptors of all locks of temporary folders, for a child process to inherit (``pass_fds``).

    The child may work in these folders. So the folders stay locked until it has ended, even if this process dies first.
    """
    with _LOCK:
        copies = tuple(map(os.dup, _HELD)) if sys.platform != "win32" else ()
    try:
        yield copies
    finally:
        for descriptor in copies:
            os.close(descriptor)


class TemporaryFile:
    """A new file that its owner locks, and removes at the end unless it was renamed; use it with ``with``."""

    def __init__(self, folder: Folder, suffix: str = ""):
        """Make the file.

        Args:
            folder: Open folder to make the file in.
            suffix: End of its name: none, .mp4 or .webm.

        Raises:
            OSError: The file cannot be made.
        """
        self._folder = folder
        self.name, self.descriptor = _own_file(folder, suffix, locks=sys.platform != "win32")
        self._open = True

    def __enter__(self) -> TemporaryFile:
        return self

    def __exit__(self, *_: object) -> None:
        if sys.platform == "win32":  # no open file is removed there; elsewhere the lock holds until it is gone
            self.close()
        try:
            with contextlib.suppress(OSError):  # no error is hidden: leftovers are recognised by name
                self._folder.unlink(self.name)
        finally:
            self.close()

    def close(self) -> None:
        """Close the file and release its lock; some file systems report a failed write only now."""
        if self._open:
            self._open = False
            os.close(self.descriptor)


class TemporaryFolder:
    """A new folder that its owner removes or renames; the lock beside it shows that the owner is running."""

    def __init__(self, above: Folder, prefix: str = ".warpgs-", mode: int = 0o777):
        """Make the folder.

        Args:
            above: Open folder to make the folder in; closed by `remove`.
            prefix: Beginning of its name.
            mode: Rights of the folder.

        Raises:
            OSError: The folder cannot be made.
        """
        self._above, self._process = above, os.getpid()
        lock, self._descriptor = _own_file(above, LOCKED, locks=True, prefix=prefix, mode=0o600)
        self.name = lock.removesuffix(LOCKED)
        self.path = above.path / self.name
        with _LOCK:
            _HELD.add(self._descriptor)
        try:
            above.mkdir(self.name, mode)
        except BaseException:
            self.remove()
            raise

    def __enter__(self) -> TemporaryFolder:
        return self

    def __exit__(self, *_: object) -> None:
        self.remove()

    def remove(self) -> None:
        """Remove the folder unless it was renamed, and then its lock; a forked child leaves both to its parent."""
        if os.getpid() != self._process or self._descriptor not in _HELD:
            return
        try:
            self._above.remove_tree(self.name)
        finally:
            with _LOCK:
                _HELD.discard(self._descriptor)
            try:
                _unlocked(self._above, self.name + LOCKED, self._descriptor)
            finally:
                self._above.close()


def temporary_folder() -> TemporaryFolder:
    """Make a folder that only this user can read or write, in the `system_folder`; use it with ``with``.

    Leftovers of killed commands of this user are removed there.

    Raises:
        OSError: No folder for temporary files is writable.
    """
    sweep_temporary_files()
    return TemporaryFolder(open_folder(system_folder()), "warpgs-", 0o700)


@functools.cache
def sweep_temporary_files() -> None:
    """Remove leftovers of killed commands of this user from the system's temporary files, once in each process."""
    with contextlib.suppress(OSError), open_folder(system_folder()) as folder:
        sweep(folder, own=True)


def system_folder() -> Path:
    """Return the first usable folder of TMPDIR, TEMP and TMP, else the system's temporary folder; set it in `tempfile`, too."""
    if tempfile.tempdir is None and sys.platform != "win32":
        # Python would write a file to try each of these, which a command that is killed then leaves behind
        named = [os.environ.get(name) for name in ("TMPDIR", "TEMP", "TMP")]
        usable = (f for f in (*named, "/tmp") if f and os.path.isdir(f) and os.access(f, os.W_OK | os.X_OK))
        tempfile.tempdir = next(map(os.path.abspath, usable), None)
    return Path(tempfile.gettempdir()).resolve()


def sweep(folder: Folder, own: bool = False) -> None:
    """Remove unlocked temporary files and folders; those that cannot be removed or locked stay.

    Args:
        folder: Folder to remove them from.
        own: True to remove only entries of this user.
    """
    with contextlib.suppress(OSError):
        for name in filter(NAMES.fullmatch, folder.names()):
            with contextlib.suppress(OSError):
                found = folder.lstat(name)
                if not own or not hasattr(os, "getuid") or found.st_uid == os.getuid():
                    _sweep_one(folder, name, found.st_mode)


def _sweep_one(folder: Folder, name: str, mode: int) -> None:
    """Remove one temporary entry that nobody has locked."""
    if stat.S_ISLNK(mode):
        folder.unlink(name)
    elif stat.S_ISDIR(mode) or name.endswith(LOCKED):
        lock = name.removesuffix(LOCKED) + LOCKED
        descriptor = folder.open_regular(lock, os.O_RDWR | os.O_CREAT)
        if not _locked(descriptor):
            os.close(descriptor)
            return
        try:
            folder.remove_tree(lock.removesuffix(LOCKED))
        finally:
            _unlocked(folder, lock, descriptor)
    elif stat.S_ISREG(mode):
        descriptor = folder.open_regular(name, os.O_RDWR)
        if sys.platform == "win32" or _locked(descriptor):  # Windows itself refuses to remove an open file
            _unlocked(folder, name, descriptor)
        else:
            os.close(descriptor)


def _own_file(folder: Folder, suffix: str, *, locks: bool, prefix: str = ".warpgs-", mode: int = 0o666) -> tuple[str, int]:
    """Make a file with a unique name and lock it; return name and descriptor."""
    while True:
        name = f"{prefix}{secrets.token_hex(8)}.tmp{suffix}"
        descriptor = folder.open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL, mode)
        try:
            if not locks or _owned(descriptor):
                return name, descriptor
        except BaseException:
            _unlocked(folder, name, descriptor)
            raise
        os.close(descriptor)  # another process found it before it was locked, and removes it


def _owned(descriptor: int) -> bool:
    """Lock a new file; return False where another process took it for a leftover just then."""
    try:
        return lock_descriptor(descriptor, blocking=False) and os.fstat(descriptor).st_nlink > 0
    except OSError as e:
        if e.errno in NO_LOCKS:  # other processes cannot lock it either, so none removes it
            return True
        raise


def _locked(descriptor: int) -> bool:
    """Lock a file; return False if it is held, or if locks do not work there."""
    try:
        return lock_descriptor(descriptor, blocking=False)
    except OSError:
        return False


def _unlocked(folder: Folder, name: str, descriptor: int) -> None:
    """Remove a locked file, and then release its lock; Windows removes no open file."""
    if sys.platform == "win32":
        os.close(descriptor)
    try:
        with contextlib.suppress(OSError):
            folder.unlink(name)
    finally:
        if sys.platform != "win32":
            os.close(descriptor)
