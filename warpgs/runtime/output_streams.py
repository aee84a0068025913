"""Output that cannot be written: one line on stderr, and the command continues.

Causes are a closed pipe, a full disk, a closed descriptor or a closed terminal. After the first failed write, all output goes
to the null device, including that of native libraries.
"""

from __future__ import annotations

import contextlib
import errno
import io
import os
import sys
from collections.abc import Iterator
from typing import Any, TextIO, cast

from warpgs.errors import ResourceError
from warpgs.files import FULL

NAMES = ("stdin", "stdout", "stderr")
"""Standard streams by their descriptors."""


def open_missing_descriptors() -> None:
    """Open the null device instead of a closed stdin, stdout or stderr.

    Otherwise the next file that is opened gets the free descriptor, and output is written into that file.
    """
    for number in range(len(NAMES)):
        try:
            os.fstat(number)
        except OSError:
            _send_to_null(number)


def _send_to_null(number: int) -> None:
    """Point a descriptor at the null device; leave it unchanged if no further descriptor can be opened."""
    with contextlib.suppress(OSError):
        null = os.open(os.devnull, os.O_RDWR)
        if null == number:  # it was closed, and the lowest free descriptor
            os.set_inheritable(number, True)
            return
        os.dup2(null, number)
        os.close(null)


def is_gone_reader(error: BaseException | None) -> bool:
    """Return whether a write failed because the pipe's reader has gone, as with ``| head``."""
    return isinstance(error, BrokenPipeError) or (
        sys.platform == "win32" and isinstance(error, OSError) and error.errno == errno.EINVAL
    )


def reason(error: BaseException) -> str:
    """Return why a write failed, as the system reports it."""
    return (isinstance(error, OSError) and error.strerror) or str(error)


class CarefulStream:
    """A text stream that does not raise if it cannot be written: the first error is kept, and later writes are dropped."""

    def __init__(self, stream: TextIO | None, name: str, goes_on: bool = True):
        """Wrap a stream.

        Args:
            stream: The stream; None for one whose descriptor was closed when Python started.
            name: stdout or stderr.
            goes_on: True to print on stderr at once that the command continues without this stream.
        """
        self.closed_at_start = stream is None
        self.stream: TextIO = io.StringIO() if stream is None else stream
        self.name, self.goes_on = name, goes_on
        self.failure: BaseException | None = None

    def write(self, text: str) -> int:
        """Write text, if the stream takes it; return its length."""
        try:
            if self.closed_at_start:
                raise OSError(errno.EBADF, os.strerror(errno.EBADF))
            if self.failure is None:
                self.stream.write(text)
        except (OSError, ValueError) as e:
            self._lose(e)
        return len(text)

    def flush(self) -> None:
        """Flush the buffer, if the stream takes it."""
        try:
            if self.failure is None:
                self.stream.flush()
        except (OSError, ValueError) as e:
            self._lose(e)

    def writelines(self, lines: Any) -> None:
        """Write several texts."""
        for line in lines:
            self.write(line)

    def _lose(self, error: OSError | ValueError) -> None:
        """Keep the first error, and point the descriptor at the null device: buffers are flushed once more when Python ends."""
        if isinstance(error, ValueError) and not isinstance(error, OSError) and not self.stream.closed:
            raise error
        if self.failure is not None:
            return
        self.failure = error
        if not self.closed_at_start:
            with contextlib.suppress(OSError, ValueError):
                _send_to_null(self.stream.fileno())
        if self.goes_on:
            say_lost(self.name, error)

    def __getattr__(self, name: str) -> Any:
        return getattr(self.stream, name)


def say_lost(name: str, error: BaseException) -> None:
    """Print on stderr that the command continues without stdout; a lost stderr cannot be reported."""
    if name == "stdout":
        _to_stderr(f"warpgs: stdout cannot be written ({reason(error)}); the command continues without it")


def _to_stderr(line: str) -> None:
    """Write a line to stderr, if that is possible."""
    if sys.stderr is not None:
        with contextlib.suppress(OSError, ValueError):
            print(line.encode("ascii", "backslashreplace").decode(), file=sys.stderr, flush=True)


class CarefulOutput:
    """Streams of a command, and their state."""

    def __init__(self, stdout: CarefulStream, stderr: CarefulStream, is_product: bool):
        """Keep both streams, and whether stdout is the command's only result."""
        self.stdout, self.stderr, self.is_product = stdout, stderr, is_product

    def exit_code(self, code: int) -> int:
        """Return ``code``, or the code of ResourceError if the command succeeded but its only result could not be written."""
        self.stdout.flush()
        self.stderr.flush()
        failure = self.stdout.failure
        if code or failure is None or not self.is_product or is_gone_reader(failure):
            return code
        full = isinstance(failure, OSError) and failure.errno in FULL
        remedy = "free some disk space, or send the output elsewhere" if full else "send the output elsewhere"
        _to_stderr(f"warpgs: stdout cannot be written ({reason(failure)}); {remedy}")
        return ResourceError.exit_code


@contextlib.contextmanager
def careful_output(is_product: bool) -> Iterator[CarefulOutput]:
    """Replace stdout and stderr by streams whose writes do not raise.

    Args:
        is_product: True if stdout is the command's only result. Then a failure to write fails the command,
            unless the reader of a pipe has closed it. Otherwise the command continues with one line on stderr.
    """
    open_missing_descriptors()
    before = sys.stdout, sys.stderr
    streams = CarefulStream(before[0], "stdout", not is_product), CarefulStream(before[1], "stderr", False)
    sys.stdout, sys.stderr = (cast(TextIO, s) for s in streams)
    try:
        yield CarefulOutput(*streams, is_product)
    finally:
        for stream in streams:
            stream.flush()
        sys.stdout, sys.stderr = before


def careful(stream: TextIO) -> TextIO:
    """Return a stream whose writes do not raise, wrapped unless it already is; for displays that draw during a fit."""
    return stream if isinstance(stream, CarefulStream) else cast(TextIO, CarefulStream(stream, "stdout"))
