"""The calls that change files below a folder, numbered as they come: each is handed to a function before it is made.

Python's own functions are replaced while a block runs, so that every call is seen, those of `pathlib` and `os.fdopen` included;
what libraries in C write past Python is not.
"""

from __future__ import annotations

import builtins
import contextlib
import io
import os
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest import mock

from warpgs import folders
from warpgs.report.progress import EventLog

KINDS = ("open", "write", "fsync", "replace", "unlink", "mkdir", "rmdir", "lock", "truncate", "step")


@dataclass(frozen=True)
class Call:
    """One call, not made yet."""

    number: int
    """Its number among all calls, from 1."""
    kind: str
    """One of `KINDS`; ``step`` is the log's line of a training step, at its end, or one of another process."""
    path: Path
    """What it changes; for a replacement what is put in place, and for ``fsync`` the folder of all."""
    source: Path | None = None
    """File that a replacement moves."""
    half: Callable[[], int] | None = None
    """For a write: makes half of it, and returns how many bytes that is."""
    size: int = 0
    """Bytes of a write."""


class _Calls:
    """Numbers calls below a folder."""

    def __init__(self, root: Path, before: Callable[[Call], int | None]):
        self.root, self.before, self.count = os.path.realpath(root), before, 0
        self.lock = threading.Lock()
        self.descriptors: dict[int, str] = {}

    def below(self, path: Any, at: int | None = None) -> str | None:
        """Return the full path of what lies below the folder, from an open folder where one is given; None for all else."""
        if isinstance(path, int):
            return self.descriptors.get(path)
        full = os.path.abspath(os.path.join(path_of(at) if at is not None else "", os.fsdecode(path)))
        # a file's own name may be a link, the folders above it are not
        full = os.path.join(os.path.realpath(os.path.dirname(full)), os.path.basename(full))
        return full if full.startswith(self.root + os.sep) or full == self.root else None

    def note(self, kind: str, path: str, **more: Any) -> int | None:
        """Hand on a call that is about to be made, one at a time."""
        with self.lock:
            self.count += 1
            return self.before(Call(self.count, kind, Path(path), **more))


def path_of(descriptor: int) -> str:
    if sys.platform == "darwin":
        import fcntl

        return os.fsdecode(fcntl.fcntl(descriptor, fcntl.F_GETPATH, bytes(1024)).rstrip(b"\0"))
    return os.readlink(f"/proc/self/fd/{descriptor}")


class _Raw(io.FileIO):
    """A file whose writes are handed on."""

    calls: _Calls
    where: str

    def write(self, data: Any) -> int:
        view = memoryview(data).cast("B")
        write = super().write
        made = self.calls.note("write", self.where, half=lambda: write(view[: (len(view) + 1) // 2]), size=len(view))
        return super().write(view) if made is None else made

    def truncate(self, size: int | None = None) -> int:
        self.calls.note("truncate", self.where)
        return super().truncate(size)


def _open(calls: _Calls, real: Callable[..., Any]) -> Callable[..., Any]:
    def opened(file: Any, mode: str = "r", buffering: int = -1, *rest: Any, **more: Any) -> Any:
        where = calls.below(file)
        if where is None or "b" not in mode or not set(mode) & set("wxa+") or more.get("opener"):  # that opens by os.open
            return real(file, mode, buffering, *rest, **more)
        if not isinstance(file, int):
            calls.note("open", where)
        raw = _Raw(file, mode.replace("b", ""), closefd=more.get("closefd", True))
        raw.calls, raw.where = calls, where
        if buffering == 0:
            return raw
        return (io.BufferedRandom if "+" in mode else io.BufferedWriter)(raw)

    return opened


def _os_open(calls: _Calls, real: Callable[..., int]) -> Callable[..., int]:
    def opened(path: Any, flags: int, *rest: Any, **more: Any) -> int:
        where = calls.below(path, more.get("dir_fd"))
        if where is not None and flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT):
            calls.note("open", where)
        descriptor = real(path, flags, *rest, **more)
        calls.descriptors.pop(descriptor, None)
        if where is not None:
            calls.descriptors[descriptor] = where
        return descriptor

    return opened


def _on_path(calls: _Calls, kind: str, real: Callable[..., Any]) -> Callable[..., Any]:
    def called(path: Any, *rest: Any, **more: Any) -> Any:
        where = calls.below(path, more.get("dir_fd"))
        if where is not None:
            calls.note(kind, where)
        return real(path, *rest, **more)

    return called


def _moved(calls: _Calls, real: Callable[..., Any]) -> Callable[..., Any]:
    def moved(source: Any, target: Any, **more: Any) -> Any:
        where = calls.below(target, more.get("dst_dir_fd"))
        if where is not None:
            at = more.get("src_dir_fd")
            calls.note("replace", where, source=Path(path_of(at) if at is not None else "", os.fsdecode(source)))
        return real(source, target, **more)

    return moved


def _on_descriptor(calls: _Calls, kind: str, real: Callable[..., Any]) -> Callable[..., Any]:
    def called(descriptor: Any, *rest: Any, **more: Any) -> Any:
        calls.note(kind, calls.root)
        return real(descriptor, *rest, **more)

    return called


def _step(calls: _Calls, real: Callable[..., None]) -> Callable[..., None]:
    def written(log: EventLog, **values: Any) -> None:
        real(log, **values)
        calls.note("step", str(log.path))

    return written


def _lines(calls: _Calls, real: Callable[..., Iterator[str]]) -> Callable[..., Iterator[str]]:
    def lines(*words: Any, **more: Any) -> Iterator[str]:
        for line in real(*words, **more):
            calls.note("step", calls.root)
            yield line

    return lines


@contextlib.contextmanager
def numbered(root: Path, before: Callable[[Call], int | None], talker: Any = None) -> Iterator[None]:
    """Hand every call that changes something below a folder to a function, which may raise, or end the process.

    Args:
        root: The folder, which need not be there yet.
        before: Takes a call before it is made; what it returns for a write stands for that write's result.
        talker: Module whose `python_lines` reads what another process says; each line is a step, too.
    """
    calls = _Calls(root, before)
    opened = _open(calls, io.open)
    with contextlib.ExitStack() as stack:
        for owner, name, stand_in in (
            (io, "open", opened),
            (builtins, "open", opened),
            (os, "open", _os_open(calls, os.open)),
            (os, "replace", _moved(calls, os.replace)),
            (os, "rename", _moved(calls, os.rename)),
            (os, "unlink", _on_path(calls, "unlink", os.unlink)),
            (os, "remove", _on_path(calls, "unlink", os.remove)),
            (os, "mkdir", _on_path(calls, "mkdir", os.mkdir)),
            (os, "rmdir", _on_path(calls, "rmdir", os.rmdir)),
            (os, "truncate", _on_path(calls, "truncate", os.truncate)),
            (os, "fsync", _on_descriptor(calls, "fsync", os.fsync)),
            (folders, "lock_descriptor", _on_descriptor(calls, "lock", folders.lock_descriptor)),
            (EventLog, "write", _step(calls, EventLog.write)),
        ):
            stack.enter_context(mock.patch.object(owner, name, stand_in))
        if talker is not None:
            stack.enter_context(mock.patch.object(talker, "python_lines", _lines(calls, talker.python_lines)))
        yield
