"""Compile the kernels that a fit uses before it needs them, several modules at a time, into Warp's cache."""

import itertools
import os
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

import torch
import warp as wp

from warpgs.constants import TILE_SIZE
from warpgs.device import format_bytes
from warpgs.kernels import (
    blend,
    blend_cpu,
    blend_cuda,
    graphs,
    launch,
    neighbours,
    project_cpu,
    project_cuda,
    roughness,
    sh,
    ssim,
    sweep,
    tiles,
    update,
    walk,
)
from warpgs.kernels.falloff import COLORS, VALUES
from warpgs.kernels.native import BLOCK, load_module
from warpgs.pipeline.train.strategies import mcmc
from warpgs.process import say

THREADS = 256
"""Default number of threads of a block."""
CAMERA_MODEL = "pinhole"
"""Camera model whose kernels are compiled: the model of scenes read without native lenses."""


def fit_kernels(cuda: bool) -> list[tuple[wp.Kernel, int]]:
    """Return a kernel of each module that a fit on CUDA or on the CPU launches, with the block size of the launches."""
    # On CUDA a module is compiled once for each block size. Scores are computed on the CPU for fits on any device.
    real = wp.float32
    plain = [
        tiles.make_kernels(real, cuda).pack_counts,
        *((tiles.make_emit if cuda else tiles.make_emit_cpu)(real, slotted) for slotted in (True, False)),
        *(tiles.make_find_ranges(slotted, cuda) for slotted in (True, False)),
        neighbours.make_knn_kernels(real).search, neighbours.make_reach_kernel(), update.sample,
        update.decay, update.end_kernel, mcmc.make_kernel(), *vars(roughness.make_kernels(real)).values(),
        blend.make_segments(real).gather_weights,
    ]  # fmt: skip
    if not cuda:
        blending, variant = blend_cpu.make_kernels(real, TILE_SIZE), (CAMERA_MODEL, "stored", False, sh.BASES)
        scoring = [ssim.make_kernels(real, summed) for summed in (True, False)]
        plain += [
            project_cpu.make_forward(real, *variant), project_cpu.make_backward(real, *variant, False),
            blending.forward, blending.backward, blend_cpu.make_kernels(real, TILE_SIZE, deep=False).backward,
            walk.make_walk(real, TILE_SIZE, walk.make_contributions),
            blend.make_segments(real, VALUES, 9 + COLORS).sum_gradients, update.squared_errors, sweep.match,
            sweep.best, sweep.follow_cpu,
            *(k for s in scoring for k in (s.forward, s.backward)),
            *(update.make_adam_kernel(real, split, update.LANES) for split in (True, False)),
        ]  # fmt: skip
        return [(kernel, 1) for kernel in plain]
    blending, warps = blend_cuda.make_kernels(TILE_SIZE), 32 * blend_cuda.WARPS
    others = [
        (project_cuda.make_forward(real, CAMERA_MODEL), BLOCK), (project_cuda.make_backward(real, CAMERA_MODEL), BLOCK),
        *((blend_cuda.make_forward(TILE_SIZE, save, per), warps) for save in (True, False) for per in (1, 2)),
        (blending.order_tiles, blend_cuda.ORDER_THREADS), (blending.contributions, TILE_SIZE * TILE_SIZE),
        (sweep.follow, sweep.BLOCK), (ssim.make_cuda_kernels().forward, ssim.THREADS),
    ]  # fmt: skip
    plain += [graphs.make_fetch(), update.scheduled_update]
    for depth, chunk in itertools.product((False, True), blend_cuda.CHUNKS):  # with a loss term that reads depth, and without
        passes = blend_cuda.make_backward(TILE_SIZE, depth, chunk, False)
        plain.append(passes.gather)
        others.append((passes.backward, warps))
    return [*((kernel, THREADS) for kernel in plain), *others]


def _load(device: torch.device, kernel: wp.Kernel, block: int) -> tuple[str, str, int, bool, float]:
    """Compile and load a module; returns device, kernel, block size, whether it was compiled and not cached, and time [s]."""
    began, name = time.time(), f"{kernel.func.__module__.rpartition('.')[2]}.{kernel.func.__name__}"
    path = Path(load_module(kernel.module, launch.warp_device(device), block).binary_path)
    return str(device), name, block, path.stat().st_mtime >= began, time.time() - began


def precompile_kernels(devices: list[torch.device] | None = None) -> Iterator[tuple[str, str, int, bool, float]]:
    """Compile the modules that are not cached, by default for the CPU and all CUDA devices; yield `_load` of each when done."""
    if devices is None:
        devices = [torch.device("cpu"), *(torch.device("cuda", i) for i in range(torch.cuda.device_count()))]
    jobs = {
        (device, kernel.module, block): (device, kernel, block)
        for device in devices
        for kernel, block in fit_kernels(device.type == "cuda")
    }
    # Warp's own force_load also uses threads, but does not report the time of each module
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for done in as_completed([pool.submit(_load, *job) for job in jobs.values()]):
            yield done.result()


def print_warming(devices: list[torch.device] | None = None) -> None:
    """Warm the cache; print a line for each compiled module, and a summary."""
    began, count, compiled = time.perf_counter(), 0, 0
    for device, kernel, block, fresh, seconds in precompile_kernels(devices):
        count, compiled = count + 1, compiled + fresh
        if fresh:
            say(f"{device}: {kernel}{'' if device == 'cpu' else f' in blocks of {block}'}, {seconds:.1f} s")
    folder = Path(wp.config.kernel_cache_dir)
    size = sum(p.stat().st_size for p in folder.rglob("*") if p.is_file())
    say(
        f"{count} modules: {compiled} compiled, {count - compiled} were in the cache, "
        f"{time.perf_counter() - began:.1f} s; {folder} holds {format_bytes(size)}"
    )
