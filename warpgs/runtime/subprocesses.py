"""Python processes of our own, which import nothing from the folder that warpgs was called in."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path


def run_python(
    code: str, *arguments: str, timeout: float, environment: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Run Python code in another process, and return its exit code and what it wrote.

    It works in an empty folder that is removed afterwards, and neither it nor what it starts looks for modules in the current
    folder (``-P``, PYTHONSAFEPATH): that may be a scene from anywhere, with a numpy.py in it.

    Args:
        code: What to run.
        arguments: Its ``sys.argv[1:]``; paths must be absolute.
        timeout: Seconds until it is ended.
        environment: Variables beside those of this process.

    Raises:
        subprocess.TimeoutExpired: It took too long.
    """
    with tempfile.TemporaryDirectory(prefix="warpgs-", ignore_cleanup_errors=True) as folder:
        return subprocess.run(
            [sys.executable, "-P", "-c", code, *arguments],
            env={**os.environ, "PYTHONSAFEPATH": "1", "PYTHONIOENCODING": "utf-8", **(environment or {})},
            cwd=folder,
            stdin=subprocess.DEVNULL,
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
        """Keep the exit code, negative for a signal, and what it wrote to stderr."""
        super().__init__(f"exit code {code}")
        self.code, self.errors = code, errors


def python_lines(module: str, *arguments: str, folder: Path, environment: dict[str, str] | None = None) -> Iterator[str]:
    """Run a module of this package in another process, and yield the lines of its stdout as they come.

    It looks for modules no more in its folder than `run_python` does, and it ends where nobody listens any more.

    Args:
        module: Full name of the module, run as ``__main__``.
        arguments: Its ``sys.argv[1:]``; paths must be absolute.
        folder: Folder to work in.
        environment: Variables beside those of this process.

    Raises:
        ProcessFailed: It ended with another exit code than 0.
    """
    home = str(Path(__file__).parents[2])  # of the package, wherever that was imported from
    search = os.pathsep.join(p for p in (home, os.environ.get("PYTHONPATH", "")) if p)
    own = {"PYTHONPATH": search, "PYTHONSAFEPATH": "1", "PYTHONIOENCODING": "utf-8"}
    with tempfile.TemporaryFile() as errors:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", module, *arguments], env={**os.environ, **own, **(environment or {})}, cwd=folder,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=errors, text=True, encoding="utf-8", errors="replace",
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
