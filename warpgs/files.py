"""Writing of files so that nothing is lost: a new file appears whole or not at all."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import re
import secrets
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from warpgs.errors import ResourceError, UsageError

LOCK = ".warpgs.lock"
"""Name of the file that a process holds while it writes into a folder."""
OWN_NAMES = re.compile(r"\.warpgs-[0-9a-f]{16}\.tmp(\.(mp4|webm))?")
"""Names of temporary files and folders: short and of ASCII letters, so that they fit wherever the file itself does."""
UNDECODABLE = re.compile("[\udc80-\udcff]")
"""Characters that Python puts in the place of bytes that are not UTF-8."""
WINDOWS = sys.platform == "win32"
PAUSES = (0.05, 0.1, 0.2, 0.4, 0.8)
"""Waits before a replacement is tried again on Windows [s]: a virus scanner holds a new file open for about that long."""
FULL = (errno.ENOSPC, errno.EDQUOT)
"""Errors of a disk, or of a user's part of one, that has no room left."""
NO_FOLDER_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.EBADF, errno.EACCES)
"""Errors of file systems that cannot sync a folder; what they keep after a power failure is theirs to say."""


@contextlib.contextmanager
def replacing(
    path: Path, check: Callable[[Path], object] | None = None, *, size: int | None = None, suffix: str = ""
) -> Iterator[Path]:
    """Give the path of a temporary file beside ``path``; once the block has written it, it takes the place of ``path``.

    It is synced to the disk and checked first, and the folder is synced after. Where anything fails, an error of the block
    included, the temporary file goes and what was there before stays.

    Args:
        path: File to write or to replace.
        check: Function that reads the temporary file back and raises where it is not whole.
        size: Bytes that will be written, which must be there at the end; None where nobody knows.
        suffix: End of the temporary file's name, for libraries that take the format from it: none, .mp4 or .webm.

    Raises:
        ResourceError: The disk is full, the folder is not writable, or the old file is open in another program on Windows.
    """
    temporary = path.parent / f".warpgs-{secrets.token_hex(8)}.tmp{suffix}"
    try:
        yield temporary
        with temporary.open("rb+") as f:
            os.fsync(f.fileno())
        if size is not None and (found := temporary.stat().st_size) != size:  # some file systems report no error
            raise OSError(errno.EIO, f"{found} of {size} bytes are there")
        if check is not None:
            check(temporary)
        _replace(temporary, path)
    except OSError as e:
        amount = "" if size is None else f"{size / 2**20:.1f} MiB " if size >= 2**20 else f"{size:,} bytes "
        raise ResourceError(
            f"{path}: {amount}cannot be written ({e.strerror or e}); what was there before is untouched. {_remedy(e)}"
        ) from e
    finally:
        with contextlib.suppress(OSError):  # it hides nothing: an error above goes on, and what is left over is ours by name
            temporary.unlink(missing_ok=True)
    sync_folder(path.parent)


@contextlib.contextmanager
def filling(folder: Path) -> Iterator[Path]:
    """Give the path of a temporary folder beside ``folder``; once the block has filled it, it becomes that folder, whole.

    Where anything fails, an error of the block included, the temporary folder goes and nothing is left of it.

    Args:
        folder: Folder to make; it may exist if it is empty.

    Raises:
        ResourceError: The disk is full, or the folder above is not writable.
        UsageError: It is the folder that this process works in, which would be lost to it.
    """
    target = Path(os.path.realpath(folder))
    if target == Path.cwd():
        raise UsageError(f"{folder}: is the folder that you are in, and it would be made anew under you; name another one")
    make_folder(target.parent)
    temporary = target.parent / f".warpgs-{secrets.token_hex(8)}.tmp"
    make_folder(temporary)
    try:
        yield temporary
        try:
            if target.is_dir():
                remove_leftovers(target)
                target.rmdir()
            os.rename(temporary, target)
        except OSError as e:
            raise ResourceError(f"{folder}: cannot be made ({e.strerror or e}). {_remedy(e)}") from e
        sync_folder(target.parent)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def _replace(temporary: Path, path: Path) -> None:
    """Put a file in the place of another; on Windows, where no open file can be replaced, a few times."""
    for pause in PAUSES if WINDOWS else ():
        try:
            os.replace(temporary, path)
            return
        except PermissionError:
            time.sleep(pause)
    os.replace(temporary, path)


def _remedy(error: OSError) -> str:
    if WINDOWS and isinstance(error, PermissionError):
        return "Close the programs that have it open, or write elsewhere"
    return "Free some disk space, or write elsewhere"


def sync_folder(folder: Path) -> None:
    """Have the disk keep the names in a folder through a power failure, where the system can: Windows has no such call.

    Raises:
        ResourceError: The disk fails.
    """
    if WINDOWS:
        return
    try:
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as e:
        if e.errno not in NO_FOLDER_SYNC:
            raise ResourceError(
                f"{folder}: was written into, but the disk does not confirm it ({e.strerror or e}); check the disk, and what "
                "was written last"
            ) from e


def write_bytes(path: Path, *chunks: bytes | memoryview) -> None:
    """Replace a file by chunks of bytes, once all of them are on disk.

    Raises:
        ResourceError: The disk is full or the folder not writable; what was there before is untouched.
    """
    with replacing(path, size=sum(map(len, chunks))) as temporary, temporary.open("xb") as f:
        for chunk in chunks:
            f.write(chunk)


def write_text(path: Path, text: str) -> None:
    """Replace a text file (UTF-8) as `write_bytes` does; bytes of names that are no text are `readable` in it."""
    write_bytes(path, readable(text).encode())


def readable(text: str) -> str:
    r"""Return text with the bytes of names that are not UTF-8, and halves of characters, as codes: ``b\xe4r``."""
    escaped = UNDECODABLE.sub(lambda byte: f"\\x{ord(byte[0]) - 0xDC00:02x}", text)
    return escaped.encode("utf-8", "backslashreplace").decode()


def write_json(path: Path, values: object) -> None:
    """Replace a JSON file as `write_bytes` does; NaN and infinity become null, which JSON can hold."""
    write_text(path, json.dumps(plain(values), indent=1) + "\n")


def plain(value: object) -> object:
    """Return a value that JSON can hold: tuples become lists, NaN and infinity null."""
    if isinstance(value, float) and not (value - value == 0):
        return None
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(v) for v in value]
    return value


def make_folder(folder: Path) -> bool:
    """Make a folder, and those above it, where it is not there; return whether it was made.

    Raises:
        ResourceError: It cannot be made.
    """
    try:
        made = not os.path.exists(folder)  # False for what Path.exists raises an error about
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as e:
        raise ResourceError(
            f"{folder}: cannot be written, as the folder cannot be made ({e.strerror or e}); "
            f"{'free some disk space, or ' if e.errno in FULL else ''}choose another folder"
        ) from e
    return made


def is_empty(folder: Path) -> bool:
    """Return whether a folder holds nothing but what an interrupted write or its lock left there.

    Raises:
        ResourceError: It cannot be looked into.
    """
    try:
        return all(p.name == LOCK or OWN_NAMES.fullmatch(p.name) for p in folder.iterdir())
    except OSError as e:
        raise ResourceError(
            f"{folder}: cannot be looked into ({e.strerror or e}); choose a folder that you may read and write"
        ) from e


def remove_leftovers(folder: Path) -> None:
    """Remove temporary files and folders of writers that were killed; for who holds the folder, as no other writes there.

    One that cannot be removed stays: it is in nobody's way.
    """
    with contextlib.suppress(OSError):
        for path in folder.iterdir():
            if OWN_NAMES.fullmatch(path.name):
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
                else:
                    with contextlib.suppress(OSError):
                        path.unlink()
