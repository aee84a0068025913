"""Images without gradients on gsplat's garden: all cut-offs of `exact`, and within a largest error (`max_error`).

GPU time is the sum of the kernels' durations. Wall time is measured in turn, from an idle device to an idle device; that of a
frame includes its way to main memory with 8 bits per channel, as in the viewer. A CUDA device is required.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.gpu_times import TRACES, gpu_times
from bench.lib.inputs import first_camera, garden_inputs
from bench.lib.timing import measure_in_turn
from warpgs import RasterizeOptions, rasterize
from warpgs.scene import Camera, Gaussians

WHAT = "images without gradients within a largest error, beside all cut-offs of exact"
CONFIGURATIONS = {
    "112k at 504x378": (1, 504, 378),
    "112k at 1920x1080": (1, 1920, 1080),
    "2.8M at 1920x1080": (5, 1920, 1080),
    "2.8M at 3840x2160": (5, 3840, 2160),
}
CUDA = torch.device("cuda")


def measure(g: Gaussians, camera: Camera, errors: list[float], repeats: int, traces: int) -> list[dict]:
    """Return a row for `exact`, with an error of 0, and for each largest error."""
    exact = RasterizeOptions()
    options = {0.0: exact} | {error: replace(exact, max_error=error) for error in errors}

    def frame(chosen: RasterizeOptions):
        return (255 * rasterize(g, camera, chosen).rgb.clamp(0, 1)).round().to(torch.uint8).cpu()

    works = [lambda chosen=chosen: rasterize(g, camera, chosen) for chosen in options.values()]
    frames = [lambda chosen=chosen: frame(chosen) for chosen in options.values()]
    walls = [measure_in_turn(kind, CUDA, repeats) for kind in (works, frames)]
    truth, rows = works[0](), []
    for error, work, wall, whole in zip(options, works, *walls, strict=True):
        gpu, kernels = gpu_times(work, repeats, traces)
        found = work()
        off = (found.rgb - truth.rgb).abs()
        rows.append(
            {
                "max_error": error, "gpu_ms": gpu, "wall_ms": wall["median_ms"], "frame_wall_ms": whole["median_ms"],
                "visible": int(found.visible.sum()), "instances": int(found.tile_counts.sum()),
                "bound": None if found.error_bound is None else float(found.error_bound.max()),
                "largest_difference": float(off.max()), "mean_difference": float(off.mean()),
                "kernels_us": {name: round(us, 1) for name, us in kernels.most_common(24)},
            }
        )  # fmt: skip
        del found, off
    return rows


def main() -> None:
    """Measure, print, write after each configuration."""
    a = parse(__doc__, None, {"garden": Path}, out=Path, repeats=30, traces=TRACES, errors=[1 / 255], only="")
    rows = []
    for name, (tiles, width, height) in CONFIGURATIONS.items():
        if not name.startswith(a.only):
            continue
        g, cameras = garden_inputs(a.garden, tiles=tiles, sh_degree=3, width=width, height=height)
        with torch.no_grad():
            for row in measure(g, first_camera(cameras), a.errors, a.repeats, a.traces):
                rows.append({"configuration": name, "gaussians": len(g), "width": width, "height": height} | row)
                times = [row["gpu_ms"]["median"], row["wall_ms"], row["frame_wall_ms"]]
                print(
                    f"{name}, max_error {row['max_error']:.5f}: GPU, wall, frame [ms] {times}; instances {row['instances']:,}; "
                    f"bound {row['bound']}, largest difference {row['largest_difference']:.6f}",
                    flush=True,
                )
        result_file.keep(a.out, WHAT, CUDA, rows, repeats=a.repeats)
        torch.cuda.empty_cache()


if __name__ == "__main__":
    main()
