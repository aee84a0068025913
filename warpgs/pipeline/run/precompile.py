"""Compile the kernels that a fit uses before it needs them, several modules at a time, into Warp's cache."""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path

import torch
import warp as wp

from warpgs.constants import TILE_SIZE
from warpgs.device import format_bytes
from warpgs.kernels import blend, blend_cpu, blend_cuda, neighbours, project_cpu, project_cuda, ssim, sweep, tiles, update, walk
from warpgs.kernels.falloff import COLORS, VALUES
from warpgs.kernels.graphs import fetch_kernel
from warpgs.kernels.launch import warp_device
from warpgs.kernels.native import BLOCK, load_module, loaded_ahead
from warpgs.kernels.roughness import make_kernels as roughness
from warpgs.kernels.sh import BASES
from warpgs.pipeline.train.strategies import mcmc
from warpgs.process import say

THREADS = 256
"""Default number of threads of a block."""
CAMERA_MODEL = "pinhole"
"""Camera model whose kernels are compiled: the model of scenes read without native lenses."""

AFTER_STEP = 9
"""Number of kernels at the end of `fit_kernels` on the CPU that are launched after the first step."""


def fit_kernels(cuda: bool) -> list[tuple[wp.Kernel, int]]:
    """Return a kernel of each module that a fit on CUDA or on the CPU launches, with its block size, in the order of need."""
    # On CUDA a module is compiled once for each block size. Scores are computed on the CPU for fits on any device.
    real, emit = wp.float32, tiles.make_emit if cuda else tiles.make_emit_cpu
    of_steps, of_renders = ([emit(real, slotted), tiles.make_find_ranges(slotted, cuda)] for slotted in (True, False))
    start, lists = neighbours.make_knn_kernels(real).search, tiles.make_kernels(real, cuda).pack_counts
    of_renders += [blend.make_segments(real).gather_weights, mcmc.move]
    rough = [*vars(roughness(real)).values()]
    if not cuda:
        variant = CAMERA_MODEL, "stored", False, BASES
        summed = [ssim.make_kernel(real, True, way) for way in (False, True)]
        color, deep = (blend_cpu.make_backward(real, TILE_SIZE, COLORS, deep=deep) for deep in (False, True))
        kernels = [
            sweep.match, sweep.best, sweep.follow_cpu, start, project_cpu.make_forward(real, *variant), update.sample, lists,
            *of_steps, blend_cpu.make_forward(real, TILE_SIZE, COLORS), *summed, *rough, color,
            blend.make_segments(real, VALUES, 9 + COLORS).sum_gradients, project_cpu.make_backward(real, *variant, False),
            *(update.make_adam_kernel(real, split, update.LANES) for split in (True, False)), neighbours.bound_by_reach,
            # after the first step
            of_renders[0], of_renders[1], walk.make_weights(real, TILE_SIZE), update.squared_errors,
            ssim.make_kernel(real, False, False), *of_renders[2:], ssim.make_kernel(real, False, True), deep,
        ]  # fmt: skip
        return [(kernel, 1) for kernel in kernels]
    warps = 32 * blend_cuda.WARPS
    save, show = ([(blend_cuda.make_forward(TILE_SIZE, saves, per), warps) for per in (1, 2)] for saves in (True, False))
    color, deep = (  # without and with a loss term that reads depth; one kernel gathers chunks of any size
        [blend_cuda.make_backward(TILE_SIZE, depth, chunk, False) for chunk in blend_cuda.CHUNKS] for depth in (False, True)
    )
    return [
        (sweep.follow, sweep.BLOCK), (start, THREADS), (project_cuda.make_forward(real, CAMERA_MODEL), BLOCK),
        *((kernel, THREADS) for kernel in (update.sample, lists, *of_steps)),
        (blend_cuda.make_kernels(TILE_SIZE).order_tiles, blend_cuda.ORDER_THREADS), *save,
        (ssim.cuda_forward, ssim.THREADS), *((kernel, THREADS) for kernel in rough),
        *((each.backward, warps) for each in color),
        (color[0].gather, THREADS), (project_cuda.make_backward(real, CAMERA_MODEL), BLOCK),
        *((kernel, THREADS) for kernel in (update.scheduled_update, fetch_kernel, neighbours.bound_by_reach)),
        # after the first step
        *((kernel, THREADS) for kernel in of_renders), *show,
        *((each.backward, warps) for each in deep), (deep[0].gather, THREADS),
    ]  # fmt: skip


def call_kernels(cuda: bool) -> list[tuple[wp.Kernel, int]]:
    """Return further kernels, as `fit_kernels` does, of `rasterize` with scales and opacities, and of `warpgs.compat`."""
    room, variant = project_cuda if cuda else project_cpu, (wp.float32, CAMERA_MODEL, "activated", False, BASES)
    median = walk.make_native(TILE_SIZE).median if cuda else walk.make_walk(wp.float32, TILE_SIZE, walk.make_median)
    backward = room.make_backward(*variant, *([] if cuda else [False]))
    kernels = room.make_forward(*variant), backward, blend.make_kernels(wp.float32, COLORS).color, median
    return list(zip(kernels, (BLOCK, BLOCK, THREADS, TILE_SIZE**2) if cuda else (1, 1, 1, 1)))


@contextlib.contextmanager
def compiled_ahead(*devices: torch.device, calls: bool = False) -> Iterator[list[tuple[wp.Kernel, int, torch.device]]]:
    """Compile modules that fits on devices, and with ``calls`` `call_kernels`, need and the cache lacks, in threads.

    The threads begin no module after the block, which gets the kernels, block sizes and devices. A launch that needs a module
    waits for it or compiles it, and raises its error.
    """
    # in fits on CUDA, too: depth, scores, limits
    on_cpu = sweep.best, ssim.make_kernel(wp.float32, False, False), neighbours.bound_by_reach
    jobs = [] if (cpu := torch.device("cpu")) in devices else [(kernel, 1, cpu) for kernel in on_cpu]
    for device, cuda in [(device, device.type == "cuda") for device in devices]:
        jobs += [(*job, device) for job in [*fit_kernels(cuda), *(call_kernels(cuda) if calls else ())]]
    later = AFTER_STEP if devices == (cpu,) and not calls else 0
    with loaded_ahead([(kernel.module, warp_device(device), block) for kernel, block, device in jobs], later):
        yield jobs


def precompile_kernels(devices: list[torch.device] | None = None) -> Iterator[tuple[str, str, int, bool, float]]:
    """Compile and load the modules of fits and of `call_kernels`, by default on the CPU and all CUDA devices.

    Yields device, kernel, block size, whether the module was not in the cache, and the time since the start [s], of each.
    """
    if devices is None:
        devices = [torch.device("cpu"), *(torch.device("cuda", i) for i in range(torch.cuda.device_count()))]
    began, wall = time.perf_counter(), time.time()
    with compiled_ahead(*devices, calls=True) as jobs:
        for kernel, block, device in jobs:
            path = Path(load_module(kernel.module, warp_device(device), block).binary_path)
            name = f"{kernel.func.__module__.rpartition('.')[2]}.{kernel.func.__name__}"
            yield str(device), name, block, path.stat().st_mtime >= wall, time.perf_counter() - began


def print_warming(devices: list[torch.device] | None = None) -> None:
    """Warm the cache; print a line for each compiled module, and a summary."""
    began, count, compiled = time.perf_counter(), 0, 0
    for device, kernel, block, fresh, seconds in precompile_kernels(devices):
        count, compiled = count + 1, compiled + fresh
        if fresh:
            say(f"{device}: {kernel}{'' if device == 'cpu' else f' in blocks of {block}'}, after {seconds:.1f} s")
    folder = Path(wp.config.kernel_cache_dir)
    size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    took = f"{time.perf_counter() - began:.1f} s; {folder} holds {format_bytes(size)}"
    say(f"{count} modules: {compiled} compiled, {count - compiled} were in the cache, {took}")
