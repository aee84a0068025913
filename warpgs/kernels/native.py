"""What Warp compiles kernels from: CUDA text, compiler options, native functions; and how modules load."""

import contextlib
import functools
import importlib.resources
import inspect
import math
import re
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError, Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

import warp as wp
from filelock import lock_descriptor, unlock_descriptor

from warpgs.clock import section
from warpgs.device import REMEDY, usable_cores
from warpgs.errors import ResourceError, explained
from warpgs.files import make_folder
from warpgs.process import Say, say

FOLDER = importlib.resources.files("warpgs") / "kernels" / "cuda"
"""Folder of the files."""


Ints, IntRows = wp.array(dtype=int), wp.array2d(dtype=int)
Floats, FloatRows = wp.array(dtype=float), wp.array2d(dtype=float)
Longs = wp.array(dtype=wp.int64)
"""Arguments of kernels: arrays of numbers, and tables of them."""


def source(name: str, **numbers: object) -> str:
    """Return the CUDA text of a file of `FOLDER`, with its includes, and names in capitals replaced by ``numbers``."""
    text = re.sub(r'^#include "([\w.]+)"\n', lambda found: source(found[1]), (FOLDER / name).read_text("utf-8"), flags=re.M)
    for word, number in numbers.items():
        text = re.sub(rf"\b{word}\b", str(number), text)
    return text


def cuda_kernel(text: str, item: str, module: str, **options: object) -> Callable[[Callable[..., None]], wp.Kernel]:
    """Make a decorator that turns the declaration of a body in CUDA into the kernel that calls it.

    The body's first argument is ``item``, an expression in Warp; the others are those of the kernel after ``begin``.
    """

    def make(stub: Callable[..., None]) -> wp.Kernel:
        body, types = wp.func_native(text)(stub), inspect.get_annotations(stub, eval_str=True)
        names = list(types)[1:]

        def kernel():
            return body  # Warp looks the name up here

        kernel.__name__, kernel.__qualname__ = stub.__name__, stub.__qualname__
        kernel.__annotations__ = {"begin": int, **{name: types[name] for name in names}}
        kinds = [inspect.Parameter(name, inspect.Parameter.POSITIONAL_OR_KEYWORD) for name in kernel.__annotations__]
        vars(kernel)["__signature__"] = inspect.Signature(kinds)
        call = f"def {stub.__name__}(begin, {', '.join(names)}):\n    body({item}, {', '.join(names)})\n"
        fixed = {"enable_backward": False, "grid_stride": False}
        return wp.Kernel(kernel, module=wp.get_module(module), options=fixed | options, source=call)

    return make


SCALE = "0.84932180028801904272f"
"""Factor of CUDA text that takes U to units where the falloff is 2^-|U d|^2: sqrt(log2(e) / 2)."""

_MACHINE = wp.config.cpu_compiler_flags or "-march=native"
# Align the stack to cache lines: else every access of 64 bytes to a local vector touches two lines.
_STACK = "-mstackrealign -mstack-alignment=64"

ROLLED = {
    # Warp would unroll loops of constant length, and the vectoriser needs loops.
    "max_unroll": 0,
    # fused multiply-add, half the instructions of a filter; Warp's own flags fuse nothing
    "cpu_compiler_flags": f"{_MACHINE} -ffp-contract=fast {_STACK}",
}
"""Module options, for kernels with ``module="unique"`` (elsewhere Warp ignores them)."""

EXACT = {"max_unroll": 0, "cpu_compiler_flags": f"{_MACHINE} -ffp-contract=off {_STACK}"}
"""The options of `ROLLED` without fused multiply-add: every operation rounds alike on all processors."""


BLOCK = 128
"""Threads of a block in kernels that call `compact` or `clear_rows`."""


# Functions for CUDA; `project_cuda` makes those on colours.


@wp.func_native(source("native_compact.cu", BLOCK=BLOCK))
def compact(item: int, wanted: int) -> int:
    """Return the wanted items of the block's threads, assigned to its first threads in order; -1 for other threads.

    All BLOCK threads of the block must call it.
    """


@wp.func_native(source("native_store_row.cu"))
def store_row(records: FloatRows, i: int, v: wp.types.vector(12, wp.float32)):
    """Write row i of an array of rows of 12 floats, 16-byte aligned."""


@wp.func_native(source("native_clear_rows.cu", BLOCK=BLOCK))
def clear_rows(item: int, kept: int, sh: wp.array2d(dtype=wp.vec3)):
    """Set the rows of the block's items to zero, except those that are kept. All BLOCK threads must call it."""


@wp.func_native(source("native_broadcast.cu"))
def broadcast(value: int, lane: int) -> int:
    """Return the value that a lane of the warp holds. All 32 lanes of the warp must call this and the next three."""


@wp.func_native(source("native_running_sum.cu"))
def running_sum(value: int) -> int:
    """Return the sum over this lane of the warp and those before it."""


@wp.func_native(source("native_whole_sum.cu"))
def whole_sum(value: wp.int64) -> wp.int64:
    """Return the sum over all lanes of the warp."""


@wp.func_native(source("native_holder.cu"))
def holder(running_sum: int, item: int) -> int:
    """Return the first lane of the warp whose running sum exceeds ``item``, or the last lane."""


@functools.cache
def make_prefetch(kind: type, axes: int = 1):
    """Make the function that asks for a row of an array before it is read, so that a CPU does not wait for it."""

    @wp.func_native(source("native_prefetch.cu"))
    def prefetch(rows: wp.array(dtype=kind, ndim=axes), i: int):
        """Load row i into the cache; i may be outside the array. Does nothing on CUDA."""

    return prefetch


def module_name(module: wp.Module, block_dim: int) -> str:
    """Return the name of a module's folder in the cache; our modules without compiler flags get those of `EXACT`."""
    # The object code stays the same, but for each set of flags Warp precompiles its headers anew, which takes 1.2 s.
    if module.name.startswith("warpgs.") and module.options["cpu_compiler_flags"] is None:
        module.options["cpu_compiler_flags"] = EXACT["cpu_compiler_flags"]
        module.mark_modified()
    return module.get_module_identifier(block_dim)


_LOADED: set[tuple[wp.Module, object, int]] = set()
"""Modules that this process has loaded, each with the context of its device and its number of threads per block."""

_LISTENERS: list[tuple[Say, list[float]]] = []
"""Functions to call for each module that has to be compiled, each with a list of compile times [s]."""


@contextlib.contextmanager
def told_of_compiling(listener: Say) -> Iterator[list[float]]:
    """Call ``listener``, from any thread, with each module that will be compiled; yield a list of their compile times [s]."""
    entry: tuple[Say, list[float]] = listener, []
    _LISTENERS.append(entry)
    try:
        yield entry[1]
    finally:
        _LISTENERS.remove(entry)


SILENT = 2.0
"""Time of compiling after which a process prints a line if there is no listener [s]; modules with shorter gaps count as one."""
_since = _until = -math.inf


@functools.cache
def _say_compiling() -> None:
    say("warpgs: compiling kernels, once on this machine, for up to a minute", error=True)


@contextlib.contextmanager
def _announced() -> Iterator[None]:
    """Print a line on stderr if the body, with the bodies just before it, takes more than `SILENT`."""
    global _since, _until
    now = time.perf_counter()
    if now - _until > SILENT:
        _since = now
    timer = threading.Timer(max(0.0, _since + SILENT - now), _say_compiling)
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
        _until = time.perf_counter()


def load_module(module: wp.Module, device: wp.Device, block_dim: int):
    """Load a module for blocks of ``block_dim`` threads and return Warp's handle; compile it where the cache lacks it."""
    key = (module, device.context, block_dim)
    if key in _LOADED:  # Warp's hash shows whether the module has new kernels
        return module.load(device, block_dim=block_dim)
    ahead = _AHEAD.get(key)
    with section("kernels"):
        if ahead is not None and not ahead.done():
            for listener, _ in _LISTENERS:
                listener(module_name(module, block_dim))
            with contextlib.suppress(CancelledError):
                ahead.exception()
        return _load(module, device, block_dim)  # raises an error of the thread, too


def _packed_text(module: wp.Module, *given: object) -> tuple[object, ...]:
    """Return what Warp's generator of text for the compiler does, without the forms of kernels for arrays with gaps."""
    # Warp 1.19 adds this form to most kernels for the CPU, for 29 % of the time; no launch passes such arrays of one axis
    text, *others = type(module)._run_codegen(module, *given)
    return re.sub(r" *if \(wp_linear_contiguous\)\n(.*<true>.*\n) *else\n.*<false>.*", r"\1", text), *others


def _load(module: wp.Module, device: wp.Device, block_dim: int, tells: bool = True):
    """Load a module as `load_module` does, on this thread; tell no listener if ``tells`` is False."""
    # Fits that start at once on a fresh machine need the same modules: a file lock makes one compile, and the others find the
    # result.
    with exclusive(lock_of(name := module_name(module, block_dim), device)):
        compiles, began = not is_cached(name), time.perf_counter()
        told = tuple(_LISTENERS) if compiles else ()
        module._run_codegen = functools.partial(_packed_text, module)
        for listener, _ in told if tells else ():
            listener(name)
        with _announced() if compiles and not told else contextlib.nullcontext():
            loaded = module.load(device, block_dim=block_dim)
        # Take from the functions that the module shares what compiling them left there, since Warp hashes it with later
        # modules: another process, which finds this module in the cache, would not find those, and compile them anew.
        with contextlib.suppress(AttributeError):  # Warp's own fields: without them, modules may be compiled twice
            for function in {f for hasher in module.hashers.values() for f in hasher.function_hashes}:
                for overload in (function.user_overloads | function.user_templates).values():
                    overload.adj.deferred_static_expressions = []
        for _, seconds in told:
            seconds.append(time.perf_counter() - began)
    _LOADED.add((module, device.context, block_dim))
    return loaded


def is_cached(name: str) -> bool:
    """Return whether the cache has a folder for the name of a module."""
    return Path(wp.config.kernel_cache_dir, name).is_dir()


def lock_of(name: str, device: wp.Device) -> Path:
    """Return the file that is locked while a module of that name is compiled."""
    locks = Path(wp.config.kernel_cache_dir) / "locks"
    make_folder(locks)
    return locks / f"{name}.{device.is_cuda:d}"


_AHEAD: dict[tuple[wp.Module, object, int], Future[object]] = {}
"""Modules that threads of `loaded_ahead` are to load, by the key of `_LOADED`."""
PER_FLAGS = 4
"""Most threads that compile modules for the CPU with the same flags: each has to precompile Warp's headers first."""


@contextlib.contextmanager
def loaded_ahead(modules: list[tuple[wp.Module, wp.Device, int]], later: int = 0) -> Iterator[None]:
    """Compile and load modules that the cache lacks in threads during the block, in this order, by device and size of blocks.

    The last ``later`` modules are begun once the others are done. `load_module` waits for such a module and raises its error. A
    module that is not begun when the block ends is left out, and after an error none is waited for.
    """
    # Names are computed before any module is compiled: Warp's hash of a module depends on which modules were compiled before
    # it in the process, and another process would not find it in the cache.
    missing = [job for job in modules if not is_cached(module_name(job[0], job[2]))]
    last, most, needed = modules[len(modules) - later :], max(1, usable_cores() // 2), list[Future[object]]()
    pools: dict[str | None, ThreadPoolExecutor] = {}
    made: dict[tuple[wp.Module, object, int], Future[object]] = {}

    def load(*job: Any) -> object:
        wait(needed if job in last else [])
        return _load(*job, False)  # after an error, the launch that needs the module tries again, and raises it

    try:
        for job in missing:
            module, device, block = job
            key, flags = (module, device.context, block), None if device.is_cuda else module.options["cpu_compiler_flags"]
            # no daemons: a compiler at work when the process ends brings it down; the threads end with the pool
            pool = pools.setdefault(flags, ThreadPoolExecutor(most if flags is None else min(PER_FLAGS, most), "compile"))
            made[key] = _AHEAD[key] = pool.submit(load, *job)
            if job not in last:
                needed.append(made[key])
        yield
        wait([future for future in made.values() if not future.cancel()])
    finally:
        for key, future in made.items():
            future.cancel()
            _AHEAD.pop(key, None)


@contextlib.contextmanager
def exclusive(path: Path) -> Iterator[None]:
    """Lock a file, which is made if missing, so that one thread of one process at a time runs the body."""
    # The system releases the lock when its process ends, even if killed. On a file system without locks the body runs unlocked:
    # Warp renames a compiled module into place, so two processes that compile it only lose time.
    with explained(f"{path}: cannot be opened", REMEDY, kind=ResourceError):
        file = path.open("ab")
    with file, contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            lock_descriptor(file.fileno())
            held.callback(unlock_descriptor, file.fileno())
        yield
