"""Description of the machine, the versions and the commit of a measurement."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch
import warp

from warpgs.runtime.device_memory import installed_bytes
from warpgs.runtime.processor import processor_name


def _commit() -> str | None:
    """The commit of this checkout, marked where files differ from it; None outside a repository."""
    command = ["git", "describe", "--always", "--abbrev=12", "--dirty", "--exclude=*"]
    try:
        done = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def describe(device: torch.device) -> dict:
    """Name, cores, memory, versions, commit and date."""
    versions = {"python": platform.python_version(), "torch": torch.__version__, "warp": warp.config.version}
    try:
        versions["gsplat"] = version("gsplat")
    except PackageNotFoundError:
        pass
    record = {
        "device": device.type,
        "name": torch.cuda.get_device_name(device) if device.type == "cuda" else processor_name(),
        "processor": processor_name(),
        "cores": os.cpu_count(),
        "threads": torch.get_num_threads(),
        "omp_wait_policy": os.environ.get("OMP_WAIT_POLICY"),
        "memory_gib": round(installed_bytes(torch.device("cpu")) / 2**30, 1),
    }
    if device.type == "cuda":
        record["device_memory_gib"] = round(torch.cuda.get_device_properties(device).total_memory / 2**30, 1)
        versions["cuda"] = torch.version.cuda
    return record | {"versions": versions, "commit": _commit(), "date": datetime.now(UTC).strftime("%Y-%m-%d")}
