"""Time of a render and its gradients against their error to float64 without cut-offs, for every setting, on frozen scenes."""

from __future__ import annotations

import gc
import math
import statistics
import time
from collections.abc import Callable

import torch

from bench.lib.frozen import Frozen
from bench.lib.settings import UNCUT, Setting, settings
from bench.lib.timing import measure_in_turn, recorded
from warpgs.kernels.launch import set_threads
from warpgs.kernels.project import project
from warpgs.scene import Camera, Gaussians

VISIBLE = 0.5 / 255
"""Half a step of an 8-bit channel."""
REFERENCE_INSTANCES = 8_000_000
"""Largest number of instances of the reference at a time: without a cut every Gaussian is in every tile."""
LIMIT_MS = 2000.0
"""Time above which a setting is not timed, since only its error is of interest."""


def _leaves(gaussians: Gaussians, dtype: torch.dtype) -> Gaussians:
    return Gaussians(**{n: t.detach().to(dtype).requires_grad_() for n, t in gaussians.tensors().items()})


def _upstream(height: int, width: int) -> torch.Tensor:
    """Return the gradient of the image, the same for all settings, of either sign, shape [H, W, 3]."""
    return torch.rand(height, width, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.5


def reference(scene: Frozen) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """Return colours and gradients in float64 without cut-offs."""
    g = _leaves(scene.gaussians, torch.float64)
    rgb = Setting("reference", "reference", UNCUT).render(g, scene.camera, REFERENCE_INSTANCES)
    gradients = torch.autograd.grad(rgb, list(g.tensors().values()), _upstream(*rgb.shape[:2]).to(rgb))
    return rgb.detach(), dict(zip(g.tensors(), gradients))


def image_errors(found: torch.Tensor, wanted: torch.Tensor) -> dict[str, float]:
    """Return errors of colours [H, W, 3] in [0, 1]: largest, mean, p99.9, PSNR [dB], fraction of visibly wrong pixels."""
    error = (found.double() - wanted.double()).abs()
    square = float((error**2).mean())
    return {
        "max": float(error.max()), "mean": float(error.mean()),
        "p999": float(torch.quantile(error.flatten()[: 2**24], 0.999)),
        "psnr": -10 * math.log10(square) if square > 0 else math.inf,
        "visible": float((error.amax(-1) > VISIBLE).double().mean()),
    }  # fmt: skip


def gradient_errors(found: dict[str, torch.Tensor], wanted: dict[str, torch.Tensor]) -> dict[str, float]:
    """Return relative L2 distance and cosine of each tensor's gradient, and the worst of either over the five."""
    row = {}
    for name, true in wanted.items():
        own, true = found[name].double().flatten(), true.flatten()
        length = float(true.norm())
        row[f"rel_l2_{name}"] = float((own - true).norm()) / length if length > 0 else math.nan
        row[f"cosine_{name}"] = (
            float(own @ true) / (length * float(own.norm())) if length > 0 and float(own.norm()) > 0 else 0.0
        )
    numbers = [v for k, v in row.items() if k.startswith("rel_l2_") and math.isfinite(v)]
    row["grad_rel_l2"] = max(numbers, default=math.nan)
    row["grad_cosine"] = min((v for k, v in row.items() if k.startswith("cosine_")), default=math.nan)
    return row


def _works(s: Setting, leaves: Gaussians, camera: Camera, upstream: torch.Tensor) -> list[Callable[[], object]]:
    """Return the functions that compute an image, and an image with its gradients.

    On CUDA both are graphs, as in fits, because the host is slower.
    """
    inputs, cuda = list(leaves.tensors().values()), leaves.means.is_cuda
    bounds = {}
    if cuda:  # nothing that is recorded may look at the device or copy from the host
        matrices = (torch.as_tensor(t, dtype=torch.float32, device=leaves.means.device) for t in (camera.viewmat, camera.K))
        camera = Camera(*matrices, camera.width, camera.height)
        bounds = {"capacity": max(1, s.instances(leaves, camera))}

    def forward():
        return s.render(leaves, camera, **bounds)

    def both():
        return torch.autograd.grad(s.render(leaves, camera, **bounds), inputs, upstream)

    return [recorded(forward), recorded(both)] if cuda else [forward, both]


def measure_scene(scene: Frozen, repeats: int, chosen: list[Setting] | None = None) -> list[dict]:
    """Return a row for each setting of one scene."""
    g, device = scene.gaussians, scene.gaussians.means.device
    wanted, wanted_gradients = reference(scene)
    upstream = _upstream(scene.camera.height, scene.camera.width).to(device, torch.float32)
    rows, works, exact = [], [], None
    for s in settings(g.sh_degree, device.type == "cuda") if chosen is None else chosen:
        leaves = _leaves(g, torch.float32)
        inputs = list(leaves.tensors().values())
        rgb = s.render(leaves, scene.camera)
        gradients = dict(zip(leaves.tensors(), torch.autograd.grad(rgb, inputs, upstream, retain_graph=True)))
        errors = image_errors(rgb.detach(), wanted) | gradient_errors(gradients, wanted_gradients)
        exact = rgb.detach() if exact is None else exact  # the first setting
        off = (rgb.detach() - exact).abs()
        errors |= {"max_to_exact": float(off.max()), "mean_to_exact": float(off.mean())}
        rows.append({
            "scene": scene.name, "setting": s.name, "knob": s.knob, "preset": s.preset,
            "alpha_cut": s.rule.alpha_cut, "transmittance_stop": s.rule.transmittance_stop, **errors,
        })  # fmt: skip
        del rgb, gradients

        works += _works(s, leaves, scene.camera, upstream)
    gc.collect()
    times = times_in_turn(works, device, repeats)
    for row, forward, both in zip(rows, times[::2], times[1::2]):
        if "median_ms" not in forward or "median_ms" not in both:
            continue
        for name, timing in (("forward", forward), ("both", both)):
            low, high = timing["quartiles_ms"]
            row |= {
                f"{name}_ms": timing["median_ms"],
                f"{name}_low": low,
                f"{name}_high": high,
                f"{name}_least": timing["least_ms"],
            }
        row["backward_ms"] = both["median_ms"] - forward["median_ms"]
    return rows


def times_in_turn(works: list[Callable[[], object]], device: torch.device, repeats: int) -> list[dict]:
    """Return median, quartiles and minimum of each work's time [ms], one repeat each in turn.

    On CUDA wall time (`bench.lib.timing`); on a CPU the processor time of one thread, which other programs disturb far less.
    """
    if device.type == "cuda":
        return measure_in_turn(works, device, repeats, LIMIT_MS)
    threads = torch.get_num_threads()
    set_threads(1)
    samples: list[list[float]] = [[] for _ in works]
    try:
        for _ in range(repeats + 1):  # the first time loads kernels
            for own, work in zip(samples, works):
                if own and own[0] > LIMIT_MS:
                    continue
                began = time.process_time()
                work()
                own.append(1000 * (time.process_time() - began))
    finally:
        set_threads(threads)
    rows = []
    for own in samples:
        if len(own) < repeats:
            rows.append({"warm_up_ms": own[0]})
            continue
        low, middle, high = statistics.quantiles(own[1:], n=4)
        rows.append({"median_ms": middle, "quartiles_ms": [low, high], "least_ms": min(own[1:])})
    return rows


def sorting_share(scene: Frozen, repeats: int) -> dict:
    """Return the time of sorting visible Gaussians by depth [ms], an upper limit of the gain from reusing the order."""
    g = scene.gaussians
    view, K = (
        torch.as_tensor(t, dtype=torch.float32, device=g.means.device)[None] for t in (scene.camera.viewmat, scene.camera.K)
    )
    size = {"width": scene.camera.width, "height": scene.camera.height}
    projected, counts = project(*g.tensors().values(), view, K, **size, degree=0, rule=UNCUT)
    depths = projected[0, counts[0] > 0, 9].contiguous()
    timing = times_in_turn([lambda: torch.sort(depths, stable=True)], g.means.device, repeats)[0]
    return {"scene": scene.name, "visible": len(depths), "sort_ms": timing["median_ms"]}
