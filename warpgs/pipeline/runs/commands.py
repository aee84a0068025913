"""What can be done with a run once it is there: score it again, render it, export it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from warpgs.errors import DataError, UsageError
from warpgs.export.ply import write_ply
from warpgs.files import write_bytes, write_json
from warpgs.pipeline.metrics.lpips import load_lpips
from warpgs.pipeline.model.compress import drop_unused_sh
from warpgs.pipeline.runs.camera_paths import PATHS, camera_path
from warpgs.pipeline.runs.folder import SceneRequest, choose_device, open_run, read_scene
from warpgs.pipeline.runs.results import evaluate_run, file_stem, options_for, protocol_of, score_line
from warpgs.pipeline.train.trainer import train_views
from warpgs.render.rasterize import rasterize
from warpgs.report.film import write_mp4
from warpgs.report.images import png
from warpgs.scene import Camera, Gaussians


def evaluate(folder: Path, device_name: str, lpips_weights: Path | None = None) -> list[str]:
    """Score a run on its held-out views and rewrite its pictures; returns lines for the user.

    The scores go to eval.json beside metrics.json, which stays as the fit wrote it.

    Args:
        folder: The run folder.
        device_name: auto, cpu or cuda.
        lpips_weights: File of `warpgs convert-lpips`; without one LPIPS is not measured.

    Raises:
        DataError: The folder is no run, its scene is gone, the scene's data have changed since the fit, or the weights are
            no weights.
    """
    device, _ = choose_device(device_name)
    lpips = None if lpips_weights is None else load_lpips(lpips_weights, device)
    stored = open_run(folder, device)
    request = SceneRequest(**stored.record["scene"])
    scene, _, _ = read_scene(request)
    if scene.fingerprint != stored.record["fingerprint"]:
        raise DataError(f"{scene.path}: its photographs or cameras are not those that {folder} was fitted to; restore them")
    train, test = (train_views(scene, tuple(stored.record[k])) for k in ("train", "test"))
    rule, background = stored.record["config"]["rule"], tuple(stored.record["background"])
    metrics = evaluate_run(folder, stored.gaussians, train, test, rule, background, lpips)
    metrics |= {
        "protocol": protocol_of(scene, request.split, request.downscale, train, test),
        "config_hash": stored.record["config_hash"], "steps": stored.step,
    }  # fmt: skip
    write_json(folder / "eval.json", metrics)
    if not test:
        return [f"no view is held out; training PSNR {metrics['train']['psnr']:.2f} dB"]
    lines = [f"{r['name']}: PSNR {r['psnr']:.2f} dB, SSIM {r['ssim']:.4f} ({r['region']})" for r in metrics["views"]]
    return [*lines, f"mean of {len(test)}: {score_line(metrics['test'])}"]


@torch.no_grad()
def _median_depth(gaussians: Gaussians, cameras: list[Camera]) -> float:
    """Median rendered depth [u] over covered pixels of at most five cameras; 1 where nothing is covered."""
    depths = []
    for camera in cameras[:: max(1, len(cameras) // 5)]:
        r = rasterize(gaussians, camera)
        depths.append(r.depth[r.alpha > 0.5].flatten().cpu().numpy())
    values = np.concatenate(depths)
    return float(np.median(values)) if len(values) else 1.0


def render(folder: Path, kind: str, out: Path | None, frames: int, fps: int, device_name: str) -> str:
    """Render a run along a path to PNG files and a film; returns a line for the user.

    Raises:
        DataError: The folder is no run.
        ResourceError: A file cannot be written.
        UsageError: The path is unknown.
    """
    if kind not in PATHS:
        raise UsageError(f"path {kind!r} is not one of {', '.join(PATHS)}")
    device, _ = choose_device(device_name)
    stored = open_run(folder, device)
    train = [stored.cameras[n] for n in stored.record["train"]]
    if kind == "views":
        cameras = [(file_stem(n), c) for n, c in stored.cameras.items()]
    else:
        path = camera_path(kind, train, _median_depth(stored.gaussians, train), frames)
        cameras = [(f"{i:04d}", c) for i, c in enumerate(path)]
    out = folder / f"path-{kind}" if out is None else out
    out.mkdir(parents=True, exist_ok=True)
    options = options_for(stored.record["config"]["rule"], tuple(stored.record["background"]), stored.gaussians)
    one_size = len({(c.width, c.height) for _, c in cameras}) == 1

    def images():
        for name, camera in cameras:
            with torch.no_grad():
                image = rasterize(stored.gaussians, camera, options).rgb.cpu().numpy()
            write_bytes(out / f"{name}.png", png(image))
            yield image

    if one_size:
        write_mp4(out / "film.mp4", images(), fps)
        return f"{len(cameras)} pictures and film.mp4 in {out}"
    count = sum(1 for _ in images())
    return f"{count} pictures in {out}; no film, since the views differ in size"


def export(folder: Path, target: Path) -> str:
    """Write a run's Gaussians to a file, in the coordinates of the input; returns a line for the user.

    Raises:
        DataError: The folder is no run.
        UsageError: The suffix is not supported.
    """
    if target.suffix.lower() != ".ply":
        raise UsageError(f"{target}: format {target.suffix or '(none)'} is not supported; use .ply")
    stored = open_run(folder, torch.device("cpu"))
    write_ply(target, drop_unused_sh(stored.gaussians), stored.normalization)
    return f"{len(stored.gaussians):,} Gaussians in {target}"
