"""Rendering and its gradients, and a whole training step, beside gsplat 1.5.3 on the same inputs in the same run.

usage: python -m bench.against_gsplat GARDEN.npz [--out FILE.json] [--only NAME] [--kernels]
Needs a CUDA device and gsplat 1.5.3 (`pip install gsplat==1.5.3`, which builds itself on first use).
"""

from __future__ import annotations

import argparse
import gc
import json
import statistics
import time
from collections import Counter
from pathlib import Path

import torch
import warp as wp

from bench.garden import garden_inputs
from warpgs import RasterizeOptions, rasterize
from warpgs.scene import Camera, Gaussians

CONFIGURATIONS = {
    "112k at 504x378": (1, 504, 378),
    "112k at 1920x1080": (1, 1920, 1080),
    "2.8M at 1920x1080": (5, 1920, 1080),
    "2.8M at 3840x2160": (5, 3840, 2160),
}
REPEATS = 30
WARM_UP = 5


def first_camera(camera: Camera) -> Camera:
    """The first camera of a batch, still a batch."""
    return Camera(camera.viewmat[:1], camera.K[:1], camera.width, camera.height)


def ours(gaussians: Gaussians, camera: Camera, upstream: torch.Tensor):
    """Work: our rendering and the gradients of all five tensors."""
    leaves = list(gaussians.tensors().values())

    def work():
        return torch.autograd.grad(rasterize(gaussians, camera, RasterizeOptions(rule="gsplat")).rgb, leaves, upstream)

    return work


def peer(gaussians: Gaussians, camera: Camera, upstream: torch.Tensor, packed: bool):
    """Work: gsplat's rendering and the gradients of the same tensors; exp and sigmoid are torch's, as in its trainer."""
    from gsplat import rasterization

    g, leaves = gaussians, list(gaussians.tensors().values())

    def work():
        rgb, _, _ = rasterization(
            g.means, g.quats, g.log_scales.exp(), g.logit_opacities.sigmoid(), g.sh,
            camera.viewmat, camera.K, camera.width, camera.height, sh_degree=g.sh_degree, packed=packed,
        )  # fmt: skip
        return torch.autograd.grad(rgb, leaves, upstream)

    return work


def wall_times(works: dict, repeats: int = REPEATS) -> dict[str, dict]:
    """Wall time of each work [ms], repeat by repeat in turn, the device drained around each."""
    samples = {name: [] for name in works}
    for i in range(WARM_UP + repeats):
        for name, work in works.items():
            torch.cuda.synchronize()
            begin = time.perf_counter()
            work()
            torch.cuda.synchronize()
            if i >= WARM_UP:
                samples[name].append(1000 * (time.perf_counter() - begin))
    return {name: quartiles(values) for name, values in samples.items()}


def quartiles(values: list[float]) -> dict:
    """Median and quartiles."""
    low, middle, high = statistics.quantiles(values, n=4)
    return {"median": round(middle, 4), "quartiles": [round(low, 4), round(high, 4)], "repeats": len(values)}


def gpu_times(work, repeats: int = REPEATS) -> tuple[dict, Counter]:
    """GPU time of a work [ms]: the sum of its kernels' durations as the driver's tracer reports them; and by kernel."""
    from torch.profiler import ProfilerActivity, profile

    for _ in range(WARM_UP):
        work()
    torch.cuda.synchronize()
    totals, kernels = [], Counter()
    for _ in range(3):  # several short traces: a spread, and no trace so long that events are dropped
        with profile(activities=[ProfilerActivity.CUDA]) as trace:
            for _ in range(repeats // 3):
                work()
            torch.cuda.synchronize()
        total = 0.0
        for event in trace.events():
            if event.device_type == torch.autograd.DeviceType.CUDA:
                total += event.device_time
                kernels[event.name] += event.device_time / repeats
        totals.append(total / (repeats // 3) / 1000)
    return {"median": round(statistics.median(totals), 4), "spread": [round(min(totals), 4), round(max(totals), 4)]}, kernels


def peak_memory(work) -> float:
    """Memory above what was loaded before [MiB]: torch's high-water mark, and that of Warp's pool where it grew."""
    gc.collect()
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    device = wp.device_from_torch(torch.device("cuda", torch.cuda.current_device()))
    loaded, pool = torch.cuda.memory_allocated(), wp.get_mempool_used_mem_current(device)
    torch.cuda.reset_peak_memory_stats()
    work()
    torch.cuda.synchronize()
    warp_peak = max(0, wp.get_mempool_used_mem_high(device) - pool)
    return (torch.cuda.max_memory_allocated() - loaded + warp_peak) / 2**20


def compare(path: str, name: str, kernels: bool) -> dict:
    """One configuration: wall time, GPU time and memory of both programs, and ratios."""
    tiles, width, height = CONFIGURATIONS[name]
    gaussians, cameras = garden_inputs(path, tiles=tiles, sh_degree=3, width=width, height=height)
    camera = first_camera(cameras)
    upstream = torch.rand(1, height, width, 3, device="cuda", generator=torch.Generator("cuda").manual_seed(1))
    works = {"warpgs": ours(gaussians, camera, upstream)}
    works |= {f"gsplat {kind}": peer(gaussians, camera, upstream, kind == "packed") for kind in ("dense", "packed")}
    row = {"configuration": name, "gaussians": len(gaussians), "wall_ms": wall_times(works), "gpu_ms": {}, "peak_mib": {}}
    for who, work in works.items():
        row["gpu_ms"][who], by_kernel = gpu_times(work)
        row["peak_mib"][who] = round(peak_memory(work), 1)
        if kernels and who == "warpgs":
            row["kernels_us"] = {k: round(v, 1) for k, v in by_kernel.most_common(24)}
    for measure in ("wall_ms", "gpu_ms"):
        best = min(row[measure][who]["median"] for who in works if who != "warpgs")
        row[f"{measure}_ratio"] = round(row[measure]["warpgs"]["median"] / best, 3)
    row["peak_ratio"] = round(row["peak_mib"]["warpgs"] / min(v for k, v in row["peak_mib"].items() if k != "warpgs"), 3)
    return row


def main() -> None:
    """Measure, print a line per configuration, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("garden")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--only", help="a configuration's name, or its beginning")
    parser.add_argument("--kernels", action="store_true", help="our kernels by GPU time")
    a = parser.parse_args()
    rows = []
    for name in CONFIGURATIONS:
        if a.only and not name.startswith(a.only):
            continue
        row = compare(a.garden, name, a.kernels)
        rows.append(row)
        if a.kernels:
            for kernel, microseconds in row["kernels_us"].items():
                print(f"    {microseconds:9.1f} us  {kernel[:100]}")
        for who in row["wall_ms"]:
            wall, gpu = row["wall_ms"][who], row["gpu_ms"][who]
            figures = f"wall {wall['median']:7.3f} {wall['quartiles']}  GPU {gpu['median']:7.3f} {gpu['spread']} ms"
            print(f"{name:<18} {who:<14} {figures}  peak {row['peak_mib'][who]:7.1f} MiB")
        print(
            f"{name:<18} ratio: wall {row['wall_ms_ratio']}, GPU {row['gpu_ms_ratio']}, memory {row['peak_ratio']}", flush=True
        )
        torch.cuda.empty_cache()
    if a.out:
        result = {"device": torch.cuda.get_device_name(), "torch": torch.__version__, "warp": wp.config.version, "rows": rows}
        a.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
