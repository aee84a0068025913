"""Opening of input files: only regular files of bounded size, so that no pipe hangs a command and no device fills its memory.

Every untrusted file is opened here. An unreadable file raises an OSError with the reason as its ``strerror``. Callers then
raise a `DataError` with the text of `unread_reason` and a remedy.
"""

from __future__ import annotations

import errno
import hashlib
import os
import stat
from pathlib import Path
from typing import BinaryIO

from warpgs.output_folders import open_file

MAX_BYTES = 2**34
"""Default size of the largest file that is read into memory [bytes]."""
NOT_REGULAR = "is not a regular file"
"""Reason for a pipe, a socket or a device."""
PIECE = 1 << 20
"""Bytes read at a time from a file that is longer than its reported size."""


def open_input(path: str | os.PathLike[str], below: Path | None = None) -> BinaryIO:
    """Open a regular file for reading in binary mode.

    Args:
        path: The file.
        below: Folder above the file, such as a run folder; no link between the two is followed. None for a file that the user
            names, which may be a link.

    Raises:
        OSError: The file is missing, unreadable, a folder, a link that is not followed, or not a regular file (a pipe, a
            socket, a device).
    """
    if below is not None:
        return open_file(Path(path), below)
    path = os.fspath(path)
    _check_kind(os.stat(path).st_mode, path)  # a device is not even opened
    flags = os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_CLOEXEC", 0)
    # a pipe that took the file's place since then must not block
    descriptor = os.open(path, flags | getattr(os, "O_NONBLOCK", 0))
    try:
        _check_kind(os.fstat(descriptor).st_mode, path)
        if hasattr(os, "O_NONBLOCK"):
            os.set_blocking(descriptor, True)
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def _check_kind(mode: int, path: str) -> None:
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "is a folder", path)
    if not stat.S_ISREG(mode):
        raise OSError(errno.EINVAL, NOT_REGULAR, path)


def read_input(path: str | os.PathLike[str], most: int = MAX_BYTES, below: Path | None = None) -> bytes:
    """Return the contents of a regular file of at most ``most`` bytes; ``below`` as in `open_input`.

    Raises:
        OSError: The file cannot be opened or read, is not a regular file, or is larger than ``most``.
    """
    with open_input(path, below) as file:
        size = os.fstat(file.fileno()).st_size
        if size > most:
            raise _too_large(path, most)
        data = file.read(size + 1)
        while len(data) > size and (more := file.read(PIECE)):  # files of /proc have no size, logs grow
            data += more
            if len(data) > most:
                break
    if len(data) > most:
        raise _too_large(path, most)
    return data


def read_start(path: str | os.PathLike[str], count: int) -> bytes:
    """Return the first bytes of a regular file, at most ``count``.

    Raises:
        OSError: The file cannot be opened or read, or is not a regular file.
    """
    with open_input(path) as file:
        return file.read(count)


def input_digest(path: str | os.PathLike[str], below: Path | None = None) -> str:
    """Return the SHA-256 of a regular file, hexadecimal; ``below`` as in `open_input`.

    Raises:
        OSError: The file cannot be opened or read, or is not a regular file.
    """
    with open_input(path, below) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def unread_reason(error: OSError) -> str:
    """Return why a file could not be read, in words for the middle of a message."""
    return error.strerror or str(error)


def _too_large(path: str | os.PathLike[str], most: int) -> OSError:
    return OSError(errno.EFBIG, f"is larger than {_size(most)}", str(Path(path)))


def _size(most: int) -> str:
    return f"{most // 2**20:,} MiB" if most >= 2**20 else f"{most:,} bytes"
