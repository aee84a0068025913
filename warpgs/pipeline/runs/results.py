"""Results of a fit for the user: images of held-out views, scores, the report page."""

from __future__ import annotations

import math
import shlex
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.colors import base_colors
from warpgs.files import make_folder, write_bytes
from warpgs.io.splits import Split
from warpgs.pipeline.films.rig import up_of
from warpgs.pipeline.metrics.evaluate import (
    ALPHA_VARIANTS,
    ViewMetrics,
    baselines,
    render_view,
    score,
    summarize,
    variants,
)
from warpgs.pipeline.metrics.lpips import Lpips
from warpgs.pipeline.runs.coverage_report import coverage_section
from warpgs.render.options import RasterizeOptions
from warpgs.report.curve import curve
from warpgs.report.events import read_events
from warpgs.report.image_names import image_names
from warpgs.report.images import depth_map, error_map, png, side_by_side, webp
from warpgs.report.overview import render_overview
from warpgs.report.page import Page, SamplingReport, ViewImages, write_page
from warpgs.report.progress import duration
from warpgs.runtime.byte_units import format_bytes
from warpgs.runtime.terminal import counted
from warpgs.scene import Gaussians, Scene, View

Overview = tuple[bytes | None, str]
"""PNG of the 3D overview and an empty text, or None and the reason."""
LABELS = {
    "psnr": "PSNR [dB]", "psnr_whole": "PSNR, whole image [dB]", "psnr_foreground": "PSNR, foreground [dB]",
    "alpha_empty": "alpha where empty", "alpha_object": "alpha in the object",
    "ssim": "SSIM", "ssim_skimage": "SSIM (scikit-image)",
    "lpips_vgg_legacy": "LPIPS-VGG [0, 1]", "lpips_vgg_standard": "LPIPS-VGG [-1, 1]",
    "lpips_alex_legacy": "LPIPS-Alex [0, 1]", "lpips_alex_standard": "LPIPS-Alex [-1, 1]", "lpips": "LPIPS",
}  # fmt: skip
"""Names of scores as shown to the user."""
BASELINES = {"mean_photo": "the mean photograph", "nearest_photo": "the nearest photograph"}
"""Images that are scored without a fit, as text for the user."""
SHOWN_VIEWS = 6
"""Held-out views with images in the report; all have files in the run folder."""
RENDER_WORKERS = 4
"""Threads that score and encode images while others are rendered."""
OVERVIEW_POINTS = 60_000
"""Gaussians shown in the 3D overview, sampled at random."""


def score_keys(metrics: dict[str, Any]) -> list[str]:
    """Return the names of the scores that result files hold for held-out views, in the order to show them."""
    return [k for k in LABELS if k in metrics["test"]]


def score_line(scores: dict[str, float]) -> str:
    """Return mean scores as one line for the user."""
    distances = [f", {LABELS[k]} {v:.3f}" for k, v in scores.items() if k.startswith("lpips")]
    opacity = [f", {LABELS[k]} {v:.3f}" for k, v in scores.items() if k.startswith("alpha")]
    if "psnr_foreground" in scores:
        opacity.insert(0, f", PSNR of the foreground {scores['psnr_foreground']:.2f} dB")
    lpips = "".join(distances) or ", LPIPS not measured"
    return f"PSNR {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.3f}{''.join(opacity)}{lpips}"


def summary_line(metrics: dict[str, Any]) -> str:
    """Return scores, size and time of a run, from metrics.json, as one line for the user."""
    size = f"{metrics['gaussians']:,} Gaussians, {metrics['steps']:,} steps"
    return f"{score_line(metrics['test'])}; {size}, {duration(metrics['seconds']['total'])}"


def result_lines(metrics: dict[str, Any], out: Path | None) -> list[str]:
    """Return the final lines of a fit: scores, size, time, the path of the report, and the next steps.

    Args:
        metrics: Contents of metrics.json.
        out: The run folder, or None.
    """
    if metrics["test"]:
        best = ", ".join(f"{BASELINES.get(name, name)} {value:.2f} dB" for name, value in metrics["baselines"].items())
        lines = [
            f"held-out {score_line(metrics['test'])} ({len(metrics['views'])} views)",
            *([f"  for comparison, without a fit: {best}"] if best else []),
            *([f"  {metrics['coverage']['summary']}"] if "coverage" in metrics else []),
        ]
    else:
        lines = [f"training PSNR {metrics['train']['psnr']:.2f} dB (no score of new views: no view is held out)"]
    compiling = metrics["seconds"].get("compiling", 0.0)
    once = f", of which {duration(compiling)} to compile kernels, once on this machine" if compiling >= 1 else ""
    size = format_bytes(metrics["complexity"]["bytes"])
    lines.append(f"{metrics['gaussians']:,} Gaussians, {size}, in {duration(metrics['seconds']['total'])}{once}")
    if out is None:
        return [*lines, "nothing was written to disk, because no run folder (out) was given"]
    run = shlex.quote(str(out))
    commands = {
        f"warpgs view {run}": "to look around in a browser", f"warpgs render {run}": "for a film",
        f"warpgs export {run} --to scene.html": "for one file that opens anywhere",
    }  # fmt: skip
    width = max(map(len, commands))
    following = [f"  {command:<{width}}  {purpose}" for command, purpose in commands.items()]
    return [*lines, f"report: {out / 'report.html'}", "next:", *following]


def protocol_of(scene: Scene, spec: str | None, downscale: int, train: list[View], test: list[View]) -> dict[str, Any]:
    """Return the conditions that must be equal for scores to be comparable, for result files and the page."""
    sizes = sorted({(v.camera.width, v.camera.height) for v in test or train})
    return {
        "split": spec or "all (no --split given)", "training_views": len(train), "held_out_views": len(test),
        "ground_truth": scene.pixels, "downscale": downscale, "resolution": [f"{w} x {h}" for w, h in sizes],
        "score_masks": sum(v.score_mask is not None for v in test),
    }  # fmt: skip


def evaluate_run(
    out: Path | None,
    gaussians: Gaussians,
    train: list[View],
    test: list[View],
    options: RasterizeOptions,
    lpips: Lpips | None = None,
    *,
    names: dict[str, str] | None = None,
    tell: Callable[[str], object] = lambda line: None,
) -> dict[str, Any]:
    """Score held-out and training views, and save a render and a depth map of each held-out view.

    If no view is held out, the images show training views. LPIPS is measured only on held-out views.

    Args:
        out: The run folder; None to write nothing.
        gaussians: N Gaussians in scene units [u].
        train: Training views.
        test: Held-out views.
        options: Options of the rasterizer.
        lpips: Network for LPIPS, or None.
        names: Names of image files by view, from `image_names` of the whole scene; None to make names for these views only.
        tell: Called with a line for each view before it is rendered.

    Returns:
        Means over held-out and over training views, a row per held-out view, scores of baselines, and definitions of scores.
    """
    for folder in () if out is None else ("renders", "depth"):
        make_folder(out / folder)
    files = names or image_names(v.name for v in [*train, *test])

    def finish(view: View, image: np.ndarray, depth: np.ndarray, alpha: np.ndarray) -> ViewMetrics:
        if out is not None:
            _write_images(out, f"{files[view.name]}.png", view, image, depth, alpha)
        return score(view, image, lpips if test else None, alpha)

    def compare(view: View, image: np.ndarray, depth: np.ndarray, alpha: np.ndarray) -> ViewMetrics:
        return score(view, image, alpha=alpha)

    tasks, jobs = [(finish, v) for v in test or train] + [(compare, v) for v in train if test], []
    with ThreadPoolExecutor(RENDER_WORKERS if lpips is None else 1) as render_workers:  # LPIPS needs much memory for each view
        for work, view in counted(tasks, tell, "scoring", "views"):
            jobs.append(render_workers.submit(work, view, *render_view(gaussians, view, options)))
            if len(jobs) > RENDER_WORKERS:
                jobs[-RENDER_WORKERS].result()  # not all images at once
        found = [j.result() for j in jobs]
    rows, train_rows = found[: len(test)], found[-len(train) :]
    return {
        "test": summarize(rows), "train": summarize(train_rows),
        "views": [r.row() for r in rows],
        "variants": variants(lpips) | (ALPHA_VARIANTS if any(r.opacity for r in found) else {}),
        "baselines": baselines(train, test) if test else {},
    }  # fmt: skip


def _write_images(out: Path, name: str, view: View, image: np.ndarray, depth: np.ndarray, alpha: np.ndarray) -> None:
    """Write the render [H, W, 3] of a view beside its photograph and the error, and the depth map [H, W]."""
    row = side_by_side([np.clip(image, 0, 1), view.image, error_map(image, view.image)])
    write_bytes(out / "renders" / name, png(row))
    write_bytes(out / "depth" / name, png(depth_map(depth, alpha)))


def _images(
    views: list[View], gaussians: Gaussians, options: RasterizeOptions, rows: dict[str, Any], tell: Callable[[str], object]
) -> list[ViewImages]:
    """Render up to `SHOWN_VIEWS` of the views, evenly spaced, and encode their images for the page."""
    chosen = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, min(SHOWN_VIEWS, len(views))).round().astype(int))]
    result = []
    with ThreadPoolExecutor(RENDER_WORKERS) as render_workers:
        for view in counted(chosen, tell, "making the report", "views"):
            image, depth, alpha = render_view(gaussians, view, options)
            row = rows.get(view.name)
            region = f", over {row['region']}" if row and row["region"] != "all" else ""
            caption = f"PSNR {row['psnr']:.2f} dB{region}, SSIM {row['ssim']:.3f}" if row else "training view"
            parts = (image, view.image, error_map(image, view.image), depth_map(depth, alpha))
            result.append((view.name, caption, render_workers.map(webp, parts)))
    return [ViewImages(name, caption, *parts) for name, caption, parts in result]


def overview_of(gaussians: Gaussians, train: list[View], test: list[View]) -> Callable[[], Overview]:
    """Return a function that plots the 3D overview in a separate process; the function may be called from another thread."""
    means = gaussians.means.detach().cpu().numpy()
    colors = np.clip(base_colors(gaussians.sh[:, :1].detach().cpu().numpy()), 0, 1)
    sample = np.random.default_rng(0).permutation(len(means))[:OVERVIEW_POINTS]
    points, cameras = means[sample].astype(np.float64), ([v.camera for v in train], [v.camera for v in test])
    up = up_of(cameras[0], points)
    return lambda: render_overview(*cameras, points, colors[sample], up)


def _figures(metrics: dict[str, Any]) -> list[tuple[str, str]]:
    """Return the main figures of the page as pairs of label and value."""
    held_out = []
    if metrics["test"]:
        best = max(metrics["baselines"].values(), default=float("nan"))
        held_out = [
            ("held-out PSNR", f"{metrics['test']['psnr']:.2f} dB"), ("held-out SSIM", f"{metrics['test']['ssim']:.3f}"),
            ("best baseline without a fit", f"{best:.2f} dB"),
        ]  # fmt: skip
        alphas = [k for k in ("alpha_empty", "alpha_object") if k in metrics["test"]]
        held_out += [(LABELS[k], f"{metrics['test'][k]:.3f}") for k in alphas]
    return [
        *held_out,
        ("training PSNR" if held_out else "training PSNR: no score of new views", f"{metrics['train']['psnr']:.2f} dB"),
        ("Gaussians", f"{metrics['gaussians']:,}"),
        ("model", format_bytes(metrics["complexity"]["bytes"])),
        ("steps", f"{metrics['steps']:,}"), ("time", duration(metrics["seconds"]["total"])),
    ]  # fmt: skip


def _protocol(metrics: dict[str, Any]) -> dict[str, str]:
    """Return the conditions and the definitions of the scores, as text of the page."""
    words = {k.replace("_", " "): ", ".join(v) if isinstance(v, list) else str(v) for k, v in metrics["protocol"].items()}
    words["configuration"] = f"{metrics['config_hash']}, step {metrics['steps']:,}"
    return words | {LABELS.get(k, k): v for k, v in metrics["variants"].items()}


def write_report(
    out: Path,
    scene: Scene,
    split: Split,
    gaussians: Gaussians,
    options: RasterizeOptions,
    metrics: dict[str, Any],
    record: dict[str, Any],
    *,
    sampling: SamplingReport | None,
    overview: Overview,
    tell: Callable[[str], object] = lambda line: None,
) -> None:
    """Write report.html for a scored run.

    Args:
        out: The run folder, with the curves in metrics.jsonl.
        scene: The scene.
        split: Its views to fit and those held out.
        gaussians: The fitted model, in scene units [u].
        options: Options of the rasterizer.
        metrics: Contents of metrics.json.
        record: Contents of config.json.
        sampling: The part on sampling events, or None.
        overview: Result of the function of `overview_of`.
        tell: Called with a line for each view before it is rendered.
    """
    train, test = [scene.view(n) for n in split.train], [scene.view(n) for n in split.test]
    image, why = overview
    notes = [*record["notes"], *([why] if why else [])]
    events = read_events(out / "metrics.jsonl")
    steps = [e["step"] for e in events]
    curves = [
        curve(title, steps, [e.get(name, math.nan) for e in events], unit)
        for title, name, unit in (("Training loss", "loss", ""), ("Training PSNR", "psnr", "dB"), ("Gaussians", "count", ""))
    ]
    keys = score_keys(metrics)
    table = [["view", *(LABELS.get(k, k) for k in keys), "pixels"]] + [
        [r["name"], *(f"{r.get(k, math.nan):.{2 if k.startswith('psnr') else 4}f}" for k in keys), r["region"]]
        for r in metrics["views"]
    ]
    images = _images(test or train, gaussians, options, {r["name"]: r for r in metrics["views"]}, tell)
    covered = None
    if "coverage" in metrics:
        names = image_names(v.name for v in scene.views)
        covered = coverage_section(out, metrics["coverage"], [v.name for v in images], names)
    camera = train[0].camera
    page = Page(
        title=(out if Path(scene.path).parent == out else Path(scene.path)).resolve().name,  # not "scene" for found poses
        subtitle=f"preset {metrics['preset']}, {len(train)} training views, {len(test)} held out, "
        f"{camera.width} x {camera.height} px, {metrics['device']}",
        figures=_figures(metrics), notes=notes, table=table, views=images, curves=curves, sampling=sampling,
        overview=None if image is None else webp(image), held_out=bool(test),
        details={k: v for k, v in record.items() if k != "cameras"}, protocol=_protocol(metrics),
        coverage=covered,
    )  # fmt: skip
    write_page(out / "report.html", page)
