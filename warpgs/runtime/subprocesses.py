"""Python processes of our own, which import nothing from the folder that warpgs was called in."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile


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
