"""Other processes. Python processes import nothing from the folder that warpgs was called in; no shell is started."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from warpgs.temporary import shared_locks, temporary_folder

ENDS_WITH_PARENT = (
    "import os as _os, threading as _threading\n"
    "_threading.Thread(target=lambda: (_os.read(0, 1), _os._exit(1)), daemon=True).start()\n"
)
"""Beginning of a program that ends once its stdin ends."""


def end_with_parent() -> None:
    """Have this process end with its parent, even if the parent is killed: the stdin of this process ends then."""
    threading.Thread(target=lambda: (os.read(0, 1), os._exit(1)), daemon=True).start()


@contextlib.contextmanager
def _stdin_until_our_end() -> Iterator[int]:
    """Give a child an empty stdin, which closes at the end of the block or of this process; the child then ends."""
    read, write = os.pipe()
    try:
        yield read
    finally:
        os.close(read)
        os.close(write)


def run_python(
    code: str, *arguments: str, timeout: float, environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run Python code in another process, and return its exit code and its output.

    The process works in an empty folder that is removed afterwards, and ends when this process is killed. Neither it nor its
    children import modules from the current folder (``-P``, PYTHONSAFEPATH), which may be an untrusted scene with a numpy.py.

    Args:
        code: The code.
        arguments: Its ``sys.argv[1:]``; paths must be absolute.
        timeout: Seconds until the process is ended.
        environment: Variables in addition to those of this process.

    Raises:
        subprocess.TimeoutExpired: The process took too long.
    """
    with temporary_folder() as folder, shared_locks() as locks, _stdin_until_our_end() as stdin:
        return subprocess.run(
            [sys.executable, "-P", "-c", ENDS_WITH_PARENT + code, *arguments],
            env={**os.environ, "PYTHONSAFEPATH": "1", "PYTHONIOENCODING": "utf-8", **(environment or {})},
            cwd=folder.path,
            stdin=stdin,
            pass_fds=locks,
            capture_output=True,
            text=True,
            encoding="utf-8",
            errors="replace",
            timeout=timeout,
            check=False,
        )


class ProcessFailed(Exception):
    """A process that ended with another exit code than 0."""

    def __init__(self, code: int, errors: str):
        """Keep the exit code, negative for a signal, and the text that the process wrote to stderr."""
        super().__init__(f"exit code {code}")
        self.code, self.errors = code, errors


def _environment(more: dict[str, str] | None) -> dict[str, str]:
    """Return variables with which a process imports this package as this process does, and nothing from the current folder."""
    home = str(Path(__file__).parents[2])
    search = os.pathsep.join(p for p in (home, os.environ.get("PYTHONPATH", "")) if p)
    own = {"PYTHONPATH": search, "PYTHONSAFEPATH": "1", "PYTHONIOENCODING": "utf-8"}
    return {**os.environ, **own, **(more or {})}


def python_lines(module: str, *arguments: str, folder: Path, environment: dict[str, str] | None = None) -> Iterator[str]:
    """Run a module of this package in another process, and yield the lines of its stdout as they come.

    As in `run_python`, the process does not import modules from its folder. It ends when its output is no longer read.
    The module calls `end_with_parent`, so that the process ends when this one is killed.

    Args:
        module: Full name of the module, run as ``__main__``.
        arguments: Its ``sys.argv[1:]``; paths must be absolute.
        folder: Folder to work in.
        environment: Variables in addition to those of this process.

    Raises:
        ProcessFailed: The process ended with another exit code than 0.
    """
    with tempfile.TemporaryFile() as errors, shared_locks() as locks, _stdin_until_our_end() as stdin:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments], env=_environment(environment), cwd=folder,
            stdin=stdin, stdout=subprocess.PIPE, stderr=errors, text=True, encoding="utf-8", errors="replace", pass_fds=locks,
        )  # fmt: skip
        try:
            assert process.stdout is not None
            yield from process.stdout
            if process.wait():
                errors.seek(0)
                raise ProcessFailed(process.returncode, errors.read().decode("utf-8", "replace").strip())
        finally:
            process.kill()
            process.wait()


class ProgramResult(NamedTuple):
    """Outcome of a program."""

    code: int
    """Exit code; 1 if the program could not be run or took too long."""
    output: str
    errors: str
    """Text of stderr, or the reason why the program could not be run or was ended."""


def run_program(program: str, *options: str, stdin: str, timeout: float, hidden: str) -> ProgramResult:
    """Run a program that starts this package elsewhere, and return its outcome.

    Args:
        program: Name of the program, searched in PATH.
        options: Its arguments.
        stdin: Text for its stdin.
        timeout: Seconds until the program is ended.
        hidden: Prefix of the environment variables that are not passed on.
    """
    environment = {k: v for k, v in _environment(None).items() if not k.startswith(hidden)}
    try:
        done = subprocess.run(
            [program, *options], input=stdin, env=environment, capture_output=True, text=True, encoding="utf-8",
            errors="replace", timeout=timeout, check=False,
        )  # fmt: skip
    except (OSError, subprocess.TimeoutExpired) as e:
        return ProgramResult(1, "", str(e))
    return ProgramResult(done.returncode, done.stdout, done.stderr)


class PythonWorker:
    """A process that runs a module of this package, takes lines on its stdin and answers on its stdout.

    As in `run_python`, the process does not import modules from its folder. Only its parent handles Ctrl-C. The process
    stops at the end of its stdin, which also ends if the parent is killed.
    """

    def __init__(self, module: str, *arguments: str, environment: dict[str, str] | None = None):
        """Start the process.

        Args:
            module: Full name of the module, run as ``__main__``.
            arguments: Its ``sys.argv[1:]``.
            environment: Variables in addition to those of this process.
        """
        self._errors = tempfile.TemporaryFile()  # closed by `end`
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments], env=_environment(environment), stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, stderr=self._errors, text=True, encoding="utf-8", errors="replace", start_new_session=True,
        )  # fmt: skip

    @property
    def number(self) -> int:
        """Number of the process."""
        return self._process.pid

    def send(self, line: str) -> bool:
        """Send a line; return False where the process has ended."""
        assert self._process.stdin is not None
        try:
            self._process.stdin.write(f"{line}\n")
            self._process.stdin.flush()
        except (OSError, ValueError):
            return False
        return True

    def lines(self) -> Iterator[str]:
        """Yield the lines that the process answers, until the process ends."""
        assert self._process.stdout is not None
        yield from self._process.stdout

    def end(self, seconds: float) -> tuple[int, str]:
        """Close the stdin of the process, and kill it if it still runs after ``seconds``.

        Returns its exit code, and the last 2000 bytes of its stderr as text.
        """
        with contextlib.suppress(OSError):
            if self._process.stdin is not None:
                self._process.stdin.close()
        try:
            self._process.wait(seconds)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        if self._errors.closed:
            return self._process.returncode, ""
        with self._errors:
            self._errors.seek(0, os.SEEK_END)
            self._errors.seek(max(0, self._errors.tell() - 2000))
            return self._process.returncode, self._errors.read().decode("utf-8", "replace").strip()
