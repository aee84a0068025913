"""Loading of Warp modules: one thread of one process compiles a module, while all others that need the module wait."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import warp as wp
from filelock import lock_descriptor, unlock_descriptor

from warpgs.errors import ResourceError
from warpgs.files import make_folder
from warpgs.runtime.kernel_cache import REMEDY

_LOADED: set[tuple[wp.Module, object, int]] = set()
"""Modules that this process has loaded, each with the context of its device and its number of threads per block."""

_LISTENERS: list[tuple[Callable[[str], object], list[float]]] = []
"""Functions to call for each module that has to be compiled, each with a list of compile times [s]."""


@contextlib.contextmanager
def told_of_compiling(listener: Callable[[str], object]) -> Iterator[list[float]]:
    """Call ``listener`` within the block with the name of each module that the cache lacks, before it is compiled.

    ``listener`` may be called from any thread. Yields a list, to which the compile time [s] of each module is added.
    """
    entry: tuple[Callable[[str], object], list[float]] = listener, []
    _LISTENERS.append(entry)
    try:
        yield entry[1]
    finally:
        _LISTENERS.remove(entry)


def load_module(module: wp.Module, device: wp.Device, block_dim: int):
    """Load a module for blocks of ``block_dim`` threads and return Warp's handle; compile it where the cache lacks it.

    Several fits that start at once on a fresh machine need the same modules. A file lock beside the cache's folders makes one
    of them compile; the others find the result. Once a module is loaded no lock is taken.
    """
    key = (module, device.context, block_dim)
    if key in _LOADED:  # Warp's hash shows whether the module has new kernels
        return module.load(device, block_dim=block_dim)
    cache, name = Path(wp.config.kernel_cache_dir), module.get_module_identifier(block_dim)
    locks = cache / "locks"
    make_folder(locks)
    with exclusive(locks / f"{name}.{device.is_cuda:d}"):
        compiles, began = not (cache / name).is_dir(), time.perf_counter()
        told = tuple(_LISTENERS) if compiles else ()
        for listener, _ in told:
            listener(name)
        loaded = module.load(device, block_dim=block_dim)
        for _, seconds in told:
            seconds.append(time.perf_counter() - began)
    _LOADED.add(key)
    return loaded


@contextlib.contextmanager
def exclusive(path: Path) -> Iterator[None]:
    """Lock a file, which is made if it is missing, so that one thread of one process at a time runs the body.

    The system releases the lock when the process that holds it ends, even if it is killed. On a file system without locks the
    body runs unlocked: Warp renames a compiled module into place, so two processes that compile it only lose time.

    Raises:
        ResourceError: The file cannot be opened.
    """
    try:
        file = path.open("ab")
    except OSError as e:
        raise ResourceError(f"{path}: cannot be opened ({e.strerror or e}). {REMEDY}") from e
    with file, contextlib.ExitStack() as held:
        with contextlib.suppress(OSError):
            lock_descriptor(file.fileno())
            held.callback(unlock_descriptor, file.fileno())
        yield
