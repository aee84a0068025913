"""The processor: its name, and the cores that this process may use."""

from __future__ import annotations

import os
import platform
from pathlib import Path

CPU_INFO = Path("/proc/cpuinfo")


def usable_cores() -> int:
    """Return the number of cores that this process may run on, at least 1; all cores if that is unknown."""
    try:
        return len(os.sched_getaffinity(0)) or 1  # missing on macOS and Windows
    except (AttributeError, OSError):
        return os.cpu_count() or 1


def processor_name() -> str:
    """Return the processor's model where the system names it, else its kind; never empty."""
    try:
        for line in CPU_INFO.read_text("utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass  # only on Linux
    return platform.processor() or platform.machine() or "unknown"
