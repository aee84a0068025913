"""Who may write: one writer a folder or a file, and folders that only their owner can read."""

import contextlib
import datetime
import hashlib
import os
import platform
import shlex
import stat
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from warpgs.errors import FolderHeldError, ResourceError, UsageError, explained
from warpgs.files import LOCK, remove_leftovers, writable, writing_into
from warpgs.folders import LOCKED, Folder, Temporary, cache_home, lock, open_folder, sweep, sweep_temporary_files, unlock


def open_to_others(folder: Path, depth: int = 0) -> Path | None:
    """Return the first path through which another user can change a folder's contents, or None."""
    # On Windows nothing is checked: mode bits have no meaning there, and the folder of a user's caches is private. Root
    # is trusted, as root may do anything, and so is the owner of the whole file system.
    if not hasattr(os, "getuid"):
        return None
    trusted = {os.getuid(), 0, Path(folder.anchor).stat().st_uid}
    for above in folder.parents:  # users with write access there can replace this folder
        found = above.stat()
        sticky = found.st_mode & stat.S_ISVTX  # as /tmp: users can move only their own files
        if found.st_uid not in trusted or (_writable_by_others(found, trusted) and not sticky):
            return above
    if _writable_by_others(folder.stat(), trusted):
        return folder
    if not folder.stat().st_mode & (stat.S_IXGRP | stat.S_IXOTH):
        return None  # other users cannot enter it
    for level in range(1, depth + 1):
        for path in folder.glob("/".join("*" * level)):
            with contextlib.suppress(FileNotFoundError):  # another process has put its new file in place
                found = path.lstat()
                if stat.S_ISLNK(found.st_mode) or _writable_by_others(found, trusted):
                    return path
    return None


def _writable_by_others(found: os.stat_result, trusted: set[int]) -> bool:
    if found.st_uid not in trusted or found.st_mode & stat.S_IWOTH:
        return True
    return bool(found.st_mode & stat.S_IWGRP) and not _is_own_group(found.st_gid)


def _is_own_group(gid: int) -> bool:
    """Return whether a group belongs to this user alone: many systems make a group per user, with the user's name or number."""
    import grp
    import pwd

    with contextlib.suppress(KeyError):
        name, group = pwd.getpwuid(os.getuid()).pw_name, grp.getgrgid(gid)
        return set(group.gr_mem) <= {name} and (gid == os.getuid() or group.gr_name == name)
    return False


MOST_LETTERS, MOST_BYTES = 200, 2**11
"""Length at which a command is cut short in a lock file, and bytes of the file that are read."""


@contextlib.contextmanager
def hold_folder(folder: Path, *parts: str, name: str = LOCK) -> Iterator[list[str]]:
    """Lock a folder, and make it if it is missing, so that no other process writes into it during the block."""
    # The system releases the lock when the process that holds it ends, even if it is killed. The lock also excludes
    # processes in other containers. The lock file names the holder. Leftovers of killed writers are removed from the
    # folder and from the system's temporary files. In the block nothing below the folder is written through a link
    # (`output_folder`). If an error ends the block, a folder that was made here is removed if it is still empty; other
    # folders are never removed.
    sweep_temporary_files()
    with writing_into(folder) as made:
        try:
            with open_folder(folder) as opened, _held(opened, name) as locked:
                for part in (".", *parts):
                    remove_leftovers(folder / part)
                note = f"{folder}: its file system has no locks; do not start a second process that writes there"
                yield [] if locked else [note]
        except BaseException:
            if made:
                with contextlib.suppress(OSError), open_folder(folder.absolute().parent) as above:
                    above.rmdir(folder.name)  # where it is not empty, or in use, it stays
            raise


def hold_file(path: Path) -> contextlib.AbstractContextManager[list[str]]:
    """Lock a file that the block writes, in a folder that no process holds; see `hold_folder`."""
    # other processes may write other files of the folder; a lock of a killed process is swept as other leftovers are
    if os.path.isdir(path) or len(os.fsencode(path.name)) > 255:  # before the work, not when the file is written
        raise UsageError(f"{path}: is a folder, or the name is too long; give the name of the file to write")
    check_free(path.parent)
    return hold_folder(path.parent, name=f".warpgs-{hashlib.sha256(os.fsencode(path.name)).hexdigest()[:16]}.tmp{LOCKED}")


def check_free(folder: Path) -> None:
    """Check that no process holds a folder, and remove a killed one's lock; a folder that cannot be read counts as free."""
    with contextlib.suppress(OSError), open_folder(folder) as opened:
        descriptor, locked = _locked(opened, LOCK, os.O_RDWR)
        if locked:
            unlock(opened, LOCK, descriptor)
        else:
            os.close(descriptor)


@contextlib.contextmanager
def _held(folder: Folder, name: str) -> Iterator[bool]:
    """Hold a lock in a folder; yields whether the file system has locks."""
    while True:
        with writable(folder.path, f"make the folder and its lock {name} writable, or choose another folder"):
            descriptor, locked = _locked(folder, name, os.O_RDWR | os.O_CREAT)
        # the last holder may have removed the lock file between the two calls; then other processes lock a new file
        if not locked or os.fstat(descriptor).st_nlink:
            break
        os.close(descriptor)
    try:
        # a full disk: the lock holds all the same
        with contextlib.suppress(OSError), open(descriptor, "r+b", buffering=0, closefd=False) as file:
            file.truncate(0)
            file.write(_signature())
        yield bool(locked)
    finally:
        unlock(folder, name, descriptor)


def _locked(folder: Folder, name: str, flags: int) -> tuple[int, bool | None]:
    """Open and lock a lock file of a folder; return its descriptor, and None where its file system has no locks."""
    descriptor = folder.open_regular(name, flags)
    try:
        locked = lock(descriptor)
        if locked is False and name != LOCK:  # perhaps a sweep has it, for a moment
            time.sleep(0.1)
            locked = lock(descriptor)
        if locked is False:
            os.lseek(descriptor, 1, os.SEEK_SET)
            holder = os.read(descriptor, MOST_BYTES).decode("utf-8", "replace") or "another process"
            raise FolderHeldError(f"{folder.path}: {holder} is writing there. Wait for its end, or choose another folder")
        return descriptor, locked
    except BaseException:
        os.close(descriptor)
        raise


def _signature() -> bytes:
    """Return the text of a lock file, which names its owner; Windows locks its first byte, which no other process may read."""
    program = Path(sys.argv[0])
    name = program.parent.name if program.name == "__main__.py" else program.name  # of `python -m warpgs`
    now, command = datetime.datetime.now().astimezone().isoformat(" ", "seconds"), shlex.join([name, *sys.argv[1:]])
    short = command if len(command) <= MOST_LETTERS else f"{command[:MOST_LETTERS]}..."
    return f"\nprocess {os.getpid()} on {platform.node()}, since {now}, `{short}`,".encode("utf-8", "replace")


@contextlib.contextmanager
def private_shared_folder(base: Path | None) -> Iterator[Path]:
    """Make a new folder with a random name that only this user can enter (mode 0700), and remove it after the block."""
    home = cache_home()
    if base is None and home is None:
        raise UsageError("--engine slurm needs a home folder for its job files; name another folder with --slurm-folder")
    base = (base or home / "warpgs" / "slurm").absolute()
    with contextlib.ExitStack() as stack:
        with explained(f"{base}: not writable", "name another private, shared --slurm-folder", kind=ResourceError):
            base.mkdir(mode=0o700, parents=True, exist_ok=True)
            base = base.resolve()
            if (others := open_to_others(base)) is not None:
                raise UsageError(f"{base}: other users can write to {others}; name a private, shared --slurm-folder")
            above = stack.enter_context(open_folder(base))
            sweep(above)
            made = stack.enter_context(Temporary(above))
            above.mkdir(made.name, 0o700)
        yield made.path
