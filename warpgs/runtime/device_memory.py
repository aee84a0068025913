"""Installed and free memory of a device, on any system and within the limits of a container."""

from __future__ import annotations

import errno
import functools
from collections.abc import Iterator
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, NamedTuple

from warpgs.runtime.terminal import say

if TYPE_CHECKING:
    import torch

ASSUMED_BYTES = 2 * 2**30
"""Assumed memory of a machine that does not report it [bytes]: the memory of a small machine."""

OWN_CGROUPS = Path("/proc/self/cgroup")
CGROUPS = Path("/sys/fs/cgroup")


NO_MEMORY = (
    "out of memory", "can't allocate memory", "cannot allocate memory", "not enough memory", "insufficient memory",
    "failed to allocate", "bad_alloc", "bad allocation", "unable to allocate",
)  # fmt: skip
"""Parts of the messages of torch, Warp, OpenCV, ONNX Runtime, numpy and C++ on lack of memory, in lower case."""


class Memory(NamedTuple):
    """Installed and available bytes; cached files that the system would drop count as available."""

    installed: int
    available: int


def available_bytes(device: torch.device) -> int:
    """Return the memory that is free now on a device [bytes]; on CUDA including memory that torch holds unused."""
    if device.type == "cuda":
        import torch

        free, _ = torch.cuda.mem_get_info(device)
        return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return _machine_or_assumed().available


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error, or one of its causes, reports too little memory."""
    found: BaseException | None = error
    while found is not None:
        text = str(found).lower()
        if isinstance(found, MemoryError) or getattr(found, "errno", None) == errno.ENOMEM or any(w in text for w in NO_MEMORY):
            return True
        found = found.__cause__
    return False


def no_memory_message(error: BaseException, purpose: str = "", *, fitting: bool = True) -> str:
    """Return the message for a lack of memory, with remedies; these name flags of the fit if ``fitting`` is True.

    ``purpose`` may state the use of the memory, such as " for step 3".
    """
    remedy = (
        "Reduce the memory of the fit with --memory-limit or --downscale, or end other programs; --resume continues from the "
        "last checkpoint"
        if fitting
        else "End other programs, and try again"
    )
    reason = (str(error).strip() or type(error).__name__).splitlines()[0].partition(" GPU ")[0].rstrip(".")
    return f"out of memory{purpose} ({reason[:200]}). {remedy}"


@functools.cache
def installed_bytes(device: torch.device) -> int:
    """Return the memory of a device [bytes], on a CPU at most the limit of the container; queried once."""
    if device.type == "cuda":
        import torch

        return torch.cuda.get_device_properties(device).total_memory
    return _machine_or_assumed().installed


def machine_memory() -> Memory | None:
    """Return the memory of the machine within the limits of the container, if any; None if unknown."""
    found = [m for m in (_system_memory(), container_memory()) if m is not None]
    if not found:
        return None
    return Memory(min(m.installed for m in found), max(0, min(m.available for m in found)))


def container_memory(own: Path | None = None, mount: Path | None = None) -> Memory | None:
    """Return the lowest memory limit of this process's control groups, and the least memory that is left below a limit.

    Only Linux has control groups; on other systems, and without a limit, this is None. Both versions of control groups are
    read, from the process's own group up to the root, since the limits of all of them apply (kernel documentation, cgroup-v2
    "Memory" and cgroup-v1 "Memory Resource Controller"). Cached files that were not used lately count as free: the kernel drops
    them first.

    Args:
        own: File that lists the process's groups; None for /proc/self/cgroup.
        mount: Folder in which groups are mounted; None for /sys/fs/cgroup.
    """
    limits, rooms = [], []
    for folder, limit_name, used_name, cache_name in _groups(own or OWN_CGROUPS, mount or CGROUPS):
        limit, used = _number(folder / limit_name), _number(folder / used_name)
        if limit is None or limit >= 2**60:  # version 1 writes "no limit" as a number near 2^63
            continue
        limits.append(limit)
        rooms.append(limit if used is None else limit - max(0, used - _row(folder / "memory.stat", cache_name)))
    return Memory(min(limits), min(rooms)) if limits else None


def _groups(own: Path, mount: Path) -> Iterator[tuple[Path, str, str, str]]:
    """Yield each memory group's folder, with the names of its limit file, its use file and a row of its ``memory.stat``."""
    rows = [row.split(":", 2) for row in _text(own).splitlines()]
    paths = {"": "/", "memory": "/"} | {c: p for _, names, p in (r for r in rows if len(r) == 3) for c in names.split(",")}
    versions = {
        "": (mount, "memory.max", "memory.current", "inactive_file"),
        "memory": (mount / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    }
    for controller, (root, *names) in versions.items():
        parts = PurePosixPath(paths[controller]).parts[1:]
        # a path that leaves the mounted tree is a group that cannot be seen from here
        for end in range(0 if ".." in parts else len(parts), -1, -1):
            yield root.joinpath(*parts[:end]), *names


def _system_memory() -> Memory | None:
    """Return the memory that psutil reports; None where psutil is missing or the system denies access."""
    try:
        import psutil

        found = psutil.virtual_memory()
        return Memory(int(found.total), int(found.available))
    except (ImportError, AttributeError, KeyError, OSError, RuntimeError, ValueError):
        return None


def _machine_or_assumed() -> Memory:
    found = machine_memory()
    if found is None:
        _say_assumed()
        return Memory(ASSUMED_BYTES, ASSUMED_BYTES)
    return found


@functools.cache
def _say_assumed() -> None:
    say(
        f"warpgs: the memory of this system is unknown (neither psutil nor a container reports it); "
        f"{ASSUMED_BYTES / 2**30:.0f} GiB are assumed",
        error=True,
    )


def _text(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except (OSError, ValueError):
        return ""


def _number(path: Path) -> int | None:
    """Return the number in a file; None for `max` or a missing file."""
    text = _text(path).strip()
    return int(text) if text.isdecimal() else None


def _row(path: Path, name: str) -> int:
    """Return the number behind a name in a file of rows, 0 where it is missing."""
    rows = (row.split() for row in _text(path).splitlines())
    return next((int(r[1]) for r in rows if len(r) == 2 and r[0] == name and r[1].isdecimal()), 0)
