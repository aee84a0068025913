"""The machine: processors, memory and its units, sizes that repeat from step to step, the cache of kernels."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import functools
import importlib.util
import math
import os
import platform
import re
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Any, TypeVar

from warpgs.errors import ResourceError, UsageError, explained
from warpgs.folders import cache_home, private_folder
from warpgs.locks import open_to_others
from warpgs.process import say

if TYPE_CHECKING:
    from concurrent.futures import Future

    import torch

T = TypeVar("T")


CPU_INFO = Path("/proc/cpuinfo")


def usable_cores() -> int:
    """Return the number of cores that this process may run on, at least 1; all cores if that is unknown."""
    with contextlib.suppress(AttributeError, OSError):
        return len(os.sched_getaffinity(0)) or 1  # missing on macOS and Windows
    return os.cpu_count() or 1


def wake_gpu() -> None:
    """Start the driver of the first CUDA device in a thread, if torch can use it: that takes most of a second."""

    def wake() -> None:
        folders = getattr(importlib.util.find_spec("torch"), "submodule_search_locations", ())
        with contextlib.suppress(OSError, AttributeError):  # what fails here fails in torch again, which says it
            if any(path.match("*torch_cuda*") for folder in folders for path in Path(folder, "lib").iterdir()):
                driver = ctypes.CDLL("nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1")
                if driver.cuInit(0) == 0:  # 0 is the first device, too; torch and Warp share its primary context
                    driver.cuDevicePrimaryCtxRetain(ctypes.byref(ctypes.c_void_p()), 0)

    threading.Thread(target=wake, name="driver", daemon=True).start()


M_TRIM_THRESHOLD, M_TOP_PAD, M_MMAP_THRESHOLD, M_MMAP_MAX, M_ARENA_MAX = -1, -2, -3, -4, -8
"""Options of glibc's mallopt: free memory at the end of a heap that it keeps, by which a heap grows, from which it maps an
allocation by itself [bytes]; number of such allocations; number of heaps, one for all threads or one for each."""


def _set_malloc(*options: tuple[int, int]) -> None:
    """Set options of glibc's memory, up to the first that it refuses; nothing elsewhere."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # no glibc
        all(ctypes.CDLL(None).mallopt(*option) for option in options)


@functools.cache
def keep_freed_memory() -> None:
    """Let glibc keep the memory that a step frees: the next step would map, and clear, the same pages again."""
    # older ones refuse this size; the trim threshold alone would map every tensor
    _set_malloc((M_MMAP_THRESHOLD, 2**26), (M_TRIM_THRESHOLD, 2**28))


def keep_all_freed_memory() -> None:
    """Let glibc keep all memory that this process frees, for all threads; call it before there are others."""
    # The system clears each page that is touched for the first time, one page at a time: threads that fill new arrays wait
    # for each other, a third of their time on two cores.
    keep_freed_memory()  # so that a step does not change the options again
    _set_malloc((M_ARENA_MAX, 1), (M_MMAP_MAX, 0), (M_TRIM_THRESHOLD, 2**31 - 1), (M_TOP_PAD, 2**26))


def return_freed_memory() -> None:
    """Let glibc return the memory that it keeps to the system, which then counts as free."""
    with contextlib.suppress(AttributeError, OSError, TypeError):  # no glibc
        ctypes.CDLL(None).malloc_trim(0)


MAX_THREADS = 16
"""Most threads of `background`: each holds the images of one view."""


@contextlib.contextmanager
def background(threads: int = 0) -> Iterator[Callable[..., Future[Any]]]:
    """Yield a function that starts a call in a thread, and waits while many others wait; in the end all calls are done."""
    from concurrent.futures import ThreadPoolExecutor

    jobs: list[Future[Any]] = []
    threads = threads or max(2, min(MAX_THREADS, usable_cores()))

    def start(function: Callable[..., T], *arguments: Any) -> Future[T]:
        jobs.append(pool.submit(function, *arguments))
        if len(jobs) > threads:
            jobs[-threads].result()  # not all arguments in memory at once
        return jobs[-1]

    with ThreadPoolExecutor(threads) as pool:
        try:
            yield start
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    for job in jobs:
        job.result()  # raises what the call raised


def in_background(function: Callable[..., T], arguments: Iterable[tuple[Any, ...]], threads: int = 0) -> list[T]:
    """Return a function's results in order, computed by threads while further arguments are made; few arguments wait."""
    with background(threads) as start:
        jobs = [start(function, *own) for own in arguments]
    return [j.result() for j in jobs]


def processor_name() -> str:
    """Return the processor's model where the system names it, else its kind; never empty."""
    found = re.search(r"^model name[^:\n]*:(.*)", _text(CPU_INFO), re.MULTILINE)  # only on Linux
    return (found and found[1].strip()) or platform.processor() or platform.machine() or "unknown"


UNITS = {"B": 1} | {f"{p}{u}": b**i for i, p in enumerate("KMGT", 1) for u, b in (("B", 1000), ("iB", 1024))}
"""Bytes of each unit by name."""


def parse_bytes(text: str) -> int:
    """Return a size such as 2GiB, 512 MB or 1.5GiB in bytes."""
    found = re.fullmatch(r"\s*([0-9]+(?:\.[0-9]+)?|\.[0-9]+)\s*([A-Za-z]+)\s*", text)
    units = {u.lower(): b for u, b in UNITS.items()}
    if not found or found[2].lower() not in units:
        raise UsageError(f"memory limit {text[:40]!r} is not a size: give a number and one of {', '.join(UNITS)}, such as 2GiB")
    size = float(found[1]) * units[found[2].lower()]
    if not 1 <= size < 2**63:
        raise UsageError(f"memory limit {text[:40]!r} must be at least one byte and less than 2^63")
    return int(size)


def format_bytes(size: float) -> str:
    """Return a size [bytes] as text for people to read."""
    for unit in ("B", "KiB", "MiB", "GiB"):
        if size < 1024:
            return f"{size:.0f} {unit}" if unit in ("B", "KiB") else f"{size:.1f} {unit}"
        size /= 1024
    return f"{size:.1f} TiB"


# Sizes of a training step, and the bytes that its parts need at each moment.
#
# Each part declares its bytes beside its allocations, in a function of `StepSizes`; the memory plan only adds them up.

FLOAT = 4
"""Bytes of a float32 or int32."""
BINNING, LOSS, BLENDING, PROJECTION, SAMPLING = "binning", "loss", "blending", "projection", "sampling"
"""Moments at which a step may need the most memory: while instances are sorted, while the loss and its gradient are computed,
in the backward passes of blending and of projection, and while a sampling event renders a view."""
STEP = (BINNING, LOSS, BLENDING, PROJECTION)
"""Moments of every step."""


@dataclass(frozen=True)
class StepSizes:
    """Sizes that determine the memory of a training step."""

    width: int
    """Width of the largest view [px]."""
    height: int
    """Height of the largest view [px]."""
    row: int
    """Bytes of one Gaussian's parameters."""
    views: int = 1
    """Number of views."""
    masked: bool = False
    """True if a view has a mask."""
    cutout: bool = False
    """True if the images have an alpha channel."""
    depth: bool = False
    """True if a loss term reads depth."""
    cuda: bool = False
    """True on a CUDA device."""
    count: int = 0
    """Number of Gaussians."""
    instances: int = 0
    """Number of (Gaussian, tile) instances of the image or, if ``chunked``, of its heaviest chunk."""
    chunked: bool = False
    """True if the image is rendered in chunks."""

    @property
    def pixels(self) -> int:
        """Number of pixels of the largest view."""
        return self.width * self.height


Needs = Mapping[str, int]
"""Bytes by moment."""


def add_needs(parts: Iterable[Callable[[StepSizes], Needs]], sizes: StepSizes) -> dict[str, int]:
    """Return the sum of the bytes that parts declare, by moment."""
    total = Counter[str]()
    for part in parts:
        total.update(part(sizes))
    return dict(total)


OWN_CGROUPS = Path("/proc/self/cgroup")
CGROUPS = Path("/sys/fs/cgroup")


NO_MEMORY = (
    "out of memory", "can't allocate memory", "cannot allocate memory", "not enough memory", "insufficient memory",
    "failed to allocate", "bad_alloc", "bad allocation", "unable to allocate", "failed to map segment", "start new thread",
)  # fmt: skip
"""Parts of the messages of torch, Warp, OpenCV, ONNX Runtime, numpy, C++ and the system on limits of memory and threads, in
lower case."""


Memory = tuple[int, int]
"""Installed and available bytes; cached files that the system would drop count as available."""


def available_bytes(device: torch.device) -> int:
    """Return the memory that is free now on a device [bytes]; on CUDA including memory that torch holds unused."""
    if device.type == "cuda":
        import torch

        free, _ = torch.cuda.mem_get_info(device)
        return free + torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
    return machine_memory()[1]


def free_for(needed: int, device: torch.device) -> float:
    """Return the memory that is free for a request [bytes]; infinite, without a query, if there is always enough for it."""
    # a query takes at least 0.1 ms; small requests, below a twentieth of the memory, skip it
    return math.inf if needed < installed_bytes(device) // 20 else available_bytes(device)


def is_out_of_memory(error: BaseException) -> bool:
    """Return whether an error, or one of its causes, reports too little memory."""
    found: BaseException | None = error
    while found is not None:
        text = str(found).lower()
        if isinstance(found, MemoryError) or getattr(found, "errno", None) == errno.ENOMEM or any(w in text for w in NO_MEMORY):
            return True
        found = found.__cause__
    return False


def no_memory_message(error: BaseException, purpose: str = "") -> str:
    """Return the message for a lack of memory, with remedies."""
    remedy = "End other programs, or raise the limits of `ulimit -a`; a fit needs less with --memory-limit or --downscale"
    reason = (str(error).strip() or type(error).__name__).splitlines()[0].partition(" GPU ")[0].rstrip(".")
    return f"out of memory{purpose} ({reason[:200]}). {remedy}, and --resume continues from its last checkpoint"


@functools.cache
def installed_bytes(device: torch.device) -> int:
    """Return the memory of a device [bytes], on a CPU at most the limit of the container; queried once."""
    if device.type == "cuda":
        import torch

        return torch.cuda.get_device_properties(device).total_memory
    return machine_memory()[0]


def machine_memory() -> Memory:
    """Return the memory of the machine within the limits of the container, if any."""
    import psutil

    system = psutil.virtual_memory()
    total, free = container_memory() or (math.inf, math.inf)
    return int(min(total, system.total)), int(max(0, min(free, system.available)))


def container_memory(own: Path | None = None, mount: Path | None = None) -> Memory | None:
    """Return the lowest memory limit of this process's control groups, and the least memory that is left below a limit."""
    # Only Linux has control groups; on other systems, and without a limit, this is None. Both versions of control
    # groups are read, from the process's own group up to the root, since the limits of all of them apply (kernel
    # documentation, cgroup-v2 "Memory" and cgroup-v1 "Memory Resource Controller"). Cached files that were not used
    # lately count as free: the kernel drops them first.
    limits, rooms = [], []
    for folder, limit_name, used_name, cache_name in _groups(own or OWN_CGROUPS, mount or CGROUPS):
        limit, used = _number(folder / limit_name), _number(folder / used_name)
        if limit is None or limit >= 2**60:  # version 1 writes "no limit" as a number near 2^63
            continue
        limits.append(limit)
        rooms.append(limit if used is None else limit - max(0, used - _row(folder / "memory.stat", cache_name)))
    return (min(limits), min(rooms)) if limits else None


def _groups(own: Path, mount: Path) -> Iterator[tuple[Path, str, str, str]]:
    """Yield each memory group's folder, with the names of its limit file, its use file and a row of its ``memory.stat``."""
    rows = [row.split(":", 2) for row in _text(own).splitlines()]
    paths = {"": "/", "memory": "/"} | {c: p for _, names, p in (r for r in rows if len(r) == 3) for c in names.split(",")}
    versions = {"": (mount, "memory.max", "memory.current", "inactive_file")}
    versions["memory"] = mount / "memory", "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
    for controller, (root, *names) in versions.items():
        parts = PurePosixPath(paths[controller]).parts[1:]
        # a path that leaves the mounted tree is a group that cannot be seen from here
        for end in range(0 if ".." in parts else len(parts), -1, -1):
            yield root.joinpath(*parts[:end]), *names


def _text(path: Path) -> str:
    with contextlib.suppress(OSError):
        return path.read_text("utf-8", errors="replace")
    return ""


def _number(path: Path) -> int | None:
    """Return the number in a file; None for `max` or a missing file."""
    text = _text(path).strip()
    return int(text) if text.isdecimal() else None


def _row(path: Path, name: str) -> int:
    """Return the number behind a name in a file of rows, 0 where it is missing."""
    rows = (row.split() for row in _text(path).splitlines())
    return next((int(r[1]) for r in rows if len(r) == 2 and r[0] == name and r[1].isdecimal()), 0)


# The folder of compiled kernels: Warp's default, if this user and no other can write to it; else a private folder.
#
# Warp runs the kernels that it finds there, so anyone with write access can run code as this user.

REMEDY = "Set WARP_CACHE_PATH to a folder of your own to keep compiled kernels"


@functools.cache
def prepare_kernel_cache() -> tuple[Path, str]:
    """Choose the folder, and set it in Warp's settings before `wp.init`; print a line on stderr if the folder is private."""
    import warp

    folder, refused = choose_kernel_cache(warp.config.kernel_cache_dir)
    if refused:
        say(f"warpgs: {refused}; kernels are compiled into {folder} for this process only (minutes). {REMEDY}", error=True)
    if refused or warp.config.kernel_cache_dir is None:
        warp.config.kernel_cache_dir = str(folder)
    return folder, refused


def choose_kernel_cache(configured: str | None = None) -> tuple[Path, str]:
    """Choose ``configured``, else WARP_CACHE_PATH, else Warp's default; a private folder if the chosen one is unusable."""
    folder, refused = None, "no home folder for a kernel cache"
    if asked := configured or os.environ.get("WARP_CACHE_PATH"):
        folder = Path(os.path.expanduser(asked))  # as a shell does, but not within quotes
        folder = None if asked.startswith("~") and not folder.is_absolute() else folder
    elif (home := cache_home()) is not None:  # where Warp's appdirs would put it; Warp adds its version
        folder = home.joinpath(*(("NVIDIA", "warp", "Cache") if sys.platform == "win32" else ("warp",)))
    if folder and not (refused := _fault(folder := folder.resolve())):
        return folder, ""
    none = f"no folder for compiled kernels can be written: {refused}, and none of its own"
    with explained(none, REMEDY, (ResourceError, OSError), ResourceError):
        own = private_folder() / "kernels"
        own.mkdir(exist_ok=True)
    return own, refused


def _fault(folder: Path) -> str:
    """Return why a folder cannot be used, or an empty text if it can; a missing folder is made."""
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder) as f:
            f.write(b"0")
            f.flush()
        others = open_to_others(folder, depth=3)  # its versions, the modules in them, and their files
    except OSError as e:
        return f"the kernel cache {folder} cannot be written ({e.strerror or e})"
    return f"the kernel cache {folder} is not safe: other users can write to {others}" if others else ""
