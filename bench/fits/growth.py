"""Growth of time and memory with Gaussians, pixels and views: training steps, and whole fits; exponents by least squares.

Steps: a random cloud, image, L1, SSIM, backward pass and Adam, as a fit takes them (on CUDA as a graph); one size varies, the
other stays at --gaussians or 504 x 378 px. Fits: all of `warpgs.fit` without files, on photographs rendered from Gaussians on
the surfaces of the demo's still life: --views of 504 x 378 px, then --megapixels with 12 views. The number of steps of
`default` grows with views; `quick` takes 300. An exponent is the slope of the best line through the logarithms of size and
figure. Memory is torch's peak: reserved for steps, so that it includes graphs, and allocated for fits. Points are measured from
light to heavy; none begins after --seconds.
"""

from __future__ import annotations

import functools
import gc
import math
import time
from pathlib import Path

import numpy as np
import torch

import warpgs
from bench.lib import inputs, one_fit, result_file
from bench.lib.arguments import parse
from bench.lib.points import exponent
from bench.lib.surfaces import true_points
from bench.lib.tables import figure, markdown
from bench.lib.timing import measure
from bench.lib.training import Steps
from warpgs import RasterizeOptions, rasterize
from warpgs.kernels.neighbours import mean_square_distances
from warpgs.pipeline.run.request import choose_device
from warpgs.scene import C0, Camera, Gaussians, Scene, View
from warpgs.synthetic import raycast
from warpgs.synthetic.demo import camera_path, still_life

WHAT = "growth of time and memory of training steps and whole fits with Gaussians, pixels and views"
SMALL = (504, 378)
"""Size of images while something else varies [px]."""
SIZES = ("gaussians", "megapixels", "views")
AXES = {("step", "gaussians"): ("step_ms", "reserved_mib"), ("step", "megapixels"): ("step_ms", "reserved_mib")}
AXES |= {("fit", axis): ("setup", "training", "total", "allocated_mib") for axis in ("views", "megapixels")}
"""Figures of each series: what is measured, and what grows."""
VIEWS = 12
"""Views of a fit while pixels vary."""
ASPECT = SMALL[0] / SMALL[1]


def size_of(megapixels: float) -> tuple[int, int]:
    """Return width and height [px] of an image of so many million pixels."""
    height = math.sqrt(megapixels * 1e6 / ASPECT)
    return round(ASPECT * height), round(height)


def step(count: int, size: tuple[int, int], device: torch.device) -> dict:
    """Return the time of a training step [ms], and the memory of all that it needs [MiB]."""
    cuda = device.type == "cuda"
    if cuda:
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    taken = Steps(inputs.gaussians(count, device), inputs.camera(*size, device), inputs.image(*size, device), "exact", lr=0.0)
    timing = measure(taken.replay if cuda else taken.eager, device, 10)
    row = {"step_ms": timing["median_ms"], "quartiles_ms": timing["quartiles_ms"]}
    return row | ({"reserved_mib": round(torch.cuda.max_memory_reserved(device) / 2**20)} if cuda else {})


@functools.cache
def truth(device: torch.device) -> Gaussians:
    """Return opaque Gaussians on the surfaces of the still life that six cameras see."""
    shapes, cameras = still_life(), camera_path(6, 320, 240)
    images = [raycast.render(shapes, raycast.Light(), c.K, c.viewmat, c.width, c.height).reshape(-1, 3) for c in cameras]
    arrays = (true_points(shapes, cameras), np.concatenate(images))
    places, colors = (torch.as_tensor(a, dtype=torch.float32, device=device) for a in arrays)
    widths = (0.7 * mean_square_distances(places).sqrt().clamp(1e-4, 0.05)).log()[:, None].expand(-1, 3).contiguous()
    quats = torch.nn.functional.pad(places.new_ones(len(places), 1), (0, 3))
    return Gaussians(places, quats, widths, places.new_full((len(places),), 4.0), ((colors - 0.5) / C0)[:, None])


def scene_of(count: int, size: tuple[int, int], device: torch.device) -> Scene:
    """Return a scene of so many photographs of the still life."""
    views = []
    for k, camera in enumerate(camera_path(count, *size)):
        there = Camera(*(torch.as_tensor(a, dtype=torch.float32, device=device) for a in (camera.viewmat, camera.K)), *size)
        with torch.no_grad():
            image = rasterize(truth(device), there, RasterizeOptions()).rgb.clamp(0, 1).cpu().numpy()
        views.append(View(f"{k:03d}.png", camera, image))
    return Scene(f"still life {count} {size}", "synthetic", tuple(views))


def fit(count: int, size: tuple[int, int], preset: str, device: torch.device) -> dict:
    """Return times of a whole fit [s], its size and its memory [MiB]."""
    scene = scene_of(count, size, device)
    if device.type == "cuda":
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats(device)
    began = time.perf_counter()
    m = warpgs.fit(scene, one_fit.config_of(preset), device=device, verbose=False).metrics
    row = {**m["seconds"], "total": time.perf_counter() - began, "steps": m["steps"], "fitted_gaussians": m["gaussians"]}
    return row | ({"allocated_mib": round(m["peak_torch_bytes"] / 2**20)} if "peak_torch_bytes" in m else {})


def exponents(rows: list[dict]) -> list[dict]:
    """Return the exponent of each series with at least two sizes, over all of them and over the larger half."""
    found = []
    for (what, axis), figures in AXES.items():
        own = sorted((r for r in rows if (r["what"], r["axis"]) == (what, axis)), key=lambda r: r[axis])
        for name in figures:
            points = [(r[axis], r[name]) for r in own if r.get(name)]
            if len({x for x, _ in points}) > 1:
                half, series = points[-max(2, (len(points) + 1) // 2) :], {"what": what, "axis": axis, "figure": name}
                ends = {"least": points[0][0], "most": points[-1][0]}
                found.append(series | ends | {"exponent": exponent(points), "upper": exponent(half)})
    return found


def tables(rows: list[dict]) -> str:
    """Return a line for each point, and one for each exponent."""
    figures = list(dict.fromkeys(n for names in AXES.values() for n in names))
    lines = [[figure(r[n]) if n in r else "" for n in (*SIZES, *figures)] for r in rows]
    slopes = []
    for e in exponents(rows):
        span = f"{figure(e['least'])} to {figure(e['most'])}"
        slopes.append([e["what"], e["axis"], span, e["figure"], f"{e['exponent']:.2f}", f"{e['upper']:.2f}"])
    last = ["what", "grows", "range", "figure", "exponent", "upper half"]
    return markdown([*SIZES, *figures], lines) + "\n" + markdown(last, slopes, ("what", "grows", "figure"))


def main(arguments: list[str] | None = None) -> None:
    """Measure, print, write after each point."""
    a = parse(
        __doc__, arguments, counts=[10_000, 30_000, 100_000, 300_000, 1_000_000, 3_000_000, 5_000_000], gaussians=300_000,
        megapixels=[0.2, 0.5, 1.0, 2.0, 4.0, 8.0], views=[3, 10, 30, 100, 300], preset="quick", seconds=float("inf"),
        device="auto", out=Path,
    )  # fmt: skip
    device, small = choose_device(a.device)[0], SMALL[0] * SMALL[1] / 1e6
    ended, rows = time.monotonic() + a.seconds, []
    one_fit.compile_all((a.preset,), str(device))
    plan = [("step", "gaussians", n, small, 1) for n in a.counts] + [("fit", "views", 0, small, v) for v in a.views]
    plan += [(w, "megapixels", n, m, v) for m in a.megapixels for w, n, v in (("step", a.gaussians, 1), ("fit", 0, VIEWS))]
    plan.sort(key=lambda p: (p[0] == "fit", p[2] / 1e6 + p[3] * p[4]))
    for what, axis, count, megapixels, views in plan:
        if time.monotonic() > ended:
            print(f"not begun after {a.seconds:g} s: {what}, {axis}: {count:,}, {megapixels:g} MP, {views} views")
            continue
        size = SMALL if megapixels == small else size_of(megapixels)
        row = {"what": what, "axis": axis, "gaussians": count, "megapixels": size[0] * size[1] / 1e6, "views": views}
        try:
            row |= step(count, size, device) if what == "step" else fit(views, size, a.preset, device)
        except (torch.cuda.OutOfMemoryError, warpgs.WarpgsError) as e:
            row["error"] = " ".join(str(e).split())[:200]
        gc.collect()
        rows.append(row)
        print({k: round(v, 3) if isinstance(v, float) else v for k, v in row.items()}, flush=True)
        result_file.keep(a.out, WHAT, device, rows, exponents=exponents(rows), preset=a.preset)
    print(tables(rows))


if __name__ == "__main__":
    main()
