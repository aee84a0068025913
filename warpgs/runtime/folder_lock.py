"""Locks on folders: one process at a time writes into a run folder; a second one gets an error that names the first."""

from __future__ import annotations

import contextlib
import datetime
import errno
import json
import os
import platform
import shlex
import stat
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from filelock import lock_descriptor

from warpgs import schema
from warpgs.errors import FolderHeldError, ResourceError, UsageError
from warpgs.files import LOCK, remove_leftovers, writing_into
from warpgs.output_folders import Folder, RefusedError, open_folder
from warpgs.temporary import NO_LOCKS, sweep_temporary_files

SIGNED_WITHIN = 50
"""Number of attempts to read the signature of a lock's holder, a hundredth of a second apart."""
MOST_LETTERS = 200
"""Length at which a command is cut short in a message."""


@contextlib.contextmanager
def hold_folder(folder: Path, *parts: str) -> Iterator[list[str]]:
    """Lock a folder, and make it if it is missing, so that no other process writes into it during the block.

    The system releases the lock when the process that holds it ends, even if it is killed. The lock also excludes processes in
    other containers. The lock file names the holder. Leftovers of killed writers are removed from the folder and from the
    system's temporary files. In the block nothing below the folder is written through a link (`output_folder`). If an error
    ends the block, a folder that was made here is removed if it is still empty; other folders are never removed.

    Args:
        folder: The folder.
        parts: Folders in it that are written under the same lock; none may be a link.

    Returns:
        A list with a note for the user if the file system has no locks, otherwise an empty list.

    Raises:
        FolderHeldError: Another process holds the folder.
        ResourceError: The folder cannot be written.
    """
    sweep_temporary_files()
    with writing_into(folder) as made:
        try:
            with open_folder(folder) as opened, _held(opened) as locked:
                for name in (".", *parts):
                    remove_leftovers(folder / name)
                note = f"{folder}: its file system has no locks; do not start a second process that writes there"
                yield [] if locked else [note]
        except BaseException:
            if made:
                with contextlib.suppress(OSError), open_folder(folder.absolute().parent) as above:
                    above.rmdir(folder.name)  # where it is not empty, or in use, it stays
            raise


@contextlib.contextmanager
def hold_file(path: Path) -> Iterator[list[str]]:
    """Hold the folder of a file that the block writes; see `hold_folder`.

    Raises:
        FolderHeldError: Another process holds the folder.
        ResourceError: The folder cannot be written.
        UsageError: The path is a folder, or too long.
    """
    check_file_path(path)
    with hold_folder(path.parent) as notes:
        yield notes


def check_file_path(path: Path) -> None:
    """Check, before the work, that a file can be written at a path: it is not a folder, and not too long.

    Raises:
        UsageError: The path is a folder, or too long.
    """
    try:
        is_folder = stat.S_ISDIR(path.lstat().st_mode)
    except OSError as e:
        if e.errno == errno.ENAMETOOLONG:
            raise UsageError(f"{path}: the name of the file is too long; choose a shorter one") from e
        return  # no such path, or an error that `hold_folder` reports
    if is_folder:
        raise UsageError(f"{path}: is a folder; give the name of the file to write, such as one in this folder")


def check_free(folder: Path) -> None:
    """Check, without writing, that no process holds a folder; a folder that cannot be read counts as free.

    Raises:
        FolderHeldError: Another process holds it.
    """
    with contextlib.suppress(OSError), open_folder(folder) as opened:
        with os.fdopen(opened.open_regular(LOCK, os.O_RDWR), "r+b", buffering=0) as file:
            _lock(file, folder)


@contextlib.contextmanager
def _held(folder: Folder) -> Iterator[bool]:
    """Hold the lock of a folder; yields whether the file system has locks."""
    while True:
        file = _open(folder)
        try:
            locked = _lock(file, folder.path)
            # the last holder may have removed the lock file between the two calls; then other processes lock a new file
            if not locked or os.fstat(file.fileno()).st_nlink:
                break
        except BaseException:
            file.close()
            raise
        file.close()
    try:
        with contextlib.suppress(OSError):  # a full disk: the lock holds all the same
            _sign(file)
        yield locked
    finally:
        # Windows cannot remove an open file; other systems must remove it while the lock is held
        if sys.platform == "win32":
            file.close()
        try:
            with contextlib.suppress(OSError):
                folder.unlink(LOCK)
        finally:
            file.close()


def _open(folder: Folder) -> BinaryIO:
    """Open a lock file to read and write, made if it is missing."""
    try:
        return os.fdopen(folder.open_regular(LOCK, os.O_RDWR | os.O_CREAT), "r+b", buffering=0)
    except RefusedError as e:
        raise ResourceError(f"{folder.path}: cannot be written, as {e}") from e
    except OSError as e:
        raise ResourceError(
            f"{folder.path}: cannot be written, as its lock {LOCK} cannot be opened ({e.strerror or e}); choose another "
            "folder, or make this one writable"
        ) from e


def _lock(file: BinaryIO, folder: Path) -> bool:
    """Lock an open file; return False where its file system has no locks.

    Raises:
        FolderHeldError: Another process holds it.
        ResourceError: The file cannot be locked.
    """
    try:
        if lock_descriptor(file.fileno(), blocking=False):
            return True
    except OSError as e:
        if e.errno in NO_LOCKS:
            return False
        raise ResourceError(f"{folder}: cannot be locked ({e.strerror or e}); choose another folder") from e
    raise FolderHeldError(
        f"{folder}: {_holder(file)} is writing there. Wait until that process ends, end it, or choose another folder"
    )


def _sign(file: BinaryIO) -> None:
    """Write the owner into a lock file; Windows locks its first byte, which no other process may then read."""
    program = Path(sys.argv[0])
    name = program.parent.name if program.name == "__main__.py" else program.name  # of `python -m warpgs`
    command = shlex.join([name, *sys.argv[1:]])
    now = datetime.datetime.now().astimezone().isoformat(" ", "seconds")
    values = {"process": os.getpid(), "host": platform.node(), "since": now, "command": command}
    file.truncate(0)
    file.seek(0)
    file.write(b"\n" + json.dumps(values).encode())


def _holder(file: BinaryIO) -> str:
    """Return a text that names the holder of a lock file; wait briefly for the signature, since the lock may be new."""
    for _ in range(SIGNED_WITHIN):
        words = _signed(file)
        if words is not None:
            return words
        time.sleep(0.01)
    return "another process"


def _signed(file: BinaryIO) -> str | None:
    """Return who signed a lock file; None if the signature is missing or incomplete."""
    try:
        file.seek(1)
        found = schema.parse(file.read(schema.MAX_BYTES))
        command = found["command"] if len(found["command"]) <= MOST_LETTERS else f"{found['command'][:MOST_LETTERS]}..."
        return f"process {found['process']} on {found['host']}, since {found['since']}, `{command}`,"
    except (OSError, ValueError, KeyError, TypeError):
        return None
