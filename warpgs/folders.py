"""Folders: results, temporary folders and caches, where no link leads elsewhere."""

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

from warpgs.errors import ResourceError, explained

# Folders that this process writes into: the folder that the user names may be a link; below it no link is followed.
#
# `output_folder` opens such a folder for a block. Every path below it is then opened from its descriptor, folder by
# folder, without following links. So no other program can redirect a write or a read. With nested open folders, a path
# is opened from the outermost one. Windows has no descriptors of folders: there each part of a path is checked
# for links before it is used.

WINDOWS = sys.platform == "win32"
NO_FOLLOW = getattr(os, "O_NOFOLLOW", 0)
JUNCTION = 0xA0000003
"""Tag of Windows for a folder that leads elsewhere."""
DESCRIPTORS = Path("/proc/self/fd")
"""Folder in which Linux lists the open files and folders of this process; libraries can open paths through it."""


class RefusedError(OSError):
    """A path that is rejected: a link, not a regular file, or a folder that was replaced; the message contains the fix."""

    def __init__(self, message: str):
        """Take the whole message."""
        super().__init__(errno.ELOOP, message)

    def __str__(self) -> str:
        return self.strerror


class Folder(contextlib.AbstractContextManager["Folder"]):
    """An open folder, whose entries are used by name without following links; a context manager that closes it."""

    def __init__(self, path: Path, above: "Folder | None" = None):
        """Open a folder by its path, or in the folder ``above`` it, where it may be no link."""
        self.path = path
        self.descriptor: int | None = None
        if above is not None:
            above.refuse_link(path.name)
        if WINDOWS:
            os.scandir(path).close()  # an error if it is no folder
            status = os.stat(path)
        else:
            name, at, links = (path, None, 0) if above is None else (path.name, above.descriptor, NO_FOLLOW)
            self.descriptor = os.open(name, os.O_RDONLY | os.O_DIRECTORY | links, dir_fd=at)
            status = os.fstat(self.descriptor)
        self.identity = status.st_dev, status.st_ino

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the descriptor."""
        if self.descriptor is not None:
            os.close(self.descriptor)

    def reachable(self) -> Path:
        """Return a path of this folder in ASCII, for libraries of this process, where the system has such paths."""
        shown = DESCRIPTORS / str(self.descriptor)
        return shown if shown.is_dir() else self.path

    def _name(self, name: str) -> str:
        return name if self.descriptor is not None else str(self.path / name)

    def lstat(self, name: str) -> os.stat_result:
        """Return the status of an entry, which may be a link."""
        return os.stat(self._name(name), dir_fd=self.descriptor, follow_symlinks=False)

    def refuse_link(self, name: str) -> None:
        """Raise a RefusedError where an entry is a link or, on Windows, a junction."""
        with contextlib.suppress(FileNotFoundError):
            found = self.lstat(name)
            if stat.S_ISLNK(found.st_mode) or getattr(found, "st_reparse_tag", 0) == JUNCTION:
                raise RefusedError(f"{self.path / name}: is a link inside of a results folder; put its target there")

    def open(self, name: str, flags: int, mode: int = 0o666) -> int:
        """Open a file, and return its descriptor."""
        self.refuse_link(name)
        return os.open(self._name(name), flags | NO_FOLLOW | getattr(os, "O_BINARY", 0), mode, dir_fd=self.descriptor)

    def open_regular(self, name: str, flags: int) -> int:
        """Open a regular file, as `open` does."""
        refused = RefusedError(f"{self.path / name}: is not a regular file; remove it")
        try:
            descriptor = self.open(name, flags | getattr(os, "O_NONBLOCK", 0))
        except OSError as e:
            if e.errno != errno.ENXIO:  # a socket, or a pipe that nobody reads
                raise
            raise refused from e
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            os.close(descriptor)
            raise refused
        return descriptor

    def folder(self, name: str, make: bool = False) -> "Folder":
        """Open a folder in this one, and make it first if it is missing and ``make`` is True."""
        if name == os.pardir:
            raise RefusedError(f"{self.path / name}: use a path without {os.pardir} inside the folder")
        if make:
            with contextlib.suppress(FileExistsError):
                self.mkdir(name)
        return Folder(self.path / name, self)

    def mkdir(self, name: str, mode: int = 0o777) -> None:
        """Make a folder."""
        os.mkdir(self._name(name), mode, dir_fd=self.descriptor)

    def rmdir(self, name: str) -> None:
        """Remove an empty folder."""
        os.rmdir(self._name(name), dir_fd=self.descriptor)

    def unlink(self, name: str) -> None:
        """Remove a file, or a link itself."""
        os.unlink(self._name(name), dir_fd=self.descriptor)

    def remove(self, name: str) -> None:
        """Remove a file or link, or a folder with its contents; what cannot be removed stays."""
        with contextlib.suppress(OSError):
            return self.unlink(name)
        shutil.rmtree(self._name(name), ignore_errors=True, dir_fd=self.descriptor)

    def replace(self, old: str, new: str) -> None:
        """Rename an entry; a file, link or empty folder with the new name is replaced."""
        os.replace(self._name(old), self._name(new), src_dir_fd=self.descriptor, dst_dir_fd=self.descriptor)

    def names(self) -> list[str]:
        """Return the names of all entries."""
        return os.listdir(self.path if self.descriptor is None else self.descriptor)


_ROOTS: list[Folder] = []
"""Folders that are open for blocks."""
_LOCK = threading.Lock()


@contextlib.contextmanager
def output_folder(folder: Path) -> Iterator[None]:
    """Let this block write below a folder only through its descriptor and without following links."""
    # The path of the folder itself may contain links, unless it is below another open folder. If another folder takes
    # its place during the block, the next write is rejected.
    with open_folder(folder) as root:
        with _LOCK:
            _ROOTS.append(root)
        try:
            yield
        finally:
            with _LOCK:
                _ROOTS.remove(root)


def _roots(path: Path) -> list[Folder]:
    """Return the open folders that are a path or above it, the outermost one first."""
    with _LOCK:
        return sorted((r for r in _ROOTS if path.is_relative_to(r.path)), key=lambda r: len(r.path.parts))


def is_below(path: Path) -> bool:
    """Return whether a path is below an open folder; no link on the way to such a path is followed."""
    return bool(_roots(path.absolute().parent))


def open_folder(path: Path, make: bool = False) -> "Folder":
    """Open a folder, to use its entries; links on the way are followed, except below an open `output_folder`."""
    path = path.absolute()
    if not (roots := _roots(path)):
        return Folder(path)
    try:
        found = Folder(roots[0].path)
    except OSError as e:
        raise _replaced(roots[0].path) from e
    for name in (*path.relative_to(found.path).parts, None):
        if any(r.path == found.path and r.identity != found.identity for r in roots):
            found.close()
            raise _replaced(found.path)
        if name is not None:
            with found as above:
                found = above.folder(name, make)
    return found


def _replaced(path: Path) -> RefusedError:
    return RefusedError(f"{path}: the folder was moved, removed or replaced meanwhile; put it back, or choose another")


# Temporary files and folders: the owner locks its file, or a file beside its folder; any process may remove unlocked ones.
#
# The system releases a lock when its holder ends, killed or not. So a temporary file of a running process is never
# removed as a leftover, and the next command removes the files of a killed process.

NAMES = re.compile(r"\.?warpgs-[0-9a-f]{16}\.tmp(\.(mp4|webm))?(\.lock)?")
"""Names of temporary files, folders and their locks: short and ASCII, so that every file system accepts them."""
LOCKED = ".lock"
"""End of the name of the lock beside a temporary folder."""
NO_LOCKS = (errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.ENOLCK, errno.EINVAL)
"""Errors of file systems without locks."""

_HELD: set[int] = set()
"""Descriptors of the locks of temporary folders of this process."""


def lock(descriptor: int) -> bool | None:
    """Lock a file; return False if another process holds it, None if its file system has no locks."""
    try:
        return lock_descriptor(descriptor, blocking=False)
    except OSError as e:
        if e.errno in NO_LOCKS:
            return None
        raise


def unlock(folder: Folder, name: str, descriptor: int) -> None:
    """Remove a locked file, and then release its lock; Windows removes no open file."""
    if WINDOWS:
        os.close(descriptor)
    try:
        with contextlib.suppress(OSError):
            folder.unlink(name)
    finally:
        if not WINDOWS:
            os.close(descriptor)


@contextlib.contextmanager
def shared_locks() -> Iterator[tuple[int, ...]]:
    """Give descriptors of all locks of temporary folders, for a child process to inherit (``pass_fds``)."""
    # The child may work in these folders. So the folders stay locked until it has ended, even if this process dies
    # first.
    with _LOCK:
        copies = () if WINDOWS else tuple(map(os.dup, _HELD))
    try:
        yield copies
    finally:
        for descriptor in copies:
            os.close(descriptor)


def _locked(above: Folder, prefix: str, end: str, mode: int) -> tuple[str, int]:
    """Make and lock a file with a new name; return name and descriptor."""
    while True:
        name = f"{prefix}{secrets.token_hex(8)}.tmp{end}"
        descriptor = above.open(name, os.O_RDWR | os.O_CREAT | os.O_EXCL, mode)
        try:
            if lock(descriptor) is not False and os.fstat(descriptor).st_nlink:
                return name, descriptor
        except BaseException:
            unlock(above, name, descriptor)
            raise
        os.close(descriptor)  # another process found it before it was locked, and removes it


@contextlib.contextmanager
def temporary_file(above: Folder, suffix: str = "") -> Iterator[tuple[str, BinaryIO]]:
    """Give the name of a new locked file, and the file; it is removed after the block unless it was renamed."""
    name, descriptor = _locked(above, ".warpgs-", suffix, 0o666)
    try:
        with open(descriptor, "wb") as file:
            yield name, file
    finally:
        with contextlib.suppress(OSError):  # leftovers are recognised by name
            above.unlink(name)


class Temporary(contextlib.AbstractContextManager["Temporary"]):
    """A name for a new folder, with a lock beside it; at the end, the folder that has the name is removed."""

    def __init__(self, above: Folder, prefix: str = ".warpgs-"):
        """Make the lock."""
        self._above, self._process = above, os.getpid()
        name, self._lock = _locked(above, prefix, LOCKED, 0o600)
        self.name = name.removesuffix(LOCKED)
        self.path = above.path / self.name
        with _LOCK:
            _HELD.add(self._lock)

    def __exit__(self, *_: object) -> None:
        self.remove()

    def remove(self) -> None:
        """Remove the folder unless it was renamed, then its lock; a forked child leaves both to its parent."""
        if os.getpid() == self._process and self._lock in _HELD:
            try:
                self._above.remove(self.name)
            finally:
                with _LOCK:
                    _HELD.discard(self._lock)
                unlock(self._above, self.name + LOCKED, self._lock)


@contextlib.contextmanager
def temporary_folder() -> Iterator[Temporary]:
    """Make a folder that only this user can read or write, in the `system_folder`, and remove it after the block."""
    sweep_temporary_files()
    with open_folder(system_folder()) as above, Temporary(above, "warpgs-") as made:
        above.mkdir(made.name, 0o700)
        yield made


@functools.cache
def sweep_temporary_files() -> None:
    """Remove leftovers of killed commands of this user from the system's temporary files, once in each process."""
    with contextlib.suppress(OSError), open_folder(system_folder()) as folder:
        sweep(folder, own=True)


def system_folder() -> Path:
    """Return the first usable folder of TMPDIR, TEMP and TMP, else the system's temporary folder; set it in `tempfile`, too."""
    if tempfile.tempdir is None and not WINDOWS:
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
                if own and not WINDOWS and found.st_uid != os.getuid():
                    continue
                is_file = stat.S_ISREG(found.st_mode) and not name.endswith(LOCKED)
                held = name if is_file else name.removesuffix(LOCKED) + LOCKED
                descriptor = folder.open_regular(held, os.O_RDWR | (0 if is_file else os.O_CREAT))
                if lock(descriptor):
                    folder.remove(held.removesuffix(LOCKED))
                    unlock(folder, held, descriptor)
                else:
                    os.close(descriptor)


def cache_home() -> Path | None:
    """Return the system's folder for a user's caches; None without a home folder."""
    home = Path(os.path.expanduser("~"))
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
    stack = contextlib.ExitStack()
    with explained("no temporary folder can be written", "set TMPDIR (TEMP on Windows)", kind=ResourceError):
        made = stack.enter_context(temporary_folder())
    atexit.register(stack.close)
    return made.path
