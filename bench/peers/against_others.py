"""Rendering and its gradients, and a whole training step, beside gsplat 1.5.3 on the same inputs in the same run.

--kernels lists our kernels by GPU time.
Needs a CUDA device and gsplat 1.5.3 (`pip install gsplat==1.5.3`, which builds itself on first use).
"""

from __future__ import annotations

import gc
import statistics
from collections import Counter
from pathlib import Path

import torch
import warp as wp

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.inputs import first_camera, garden_inputs
from bench.lib.peers import gsplat_rasterize, torch_ssim
from bench.lib.timing import measure_in_turn, recorded
from bench.lib.training import Steps
from warpgs import RasterizeOptions, clear_graph_cache, rasterize
from warpgs.constants import RULES
from warpgs.kernels.project import project
from warpgs.scene import Camera, Gaussians

WHAT = "rendering, its gradients and a training step beside gsplat on the same inputs in the same run"
CONFIGURATIONS = {
    "112k at 504x378": (1, 504, 378),
    "112k at 1920x1080": (1, 1920, 1080),
    "2.8M at 1920x1080": (5, 1920, 1080),
    "2.8M at 3840x2160": (5, 3840, 2160),
}
REPEATS = 30
WARM_UP = 5


def ours(gaussians: Gaussians, camera: Camera, upstream: torch.Tensor, **choices):
    """Work: our rendering and the gradients of all five tensors."""
    leaves, options = list(gaussians.tensors().values()), RasterizeOptions(rule="gsplat-1.5", **choices)

    def work():
        return torch.autograd.grad(rasterize(gaussians, camera, options).rgb, leaves, upstream)

    return work


def peer(gaussians: Gaussians, camera: Camera, upstream: torch.Tensor, packed: bool):
    """Work: gsplat's rendering and the gradients of the same tensors; exp and sigmoid are torch's, as in its trainer."""
    leaves = list(gaussians.tensors().values())
    return lambda: torch.autograd.grad(gsplat_rasterize(gaussians, camera, packed), leaves, upstream)


def count_instances(gaussians: Gaussians, camera: Camera) -> int:
    """Return the (Gaussian, tile) instances of an image."""
    size = {"width": camera.width, "height": camera.height}
    with torch.no_grad():
        tensors = gaussians.tensors().values()
        counts = project(*tensors, camera.viewmat, camera.K, **size, degree=0, rule=RULES["gsplat-1.5"])[1]
    return int(counts.sum())


def in_calling_thread(work):
    """The same work with its backward pass in the caller's thread: torch hands it to another one otherwise, and waits."""

    def here():
        with torch.autograd.set_multithreading_enabled(False):
            return work()

    return here


def peer_step(gaussians: Gaussians, camera: Camera, target: torch.Tensor):
    """Work: the same step in the manner of gsplat's trainer: coefficients in two tensors, its fused Adam, torch SSIM."""
    from gsplat import rasterization
    from gsplat.optimizers import SelectiveAdam

    params = {n: t.detach().clone().requires_grad_() for n, t in gaussians.tensors().items()}
    sh = params.pop("sh").detach()
    params |= {"sh0": sh[:, :1].clone().requires_grad_(), "shN": sh[:, 1:].clone().requires_grad_()}
    optimizers = [SelectiveAdam([{"params": [p], "lr": 1e-3}], eps=1e-15, betas=(0.9, 0.999)) for p in params.values()]

    def work():
        rgb, _, info = rasterization(
            params["means"], params["quats"], params["log_scales"].exp(), params["logit_opacities"].sigmoid(),
            torch.cat([params["sh0"], params["shN"]], 1), camera.viewmat, camera.K, camera.width, camera.height,
            sh_degree=gaussians.sh_degree, packed=False,
        )  # fmt: skip
        loss = 0.8 * (rgb[0] - target).abs().mean() + 0.2 * (1 - torch_ssim(rgb[0], target).mean())
        loss.backward()
        visible = (info["radii"] > 0).flatten(2).all(-1).any(0) if info["radii"].ndim == 3 else (info["radii"] > 0).any(0)
        for optimizer in optimizers:
            optimizer.step(visible)
            optimizer.zero_grad(set_to_none=True)

    return work


def wall_times(works: dict) -> dict[str, dict]:
    """Return the wall time of each work [ms], repeat by repeat in turn, the device drained around each."""
    rows = measure_in_turn(list(works.values()), torch.device("cuda"), REPEATS)
    return {n: {"median": r["median_ms"], "quartiles": r["quartiles_ms"], "repeats": REPEATS} for n, r in zip(works, rows)}


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


def _set_aside() -> int:
    """Return the bytes that captured graphs hold and torch counts as free, in whole segments."""
    segments = [s for s in torch.cuda.memory_snapshot() if tuple(s["segment_pool_id"]) != (0, 0)]
    return sum(s["total_size"] - s["active_size"] for s in segments)


def peak_memory(work) -> float:
    """Return the memory above what was loaded before [MiB]: torch's high-water mark, and that of Warp's pool where it grew.

    Where a loop of ``work`` is captured, all memory counts that is set aside for graphs, which that mark does not show: in
    whole segments, so rather too much.
    """
    clear_graph_cache()
    gc.collect()
    torch.cuda.synchronize()
    torch.cuda.empty_cache()
    device = wp.device_from_torch(torch.device("cuda", torch.cuda.current_device()))
    loaded, pool, aside = torch.cuda.memory_allocated(), wp.get_mempool_used_mem_current(device), _set_aside()
    for _ in range(WARM_UP):
        work()
    torch.cuda.synchronize()
    torch.cuda.reset_peak_memory_stats()
    work()
    torch.cuda.synchronize()
    highest, warp_peak = torch.cuda.max_memory_allocated() - loaded, wp.get_mempool_used_mem_high(device) - pool
    unseen = max(0, _set_aside() - aside)
    clear_graph_cache()
    return (highest + unseen + max(0, warp_peak)) / 2**20


def compare(path: Path, name: str, kernels: bool) -> dict:
    """One configuration: wall time, GPU time and memory of both programs, and ratios."""
    tiles, width, height = CONFIGURATIONS[name]
    gaussians, cameras = garden_inputs(path, tiles=tiles, sh_degree=3, width=width, height=height)
    camera = first_camera(cameras)
    upstream = torch.rand(1, height, width, 3, device="cuda", generator=torch.Generator("cuda").manual_seed(1))
    capacity = int(1.3 * count_instances(gaussians, camera))
    works = {
        "warpgs": ours(gaussians, camera, upstream),
        "warpgs, never recorded": ours(gaussians, camera, upstream, record=False),
        "warpgs atomic": ours(gaussians, camera, upstream, deterministic=False),
        "warpgs graph": recorded(ours(gaussians, camera, upstream, capacity=capacity)),
    }
    works |= {f"gsplat {kind}": peer(gaussians, camera, upstream, kind == "packed") for kind in ("dense", "packed")}
    one = {f"{who}, one thread": in_calling_thread(works[who]) for who in ("warpgs", "warpgs, never recorded", "gsplat dense")}
    row = {"configuration": name, "gaussians": len(gaussians), "wall_ms": wall_times(works | one)}
    row |= {"gpu_ms": {}, "peak_mib": {}}
    for who, work in works.items():
        row["gpu_ms"][who], by_kernel = gpu_times(work)
        if who != "warpgs graph":  # its memory is taken when it is recorded
            row["peak_mib"][who] = round(peak_memory(work), 1)
        if kernels and who == "warpgs":
            row["kernels_us"] = {k: round(v, 1) for k, v in by_kernel.most_common(24)}
    peers = [who for who in works if who.startswith("gsplat")]
    for measure in ("wall_ms", "gpu_ms"):
        best = min(row[measure][who]["median"] for who in peers)
        row[f"{measure}_ratio"] = {w: round(row[measure][w]["median"] / best, 3) for w in works if w not in peers}
    *alone, theirs = (row["wall_ms"][who]["median"] for who in one)
    row["wall_ms_ratio"] |= {who: round(own / theirs, 3) for who, own in zip(one, alone)}
    least = min(row["peak_mib"][who] for who in peers)
    row["peak_ratio"] = {w: round(mib / least, 3) for w, mib in row["peak_mib"].items() if w not in peers}
    del works, work
    target = torch.rand(height, width, 3, device="cuda", generator=torch.Generator("cuda").manual_seed(2))
    steps = {
        "warpgs graph": Steps(gaussians, camera, target, "gsplat-1.5").replay,
        "gsplat": peer_step(gaussians, camera, target),
    }
    row["step_wall_ms"] = wall_times(steps)
    row["step_ratio"] = round(row["step_wall_ms"]["warpgs graph"]["median"] / row["step_wall_ms"]["gsplat"]["median"], 3)
    if kernels:
        row["step_gpu_ms"], by_kernel = gpu_times(steps["warpgs graph"])
        row["step_kernels_us"] = {k: round(v, 1) for k, v in by_kernel.most_common(40)}
    return row


def main() -> None:
    """Measure, print a line per configuration, write."""
    a = parse(__doc__, None, {"garden": Path}, out=Path, only="", kernels=False)
    rows = []
    for name in CONFIGURATIONS:
        if not name.startswith(a.only):
            continue
        row = compare(a.garden, name, a.kernels)
        rows.append(row)
        if a.kernels:
            for kernel, microseconds in (row["kernels_us"] | {"step:": 0.0} | row["step_kernels_us"]).items():
                print(f"    {microseconds:9.1f} us  {kernel[:100]}")
        for who in row["wall_ms"]:
            wall, gpu = row["wall_ms"][who], row["gpu_ms"].get(who)
            figures = f"wall {wall['median']:7.3f} {wall['quartiles']}"
            if gpu is not None:
                figures += f"  GPU {gpu['median']:7.3f} {gpu['spread']} ms  peak {row['peak_mib'].get(who, 0):7.1f} MiB"
            print(f"{name:<18} {who:<24} {figures}")
        for who, wall in row["step_wall_ms"].items():
            print(f"{name:<18} {who:<14} step {wall['median']:7.3f} {wall['quartiles']} ms")
        ratios = f"wall {row['wall_ms_ratio']}, GPU {row['gpu_ms_ratio']}, memory {row['peak_ratio']}, step {row['step_ratio']}"
        print(f"{name:<18} ratios: {ratios}", flush=True)
        torch.cuda.empty_cache()
    result_file.keep(a.out, WHAT, torch.device("cuda"), rows)


if __name__ == "__main__":
    main()
