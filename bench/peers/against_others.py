"""Images, gradients and training steps beside gsplat, Faster-GS and gswarp, on the same inputs in the same run.

Directions: `image` without gradients, `forward` as it precedes a backward pass, `both`. GPU time is the sum of the kernels'
durations; wall time runs from an idle device to an idle device, in turn, repeat by repeat. Memory is the peak of `both` minus
the inputs. --programs selects programs; --traces is the number of traces, of which GPU time is the median. A CUDA device is
required; peers that cannot be imported are left out, with the reason. --kernels lists our kernels by GPU time.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

import torch

from bench.lib import rasterizers, result_file
from bench.lib.arguments import parse
from bench.lib.gpu_times import TRACES, gpu_times, peak_memory
from bench.lib.inputs import first_camera, garden_inputs
from bench.lib.kernel_calls import project
from bench.lib.peers import torch_ssim
from bench.lib.rasterizers import ATOMIC, GSPLAT, MANY_CHANNELS, OURS, UNRECORDED, Drawing
from bench.lib.timing import measure_in_turn
from bench.lib.training import Steps
from warpgs.constants import RULES
from warpgs.scene import Camera, Gaussians

WHAT = "images, gradients and training steps beside other rasterizers on the same inputs in the same run"
CONFIGURATIONS = {
    "112k at 504x378": (1, 504, 378),
    "112k at 1920x1080": (1, 1920, 1080),
    "2.8M at 1920x1080": (5, 1920, 1080),
    "2.8M at 3840x2160": (5, 3840, 2160),
}
RULE = "gsplat-1.6"
VARIANTS = {OURS: {}, UNRECORDED: {"record": False}, ATOMIC: {"deterministic": False}}
CHANNELS = (3, 32)
TRACED = 15
"""Number of calls in a trace of GPU time."""
CUDA = torch.device("cuda")


def works_of(drawing: Drawing, upstream: torch.Tensor) -> dict[str, Callable[[], object]]:
    """Return the work of each direction; ``upstream`` is the gradient of the image [H, W, D]."""
    native = drawing.upstream(upstream)

    def image():
        with torch.no_grad():
            return drawing.draw()

    return {"image": image, "forward": drawing.draw, "both": lambda: drawing.gradients(native)}


def drawings(g: Gaussians, camera: Camera, channels: int, present: dict, variants: dict) -> dict[str, Drawing]:
    """Return the scene in the layout of each program: with coefficients for 3 channels, with plain colours for more."""
    if channels == 3:
        made = {who: rasterizers.ours(g, camera, rule=RULE, **how) for who, how in variants.items()}
        return made | {who: prepare(g, camera) for who, prepare in present.items()}
    generator = torch.Generator(g.means.device).manual_seed(3)
    colors = torch.rand(len(g), channels, device=g.means.device, generator=generator)
    many = {who: how for who, how in variants.items() if who in (OURS, ATOMIC)}
    made = {who: rasterizers.ours(g, camera, colors, rule=RULE, **how) for who, how in many.items()}
    return made | {who: prepare(g, camera, colors) for who, prepare in present.items() if who in MANY_CHANNELS}


def compare(
    g: Gaussians, camera: Camera, channels: int, programs: tuple[dict, dict], repeats: int, traces: int, kernels: bool
) -> dict:
    """Return times by direction and program, peak memory, and the programs' differences from our image.

    ``programs`` are our variants and the peers.
    """
    variants, present = programs
    generator = torch.Generator(g.means.device).manual_seed(1)
    upstream = torch.rand(camera.height, camera.width, channels, device=g.means.device, generator=generator)
    made = drawings(g, camera, channels, present, variants)
    works = {who: works_of(drawing, upstream) for who, drawing in made.items()}
    row: dict = {"channels": channels, "wall_ms": {}, "gpu_ms": {}, "peak_mib": {}, "failed": {}}
    for who in list(works):
        try:
            works[who]["image"]()
            works[who]["both"]()
        except Exception as e:  # whatever a foreign program fails with at this size, the others go on
            row["failed"][who] = " ".join(f"{type(e).__name__}: {e}".split())[:200]
            del works[who], made[who]
    for direction in ("image", "forward", "both"):
        rows = measure_in_turn([w[direction] for w in works.values()], CUDA, repeats)
        keep = {who: {"median": r["median_ms"], "quartiles": r["quartiles_ms"]} for who, r in zip(works, rows, strict=True)}
        row["wall_ms"][direction] = keep
        row["gpu_ms"][direction] = {}
        for who, w in works.items():
            row["gpu_ms"][direction][who], by_kernel = gpu_times(w[direction], TRACED, traces)
            if kernels and who == OURS:
                row.setdefault("kernels_us", {})[direction] = {k: round(v, 1) for k, v in by_kernel.most_common(24)}
    row["peak_mib"] = {who: round(peak_memory(w["both"]), 1) for who, w in works.items()}
    with torch.no_grad():
        images = {who: drawing.image() for who, drawing in made.items()}
        row["image_difference"] = {who: float((image - images[OURS]).abs().mean()) for who, image in images.items()}
    return row


def counts_of(g: Gaussians, camera: Camera) -> dict[str, int]:
    """Return the numbers of visible Gaussians and of their (Gaussian, tile) instances."""
    size = {"width": camera.width, "height": camera.height}
    with torch.no_grad():
        tensors = g.tensors().values()
        counts = project(*tensors, camera.viewmat, camera.K, **size, degree=0, rule=RULES[RULE])[1]
    return {"visible": int((counts > 0).sum()), "instances": int(counts.sum())}


def peer_step(g: Gaussians, camera: Camera, target: torch.Tensor):
    """Return a training step like that of gsplat's trainer: coefficients in two tensors, fused Adam, SSIM in torch."""
    from gsplat import rasterization
    from gsplat.optimizers import SelectiveAdam

    params = {n: t.detach().clone().requires_grad_() for n, t in g.tensors().items()}
    sh = params.pop("sh").detach()
    params |= {"sh0": sh[:, :1].clone().requires_grad_(), "shN": sh[:, 1:].clone().requires_grad_()}
    optimizers = [SelectiveAdam([{"params": [p], "lr": 1e-3}], eps=1e-15, betas=(0.9, 0.999)) for p in params.values()]

    def work():
        rgb, _, info = rasterization(
            params["means"], params["quats"], params["log_scales"].exp(), params["logit_opacities"].sigmoid(),
            torch.cat([params["sh0"], params["shN"]], 1), camera.viewmat, camera.K, camera.width, camera.height,
            sh_degree=g.sh_degree, packed=False,
        )  # fmt: skip
        loss = 0.8 * (rgb[0] - target).abs().mean() + 0.2 * (1 - torch_ssim(rgb[0], target).mean())
        loss.backward()
        visible = (info["radii"] > 0).all(-1).any(0)
        for optimizer in optimizers:
            optimizer.step(visible)
            optimizer.zero_grad(set_to_none=True)

    return work


def steps(g: Gaussians, camera: Camera, present: dict, repeats: int) -> dict:
    """Return the wall time of a training step: ours as a graph, gsplat's with torch."""
    shape = (camera.height, camera.width, 3)
    target = torch.rand(shape, device=g.means.device, generator=torch.Generator(g.means.device).manual_seed(2))
    works = {f"{OURS} graph": Steps(g, camera, target, RULE).replay}
    if GSPLAT in present:
        works["gsplat"] = peer_step(g, camera, target)
    rows = measure_in_turn(list(works.values()), CUDA, repeats)
    return {who: {"median": r["median_ms"], "quartiles": r["quartiles_ms"]} for who, r in zip(works, rows, strict=True)}


def report(row: dict) -> None:
    """Print a line for each program."""
    print(f"{row['configuration']}, {row['channels']} channels: GPU ms image / forward / both; wall ms; MiB; image difference")
    for who in row["peak_mib"]:
        gpu, wall = ([row[kind][d][who]["median"] for d in row[kind]] for kind in ("gpu_ms", "wall_ms"))
        figures = "  ".join(" / ".join(f"{v:7.3f}" for v in values) for values in (gpu, wall))
        print(f"  {who:<24} {figures}  {row['peak_mib'][who]:8.1f}  {row['image_difference'][who]:.1e}", flush=True)
    for who, reason in row["failed"].items():
        print(f"  {who:<24} {reason}", flush=True)
    for who, wall in row.get("step_wall_ms", {}).items():
        print(f"  {who:<24} step {wall['median']:7.3f}", flush=True)


def main() -> None:
    """Measure, print, write after each configuration."""
    flags = {"repeats": 30, "traces": TRACES, "programs": [str], "only": "", "kernels": False, "without_steps": False}
    a = parse(__doc__, None, {"garden": Path}, out=Path, **flags)
    present, absent = rasterizers.present(CUDA)
    variants, present = (
        {who: how for who, how in known.items() if who in (a.programs or known)} for known in (VARIANTS, present)
    )
    for who, reason in absent.items():
        print(f"without {who}: {reason}")
    rows = []
    for name, (tiles, width, height) in CONFIGURATIONS.items():
        if not name.startswith(a.only):
            continue
        g, cameras = garden_inputs(a.garden, tiles=tiles, sh_degree=3, width=width, height=height)
        camera = first_camera(cameras)
        for channels in CHANNELS:
            row = {"configuration": name, "gaussians": len(g), "width": width, "height": height} | counts_of(g, camera)
            row |= compare(g, camera, channels, (variants, present), a.repeats, a.traces, a.kernels)
            if channels == 3 and not a.without_steps:
                with contextlib.suppress(torch.cuda.OutOfMemoryError):
                    row["step_wall_ms"] = steps(g, camera, present, a.repeats)
            rows.append(row)
            report(row)
            result_file.keep(a.out, WHAT, CUDA, rows, repeats=a.repeats, absent=absent)
            torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
