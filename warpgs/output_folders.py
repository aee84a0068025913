"""Folders that this process writes into: the folder that the user names may be a link; below it no link is followed.

`output_folder` opens such a folder for a block. Everything below it is then reached from its descriptor, folder by folder,
without following links, so that no other program can redirect a write or a read. Below nested open folders, a path is followed
from the outermost one. Windows has no descriptors of folders: there each part of a path is checked for links before it is used.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import stat
import sys
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

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
        self.path, self.descriptor = path, descriptor

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
        """Open a file, and return its descriptor.

        Raises:
            OSError: The file cannot be opened, or is a link.
        """
        if WINDOWS and self.is_link(name):
            raise _link(self.path / name)
        try:
            return os.open(self._name(name), flags | PLAIN, mode, dir_fd=self.descriptor)
        except OSError as e:
            raise self._explained(name, e) from e

    def open_regular(self, name: str, flags: int) -> int:
        """Open a regular file, as `open` does.

        Raises:
            OSError: As for `open`.
            RefusedError: The file is a pipe or a device; the call does not wait for it.
        """
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
        """Open a folder in this one.

        Raises:
            NotADirectoryError: The entry is a file.
            OSError: The folder cannot be opened, or is a link.
        """
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


@dataclass
class _Root:
    """A folder that is open for a block."""

    path: Path
    folder: Folder
    identity: tuple[int, int]
    blocks: int = 0


_ROOTS: dict[tuple[str, ...], _Root] = {}
_LOCK = threading.RLock()


@contextlib.contextmanager
def output_folder(folder: Path) -> Iterator[None]:
    """Let this block write below a folder only through its descriptor and without following links.

    The path of the folder itself may contain links, unless it is below another open folder. If another folder takes its place
    during the block, the next write is rejected.

    Raises:
        OSError: The folder is missing, or is behind a link below an open folder.
    """
    path = folder.absolute()
    with _LOCK:
        root = _ROOTS.get(path.parts)
        if root is None:
            opened = open_folder(path)
            root = _ROOTS[path.parts] = _Root(path, opened, _identity(opened))
        root.blocks += 1
    try:
        yield
    finally:
        with _LOCK:
            root.blocks -= 1
            if not root.blocks:
                del _ROOTS[path.parts]
                root.folder.close()


def is_below(path: Path) -> bool:
    """Return whether a path is below an open folder; no link on the way to such a path is followed."""
    return _outermost(path.absolute().parent) is not None


def open_folder(path: Path, make: bool = False) -> Folder:
    """Open a folder, to use its entries; links on the way are followed, except below an open `output_folder`.

    Args:
        path: The folder.
        make: True to create the folder and its missing parents; used only below an open folder.

    Raises:
        OSError: The folder cannot be opened, or a parent folder is a link.
    """
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
        if inner is not None and _identity(found) != inner.identity:
            found.close()
            raise _replaced(inner.path)
    return found


def open_file(path: Path, below: Path) -> BinaryIO:
    """Open a regular file for reading; the path from the folder ``below`` to the file must have no link.

    Args:
        path: The file.
        below: Folder above the file, such as a run folder.

    Raises:
        OSError: The file cannot be opened, or is a link.
        RefusedError: The file is not a regular file.
    """
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


def _outermost(path: Path) -> _Root | None:
    """Return the outermost open folder that is the path or above it."""
    parts = path.parts
    return next((_ROOTS[parts[:i]] for i in range(1, len(parts) + 1) if parts[:i] in _ROOTS), None) if _ROOTS else None


def _again(root: _Root) -> Folder:
    """Open an open folder again, after a check that its path still names this folder."""
    try:
        now = os.stat(root.path)
    except OSError as e:
        raise _replaced(root.path) from e
    if (now.st_dev, now.st_ino) != root.identity:
        raise _replaced(root.path)
    return Folder(root.path, None if WINDOWS else _opened(".", 0, root.folder.descriptor))


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


def _identity(folder: Folder) -> tuple[int, int]:
    """Return the numbers that identify a folder to the system."""
    found = os.stat(folder.path) if folder.descriptor is None else os.fstat(folder.descriptor)
    return found.st_dev, found.st_ino


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
