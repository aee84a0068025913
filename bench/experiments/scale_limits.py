"""Size and shape of the Gaussians of fits without limits and with them, and the view one step beside the cameras.

usage: python -m bench.experiments.scale_limits SCENE@SPLIT[@DOWNSCALE]... [--preset quick] [--limits max_size=1,max_ratio=30]
           [--seeds 1] [--aside 0.3] [--device auto] --out FOLDER
SPLIT is one of `warpgs fit`, or even:K, which fits K views evenly spaced in their order and holds out the others. FOLDER gets
shape.json, shape.md and SCENE.png: without limits and with them, from the mean training camera moved sideways by --aside of its
distance to the point that the cameras look at.
"""

from __future__ import annotations

import argparse
import gc
import json
import statistics
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

import warpgs
from bench import result_file
from warpgs.errors import UsageError
from warpgs.files import write_bytes, write_text
from warpgs.geometry import focus_point, look_at
from warpgs.pipeline.model.scale_limits import LimitConfig, shape_figures
from warpgs.pipeline.runs.request import SceneRequest, choose_device, read_scene
from warpgs.pipeline.train.config import PRESETS, FitConfig
from warpgs.report.images import png, side_by_side
from warpgs.scene import Camera, Scene

WHAT = "size and shape of the Gaussians of fits without limits and with them"
OFF = LimitConfig(max_size=0.0, max_ratio=0.0, max_reach=0.0)
FIGURES = ("largest_over_radius", "largest_over_extent", "needles", "needles_by_opacity", "thin", "beyond")


def limits_of(text: str) -> LimitConfig:
    """Return the limits that ``NAME=VALUE,...`` names; the others have their defaults.

    Raises:
        UsageError: A name is unknown, or a value is none.
    """
    try:
        return LimitConfig(**{k: float(v) for k, _, v in (part.partition("=") for part in filter(None, text.split(",")))})
    except (TypeError, ValueError) as e:
        raise UsageError(f"--limits {text!r}: {e}; write NAME=VALUE with commas between, as in max_size=1") from e


def split_of(scene: Scene, split: str) -> str:
    """Return a split of `warpgs fit`, made for ``even:K``."""
    kind, _, count = split.partition(":")
    if kind != "even":
        return split
    names = [v.name for v in scene.views]
    if not count.isdigit() or not 2 <= int(count) < len(names):
        raise UsageError(f"split {split!r}: K must be a whole number from 2 to {len(names) - 1}")
    train = {names[i * len(names) // int(count)] for i in range(int(count))}
    return f"train={','.join(n for n in names if n in train)};test={','.join(n for n in names if n not in train)}"


def beside(cameras: list[Camera], aside: float) -> Camera:
    """Return the camera nearest to the mean of all, moved sideways by a fraction of its distance to the focus point."""
    centers = np.array([c.center for c in cameras])
    middle = cameras[int(np.argmin(np.linalg.norm(centers - centers.mean(0), axis=1)))]
    target, side = focus_point(cameras), middle.viewmat[0, :3]
    eye = middle.center + aside * np.linalg.norm(target - middle.center) * side
    return replace(middle, viewmat=look_at(eye, target, -middle.viewmat[1, :3]))


def measure(
    request: SceneRequest, config: FitConfig, device: torch.device, aside: float, limits: LimitConfig
) -> tuple[dict, np.ndarray]:
    """Return the figures of one fit, and the image [H, W, 3] of its model from beside the cameras.

    What is beyond ``limits`` is counted, whatever the fit's own were.
    """
    scene, _, _ = read_scene(request)
    fit = warpgs.fit(scene, config, split=request.split, device=device, verbose=False)
    m, cameras = fit.metrics, fit.cameras()
    with torch.no_grad():
        image = warpgs.rasterize(fit.gaussians(), beside([cameras[n] for n in fit.train], aside), fit.options()).rgb
    row = {"psnr": m["test"].get("psnr"), "ssim": m["test"].get("ssim"), "train_psnr": m["train"]["psnr"]}
    shape = shape_figures(fit.gaussians(), limits, m["shape"]["radius"], m["shape"]["extent"], [cameras[n] for n in fit.train])
    return row | {"gaussians": m["gaussians"]} | shape, image.clamp(0, 1).cpu().numpy()


def table(rows: list[dict]) -> str:
    """Return a Markdown table: the mean over seeds, by scene, without limits and with them; of the largest the largest."""
    lines = [
        "| scene | limits | seeds | PSNR [dB] | SSIM | Gaussians | largest / radius | largest / camera extent | "
        "needles > 30:1 | by opacity | longest / shortest > 30 | beyond |",
        "|---" * 12 + "|",
    ]
    for scene in dict.fromkeys(r["scene"] for r in rows):
        for kind in ("off", "on"):
            own = [r for r in rows if (r["scene"], r["limits"]) == (scene, kind)]
            if not own:
                continue
            mean = {k: statistics.mean(r[k] for r in own) for k in ("psnr", "ssim", "gaussians", *FIGURES)}
            worst = {k: max(r[k] for r in own) for k in FIGURES[:2]}
            lines.append(
                f"| {scene} | {kind} | {len(own)} | {mean['psnr']:.2f} | {mean['ssim']:.4f} | {mean['gaussians']:,.0f} | "
                f"{worst['largest_over_radius']:.3g} | {worst['largest_over_extent']:.3g} | {mean['needles']:.2%} | "
                f"{mean['needles_by_opacity']:.2%} | {mean['thin']:.1%} | {mean['beyond']:,.0f} |"
            )
    return "\n".join(lines) + "\n"


def main(arguments: list[str] | None = None) -> int:
    """Fit each scene without limits and with them, seed by seed, and write figures and pictures."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("scenes", nargs="+", metavar="SCENE@SPLIT[@DOWNSCALE]")
    p.add_argument("--preset", default="quick", choices=PRESETS)
    p.add_argument("--limits", default="")
    p.add_argument("--seeds", type=int, default=1)
    p.add_argument("--aside", type=float, default=0.3)
    p.add_argument("--device", default="auto")
    p.add_argument("--out", type=Path, required=True)
    a = p.parse_args(arguments)
    device, ways, rows = choose_device(a.device)[0], {"off": OFF, "on": limits_of(a.limits)}, []
    for word in a.scenes:
        path, split, *downscale = word.split("@")
        request = SceneRequest(path, None, *map(int, downscale))
        request = replace(request, split=split_of(read_scene(request)[0], split))
        name = Path(path).resolve().name
        for seed in range(a.seeds):
            images = []
            for kind, limits in ways.items():
                config = replace(PRESETS[a.preset], seed=seed, limits=limits)
                row, image = measure(request, config, device, a.aside, ways["on"])
                gc.collect()  # a fit and its recorded steps refer to each other: without this their device memory piles up
                rows.append({"scene": name, "split": split, "preset": a.preset, "limits": kind, "seed": seed} | row)
                images.append(image)
                print(json.dumps(rows[-1]), flush=True)
            result_file.write(a.out / "shape.json", result_file.result(WHAT, device, rows, limits=a.limits or "defaults"))
            if seed == 0:
                write_bytes(a.out / f"{name}.png", png(side_by_side(images)))
    write_text(a.out / "shape.md", table(rows))
    print(table(rows), end="")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
