"""What a fit leaves for people: pictures of held-out views, scores, the report page."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path, PurePosixPath

import numpy as np

from warpgs.files import write_bytes
from warpgs.io.splits import Split
from warpgs.pipeline.metrics.evaluate import ViewMetrics, baselines, render_view, score, summarize, variants
from warpgs.pipeline.metrics.lpips import Lpips
from warpgs.render.rasterize import RasterizeOptions
from warpgs.report.curve import curve
from warpgs.report.events import read_events
from warpgs.report.images import depth_map, error_map, png, side_by_side
from warpgs.report.overview import render_overview
from warpgs.report.page import SamplingReport, ViewImages, write_page
from warpgs.runtime.byte_units import format_bytes
from warpgs.scene import Gaussians, Scene, View

LABELS = {
    "psnr": "PSNR [dB]", "ssim": "SSIM", "ssim_skimage": "SSIM (scikit-image)",
    "lpips_vgg_legacy": "LPIPS-VGG [0, 1]", "lpips_vgg_standard": "LPIPS-VGG [-1, 1]",
    "lpips_alex_legacy": "LPIPS-Alex [0, 1]", "lpips_alex_standard": "LPIPS-Alex [-1, 1]", "lpips": "LPIPS",
}  # fmt: skip
"""Names of figures for people."""


def score_keys(metrics: dict) -> list[str]:
    """Names of the figures that result files hold for held-out views, in the order to show them."""
    return [k for k in LABELS if k in metrics["test"]]


def score_line(scores: dict[str, float]) -> str:
    """Mean figures as one line for people."""
    distances = [f", {LABELS[k]} {v:.3f}" for k, v in scores.items() if k.startswith("lpips")]
    return f"PSNR {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.3f}{''.join(distances) or ', LPIPS not measured'}"


SHOWN_VIEWS = 6
"""Held-out views with pictures in the report; all have files in the run folder."""
RENDER_WORKERS = 4
"""Threads that score and encode pictures while others are drawn."""


def options_for(
    rule: str, background: tuple[float, float, float], gaussians: Gaussians, max_instances: int | None = None
) -> RasterizeOptions:
    """Rendering options of a run."""
    return RasterizeOptions(rule=rule, background=gaussians.means.new_tensor(background), max_instances=max_instances)


def file_stem(name: str) -> str:
    """A view's name as one file name without suffix."""
    return str(PurePosixPath(name).with_suffix("")).replace("/", "_")


def protocol_of(scene: Scene, spec: str | None, downscale: int, train: list[View], test: list[View]) -> dict:
    """What scores must agree in before they may be compared; stands in every result file and on the page."""
    sizes = sorted({(v.camera.width, v.camera.height) for v in test or train})
    return {
        "split": spec or "default (no --split given)", "training_views": len(train), "held_out_views": len(test),
        "ground_truth": scene.pixels, "downscale": downscale, "resolution": [f"{w} x {h}" for w, h in sizes],
        "score_masks": sum(v.score_mask is not None for v in test),
    }  # fmt: skip


def evaluate_run(
    out: Path,
    gaussians: Gaussians,
    train: list[View],
    test: list[View],
    rule: str,
    background: tuple[float, float, float],
    lpips: Lpips | None = None,
    max_instances: int | None = None,
) -> dict:
    """Score held-out and training views, and save a picture and a depth map of each held-out view.

    Where no view is held out, the pictures are of the training views. LPIPS is measured on held-out views alone.
    ``max_instances`` as in RasterizeOptions.

    Returns:
        Means over held-out and over training views, a row per held-out view, what guessing scores, and what each figure is.
    """
    options = options_for(rule, background, gaussians, max_instances)
    (out / "renders").mkdir(exist_ok=True)
    (out / "depth").mkdir(exist_ok=True)

    def finish(view: View, image: np.ndarray, depth: np.ndarray, alpha: np.ndarray) -> ViewMetrics:
        stem = file_stem(view.name)
        row = side_by_side([np.clip(image, 0, 1), view.image, error_map(image, view.image)])
        write_bytes(out / "renders" / f"{stem}.png", png(row))
        write_bytes(out / "depth" / f"{stem}.png", png(depth_map(depth, alpha)))
        return score(view, image, lpips if test else None)

    def compare(view: View, image: np.ndarray, *_) -> ViewMetrics:
        return score(view, image)

    tasks, jobs = [(finish, v) for v in test or train] + [(compare, v) for v in train if test], []
    with ThreadPoolExecutor(RENDER_WORKERS if lpips is None else 1) as render_workers:  # LPIPS takes much memory a view
        for work, view in tasks:
            jobs.append(render_workers.submit(work, view, *render_view(gaussians, view, options)))
            if len(jobs) > RENDER_WORKERS:
                jobs[-RENDER_WORKERS].result()  # not all pictures at once
        found = [j.result() for j in jobs]
    rows, train_rows = found[: len(test)], found[-len(train) :]
    return {
        "test": summarize(rows), "train": summarize(train_rows),
        "views": [r.row() for r in rows],
        "baselines": baselines(train, test) if test else {},
        "variants": variants(lpips),
    }  # fmt: skip


def _images(views: list[View], gaussians: Gaussians, options: RasterizeOptions, rows: dict[str, dict]) -> list[ViewImages]:
    chosen = [views[i] for i in np.unique(np.linspace(0, len(views) - 1, min(SHOWN_VIEWS, len(views))).round().astype(int))]
    result = []
    with ThreadPoolExecutor(RENDER_WORKERS) as render_workers:
        for view in chosen:
            image, depth, alpha = render_view(gaussians, view, options)
            row = rows.get(view.name)
            region = f", over {row['region']}" if row and row["region"] != "all" else ""
            caption = f"PSNR {row['psnr']:.2f} dB{region}, SSIM {row['ssim']:.3f}" if row else "training view"
            parts = (image, view.image, error_map(image, view.image), depth_map(depth, alpha))
            result.append((view.name, caption, render_workers.map(png, parts)))
    return [ViewImages(name, caption, *parts) for name, caption, parts in result]


def write_report(
    out: Path, scene: Scene, split: Split, gaussians: Gaussians, metrics: dict, record: dict, sampling: SamplingReport | None
) -> None:
    """Write report.html for a run whose scores are known; ``sampling`` is what it says of sampling events, if any."""
    train, test = [scene.view(n) for n in split.train], [scene.view(n) for n in split.test]
    notes = list(record["notes"])
    means = gaussians.means.cpu().numpy()
    colors = np.clip(0.28209479 * gaussians.sh[:, 0].cpu().numpy() + 0.5, 0, 1)
    sample = np.random.default_rng(0).permutation(len(means))[:60_000]
    cameras = ([v.camera for v in train], [v.camera for v in test])
    overview, why = render_overview(*cameras, means[sample].astype(np.float64), colors[sample])
    if why:
        notes.append(why)
        print(f"  {why}")
    events = read_events(out / "metrics.jsonl")
    steps = [e["step"] for e in events]
    curves = [
        curve("Training loss", steps, [e["loss"] for e in events]),
        curve("Training PSNR", steps, [e["psnr"] for e in events], "dB"),
        curve("Gaussians", steps, [e["count"] for e in events]),
    ]
    figures = []
    if metrics["test"]:
        best = max(metrics["baselines"].values(), default=float("nan"))
        figures = [
            ("held-out PSNR", f"{metrics['test']['psnr']:.2f} dB"), ("held-out SSIM", f"{metrics['test']['ssim']:.3f}"),
            ("best guess without a fit", f"{best:.2f} dB"),
        ]  # fmt: skip
    seconds = metrics["seconds"]
    figures += [
        ("training PSNR", f"{metrics['train']['psnr']:.2f} dB"), ("Gaussians", f"{metrics['gaussians']:,}"),
        ("mean SH degree", f"{metrics['complexity']['mean_degree']:.2f}"),
        ("model", format_bytes(metrics["complexity"]["bytes"])),
        ("steps", f"{metrics['steps']:,}"), ("time", f"{seconds['total']:.0f} s"),
    ]  # fmt: skip
    keys = score_keys(metrics)
    table = [["view", *(LABELS.get(k, k) for k in keys), "pixels"]] + [
        [r["name"], *(f"{r[k]:.{2 if k == 'psnr' else 4}f}" for k in keys), r["region"]] for r in metrics["views"]
    ]
    options = options_for(record["config"]["rule"], tuple(record["background"]), gaussians)
    images = _images(test or train, gaussians, options, {r["name"]: r for r in metrics["views"]})
    camera = train[0].camera
    details = {k: v for k, v in record.items() if k != "cameras"}
    protocol = {k.replace("_", " "): ", ".join(v) if isinstance(v, list) else str(v) for k, v in metrics["protocol"].items()}
    protocol["configuration"] = f"{metrics['config_hash']}, step {metrics['steps']:,}"
    write_page(
        out / "report.html",
        title=Path(scene.path).resolve().name,
        subtitle=f"preset {metrics['preset']}, {len(train)} training views, {len(test)} held out, "
        f"{camera.width} x {camera.height} px, {metrics['device']}",
        figures=figures, notes=notes, table=table, views=images, curves=curves, sampling=sampling, overview=overview,
        details=details,
        protocol=protocol | {LABELS.get(k, k): v for k, v in metrics["variants"].items()},
    )  # fmt: skip
