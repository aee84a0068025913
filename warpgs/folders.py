"""Folders: results, temporary folders and caches, where no link leads elsewhere."""

from __future__ import annotations

import atexit
import contextlib
import errno
import functools
import os
import re
import secrets
import shutil
import stat
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from filelock import lock_descriptor

from warpgs.errors import ResourceError

# Folders that this process writes into: the folder that the user names may be a link; below it no link is followed.
#
# `output_folder` opens such a folder for a block. Everything below it is then reached from its descriptor, folder by
# folder, without following links, so that no other program can redirect a write or a read. Below nested open folders, a
# path is followed from the outermost one. Windows has no descriptors of folders: there each part of a path is checked
# for links before it is used.

WINDOWS = sys.platform == "win32"
NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
PLAIN = NO_FOLLOW | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)
FOLDER = os.O_RDONLY | getattr(os, "O_DIRECTORY", 0) | getattr(os, "O_CLOEXEC", 0)
SEARCHED = getattr(os, "O_PATH", 0) | getattr(os, "O_DIRECTORY", 0) | getattr(os, "O_CLOEXEC", 0)
"""Flags that open a folder which may be written and entered, but not listed."""
NO_FOLDER_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EACCES)
"""Errors of file systems that cannot sync a folder."""


class RefusedError(OSError):
    """A path that is rejected: a link, not a regular file, or a folder that was replaced; the message contains the fix."""

    def __init__(self, message: str):
        """Take the whole message."""
        super().__init__(errno.ELOOP, message)

    def __str__(self) -> str:
        return self.strerror


class Folder:
    """An open folder, whose entries are used by name without following links; a context manager that closes it."""

    def __init__(self, path: Path, descriptor: int | None):
        """Take the path of the folder and its descriptor, None where the system has no descriptors of folders."""
        self.path, self.descriptor, self.blocks = path, descriptor, 0
        status = os.stat(path) if descriptor is None else os.fstat(descriptor)
        self.identity = status.st_dev, status.st_ino

    def __enter__(self) -> Folder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the descriptor."""
        if self.descriptor is not None:
            os.close(self.descriptor)

    def _name(self, name: str) -> str:
        return name if self.descriptor is not None else str(self.path / name)

    def lstat(self, name: str) -> os.stat_result:
        """Return the status of an entry, which may be a link."""
        return os.stat(self._name(name), dir_fd=self.descriptor, follow_symlinks=False)

    def is_link(self, name: str) -> bool:
        """Return whether an entry is a link or, on Windows, a junction."""
        try:
            found = self.lstat(name)
        except OSError:
            return False
        return stat.S_ISLNK(found.st_mode) or getattr(found, "st_reparse_tag", 0) == getattr(
            stat, "IO_REPARSE_TAG_MOUNT_POINT", -1
        )

    def _explained(self, name: str, error: OSError) -> OSError:
        """Return the error to raise for an entry: one about a link if the entry is a link, else ``error``."""
        return _link(self.path / name) if self.is_link(name) else error

    def open(self, name: str, flags: int, mode: int = 0o666) -> int:
        """Open a file, and return its descriptor."""
        if WINDOWS and self.is_link(name):
            raise _link(self.path / name)
        try:
            return os.open(self._name(name), flags | PLAIN, mode, dir_fd=self.descriptor)
        except OSError as e:
            raise self._explained(name, e) from e

    def open_regular(self, name: str, flags: int) -> int:
        """Open a regular file, as `open` does."""
        try:
            descriptor = self.open(name, flags | getattr(os, "O_NONBLOCK", 0))
        except OSError as e:
            if e.errno != errno.ENXIO:  # a socket, or a pipe that nobody reads
                raise
            raise RefusedError(f"{self.path / name}: is not a regular file; remove it") from e
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise RefusedError(f"{self.path / name}: is not a regular file; remove it")
        return descriptor

    def folder(self, name: str) -> Folder:
        """Open a folder in this one."""
        path = self.path / name
        if WINDOWS:
            if self.is_link(name):
                raise _link(path)
            if not path.is_dir():
                raise NotADirectoryError(errno.ENOTDIR, os.strerror(errno.ENOTDIR), str(path))
            return Folder(path, None)
        try:
            return Folder(path, _opened(name, NO_FOLLOW, self.descriptor))
        except OSError as e:
            raise self._explained(name, e) from e

    def mkdir(self, name: str, mode: int = 0o777) -> None:
        """Make a folder."""
        os.mkdir(self._name(name), mode, dir_fd=self.descriptor)

    def rmdir(self, name: str) -> None:
        """Remove an empty folder."""
        os.rmdir(self._name(name), dir_fd=self.descriptor)

    def unlink(self, name: str) -> None:
        """Remove a file, or a link itself."""
        os.unlink(self._name(name), dir_fd=self.descriptor)

    def replace(self, old: str, new: str) -> None:
        """Rename an entry; a file or link with the new name is replaced."""
        os.replace(self._name(old), self._name(new), src_dir_fd=self.descriptor, dst_dir_fd=self.descriptor)

    def rename(self, old: str, new: str) -> None:
        """Rename a folder; the new name must be free, or belong to an empty folder."""
        os.rename(self._name(old), self._name(new), src_dir_fd=self.descriptor, dst_dir_fd=self.descriptor)

    def remove_tree(self, name: str) -> None:
        """Remove a folder with its contents; entries that cannot be removed stay."""
        shutil.rmtree(self._name(name), ignore_errors=True, dir_fd=self.descriptor)

    def names(self) -> list[str]:
        """Return the names of all entries."""
        return os.listdir(self.path if self.descriptor is None else self.descriptor)

    def sync(self) -> None:
        """Sync the names to the disk, so that they survive a power failure; Windows has no such call."""
        if self.descriptor is None:
            return
        try:
            os.fsync(self.descriptor)
        except OSError as e:
            if e.errno not in NO_FOLDER_SYNC:
                raise


_ROOTS: dict[tuple[str, ...], Folder] = {}
"""Folders that are open for blocks, by the parts of their paths."""
_LOCK = threading.RLock()


@contextlib.contextmanager
def output_folder(folder: Path) -> Iterator[None]:
    """Let this block write below a folder only through its descriptor and without following links."""
    # The path of the folder itself may contain links, unless it is below another open folder. If another folder takes
    # its place during the block, the next write is rejected.
    path = folder.absolute()
    with _LOCK:
        if path.parts not in _ROOTS:
            _ROOTS[path.parts] = open_folder(path)
        root = _ROOTS[path.parts]
        root.blocks += 1
    try:
        yield
    finally:
        with _LOCK:
            root.blocks -= 1
            if not root.blocks:
                del _ROOTS[path.parts]
                root.close()


def is_below(path: Path) -> bool:
    """Return whether a path is below an open folder; no link on the way to such a path is followed."""
    return _outermost(path.absolute().parent) is not None


def open_folder(path: Path, make: bool = False) -> Folder:
    """Open a folder, to use its entries; links on the way are followed, except below an open `output_folder`."""
    path = path.absolute()
    with _LOCK:
        root = _outermost(path)
        if root is None:
            return Folder(path, None if WINDOWS else _opened(str(path), 0, None))
        found = _again(root)
    for i in range(len(root.path.parts), len(path.parts)):
        with found as above:
            found = _entered(above, path.parts[i], make)
        inner = _ROOTS.get(path.parts[: i + 1])
        if inner is not None and found.identity != inner.identity:
            found.close()
            raise _replaced(inner.path)
    return found


def open_file(path: Path, below: Path) -> BinaryIO:
    """Open a regular file for reading; the path from the folder ``below`` to the file must have no link."""
    with output_folder(below), open_folder(path.parent) as folder:
        return os.fdopen(folder.open_regular(path.name, os.O_RDONLY), "rb")


def _opened(name: str, more: int, at: int | None) -> int:
    """Open a folder and return its descriptor, even if the folder may not be listed."""
    try:
        return os.open(name, FOLDER | more, dir_fd=at)
    except PermissionError:
        if not getattr(os, "O_PATH", 0):
            raise
        return os.open(name, SEARCHED | more, dir_fd=at)


def _outermost(path: Path) -> Folder | None:
    """Return the outermost open folder that is the path or above it."""
    parts = path.parts
    return next((_ROOTS[parts[:i]] for i in range(1, len(parts) + 1) if parts[:i] in _ROOTS), None) if _ROOTS else None


def _again(root: Folder) -> Folder:
    """Open an open folder again, after a check that its path still names this folder."""
    try:
        now = os.stat(root.path)
    except OSError as e:
        raise _replaced(root.path) from e
    if (now.st_dev, now.st_ino) != root.identity:
        raise _replaced(root.path)
    return Folder(root.path, None if WINDOWS else _opened(".", 0, root.descriptor))


def _entered(above: Folder, name: str, make: bool) -> Folder:
    """Open a folder in another one, and make it first if it is missing and ``make`` is True."""
    if name == os.pardir:
        raise RefusedError(f"{above.path / name}: use a path without {os.pardir} inside the folder")
    try:
        return above.folder(name)
    except FileNotFoundError:
        if not make:
            raise
    with contextlib.suppress(FileExistsError):  # of another process, just now
        above.mkdir(name)
    return above.folder(name)


def _link(path: Path) -> RefusedError:
    return RefusedError(
        f"{path}: is a link, and links inside of a results folder are not followed; put the file or folder itself there, or "
        "remove the link. The results folder itself may be a link"
    )


def _replaced(path: Path) -> RefusedError:
    return RefusedError(
        f"{path}: the folder was moved, removed or replaced while this command wrote into it. Put it "
        "back, or choose another folder"
    )


# Temporary files and folders, each locked by its owner; any process may remove unlocked ones.
#
# The system releases a lock when its holder ends, killed or not. So a temporary file of a running process is never
# removed as a leftover, and the next command removes the files of a killed process.

NAMES = re.compile(r"\.?warpgs-[0-9a-f]{16}\.tmp(\.(mp4|webm|lock))?")
"""Names of temporary files, folders and their locks: short and ASCII, so that every file system accepts them."""
LOCKED = ".lock"
"""End of the name of the lock beside a temporary folder."""
NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL)
"""Errors of file systems without locks."""

_HELD: set[int] = set()
"""Descriptors of the locks of temporary folders of this process."""
_ROOTS_LOCK = threading.Lock()


@contextlib.contextmanager
def shared_locks() -> Iterator[tuple[int, ...]]:
    """Give descriptors of all locks of temporary folders, for a child process to inherit (``pass_fds``)."""
    # The child may work in these folders. So the folders stay locked until it has ended, even if this process dies
    # first.
    with _ROOTS_LOCK:
        copies = tuple(map(os.dup, _HELD)) if sys.platform != "win32" else ()
    try:
        yield copies
    finally:
        for descriptor in copies:
            os.close(descriptor)


class TemporaryFile:
    """A new file that its owner locks, and removes at the end unless it was renamed; use it with ``with``."""

    def __init__(self, folder: Folder, suffix: str = ""):
        """Make the file."""
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
        """Make the folder."""
        self._above, self._process = above, os.getpid()
        lock, self._descriptor = _own_file(above, LOCKED, locks=True, prefix=prefix, mode=0o600)
        self.name = lock.removesuffix(LOCKED)
        self.path = above.path / self.name
        with _ROOTS_LOCK:
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
            with _ROOTS_LOCK:
                _HELD.discard(self._descriptor)
            try:
                _unlocked(self._above, self.name + LOCKED, self._descriptor)
            finally:
                self._above.close()


def temporary_folder() -> TemporaryFolder:
    """Make a folder that only this user can read or write, in the `system_folder`; use it with ``with``."""
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
    """Remove unlocked temporary files and folders; those that cannot be removed or locked stay."""
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


def cache_home() -> Path | None:
    """Return the system's folder for a user's caches; None without a home folder."""
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
    """Return a new folder that only this user can read or write (mode 0700), removed when Python ends; one for each process."""
    try:
        made = temporary_folder()
    except OSError as e:
        raise ResourceError(
            f"no folder for temporary files can be written ({e.strerror or e}). Set TMPDIR (TEMP on Windows) to a folder that "
            "you may write to"
        ) from e
    atexit.register(made.remove)
    return made.path
