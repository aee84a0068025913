"""Results of a fit: figures, images and notes, for metrics.json and the report."""

import contextlib
import math
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgs.clock import largest, times_line
from warpgs.constants import TILE_SIZE
from warpgs.device import format_bytes, in_background
from warpgs.errors import ResourceError
from warpgs.files import make_folder, read_file, write_bytes
from warpgs.geometry import CENTRAL, MODELS, depth_normals, evenly_spaced
from warpgs.io.image_files import decode
from warpgs.io.load import Split
from warpgs.mesh.views import MIN_ALPHA
from warpgs.pipeline.films.paths import Rig, midways, rig_among
from warpgs.pipeline.metrics.coverage import coverage_map, coverage_section, depth_views
from warpgs.pipeline.metrics.lpips import Lpips
from warpgs.pipeline.metrics.scores import Renders, baselines, psnr_of, score, summarize, variants
from warpgs.pipeline.train.loss import GIVEN_MIN_ALPHA
from warpgs.pipeline.train.schedule import Phases
from warpgs.pipeline.train.strategies.sampling import SampledView, Sampling
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import TrainingView
from warpgs.process import Detail, Say, counted, silent
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.render.reference import reference_image
from warpgs.report.images import Tile, contact_sheet, depth_map, error_map, png, side_by_side, webp
from warpgs.report.overview import render_overview
from warpgs.report.page import Section, curve, image_names, write_page
from warpgs.report.progress import duration, read_events
from warpgs.scene import Camera, Gaussians, Render, Scene, View

GIVEN = {
    "given_depth": ("depth", "given depth: median difference of rendered depth {:.2%} (worst view {:.2%})"),
    "given_normals": (
        "normals", "given normals: median difference of the normals of rendered depth {:.1f} degrees (worst view {:.1f})"
    ),
}  # fmt: skip
"""Name in metrics.json, and summary, of each map of the loss terms."""


def given_figures(train: Sequence[View], views: Sequence[TrainingView], renders: Renders) -> dict[str, Any]:
    """Compare the model with given depth and normals: rows by view and a summary, for each kind that a loss term compared."""
    rows: dict[str, list[dict[str, Any]]] = {name: [] for name in GIVEN}
    for view, mapped in zip(train, views, strict=True):
        maps = {n: t.cpu().numpy() for n, t in mapped.maps.items() if n in GIVEN and bool(t.any())}
        if not maps:
            continue
        _, depth, alpha = renders(view.camera)
        shown = alpha > GIVEN_MIN_ALPHA
        for name, given in maps.items():
            if name == "given_depth":
                scaled, weight, unit = np.moveaxis(given, -1, 0)
                at = weight > 0
                both = at & shown
                off = np.abs(depth[both] * scaled[both] / unit[both] - 1)
            else:
                K = torch.from_numpy(view.camera.K).float()
                camera = replace(view.camera, viewmat=torch.eye(4, dtype=torch.float32, device="cpu"), K=K)
                found = depth_normals(camera, torch.as_tensor(np.where(shown, depth, 0), dtype=torch.float32)).numpy()
                at = given.any(-1)
                both = at & found.any(-1)
                off = np.degrees(np.arccos((given[both] * found[both]).sum(-1).clip(-1, 1)))
            difference = float(np.median(off)) if len(off) else math.nan
            rows[name].append({"name": view.name, "coverage": float(at.mean()), "difference": difference})
    figures = {}
    for name, (kind, words) in GIVEN.items():
        if own := rows[name]:
            off = [r["difference"] for r in own if np.isfinite(r["difference"])] or [math.nan]
            share = float(np.mean([r["coverage"] for r in own]))
            summary = f"{words.format(float(np.median(off)), max(off))}, over {share:.1%} of the pixels of {len(own)} views"
            figures[kind] = {"views": own, "summary": summary}
    return figures


VIEWS = 3
"""Number of training views that are compared, sampled at random."""
SIDE = 64
"""Side of the part of each view that is compared [px], a multiple of the tile size."""


def _window(camera: Camera, generator: np.random.Generator) -> tuple[int, int, int, int]:
    """Sample a part of an image, [left, top, width, height], with edges at tile edges or image edges."""
    x, y = (TILE_SIZE * int(generator.integers(max(0, size - SIDE) // TILE_SIZE + 1)) for size in (camera.width, camera.height))
    return x, y, min(SIDE, camera.width - x), min(SIDE, camera.height - y)


def _milliseconds(render: Callable[[], Render]) -> float:
    """Return the wall time of the second of two calls [ms]: the first loads kernels and allocates."""
    for _ in range(2):
        began = time.perf_counter()
        render().rgb.sum().item()  # waits for the device
    return 1000 * (time.perf_counter() - began)


@torch.no_grad()
def rule_report_of(
    gaussians: Gaussians, views: list[View], options: RasterizeOptions, *, seed: int, half_resolution: float = 0.0
) -> dict[str, Any]:
    """Measure error and saved time of a rule on 64 x 64 px of three random views against rule `exact` in float64."""
    # Three random views are rendered with the rule, as in the fit. 64 x 64 px of each are compared with the image of rule
    # `exact` in float64. That image is computed by `warpgs.render.reference` without the kernels, or by the kernels if
    # `warpgs.geometry` does not have the camera model.
    generator = np.random.default_rng(seed)
    chosen = [views[i] for i in sorted(generator.permutation(len(views))[:VIEWS])]
    assert options.background is not None
    options = replace(options, background=options.background.to(gaussians.means))
    exact, errors, windows = replace(options, rule="exact"), [], {}
    for view in chosen:
        window = windows[view.name] = _window(view.camera, generator)
        found = rasterize(gaussians, view.camera, replace(options, window=window)).rgb
        # what reaches the part under `exact`; tiles are listed with a margin
        near = rasterize(gaussians, view.camera, replace(exact, window=window)).visible[0]
        part = Gaussians(**{n: t[near] for n, t in gaussians.tensors().items()})
        errors.append((found.double() - _wanted(part, view.camera, window, exact)).abs().flatten())
    error, camera = torch.cat(errors), chosen[0].camera
    result = {
        "rule": options.rule, "max": float(error.max()), "mean": float(error.mean()), "psnr": psnr_of(float((error**2).mean())),
        "views": {n: list(w) for n, w in windows.items()}, "half_resolution": half_resolution,
        "render_ms": _milliseconds(lambda: rasterize(gaussians, camera, options)),
    }  # fmt: skip
    if options.rule != "exact":
        result["exact_ms"] = _milliseconds(lambda: rasterize(gaussians, camera, exact))
    return result | {"summary": _summary(result)}


def _wanted(part: Gaussians, camera: Camera, window: tuple[int, int, int, int], exact: RasterizeOptions) -> torch.Tensor:
    """Return a part of an image under `exact` in float64; by the kernels for camera models that the reference lacks."""
    if camera.model not in MODELS:
        doubled = Gaussians(**{n: t.double() for n, t in part.tensors().items()})
        return rasterize(doubled, camera, replace(exact, background=exact.background.double(), window=window)).rgb
    count = torch.get_num_threads()
    torch.set_num_threads(1)  # for many small tensors, threads wait for each other longer than they compute
    try:
        return reference_image(part, camera, window, exact.background, part.sh_degree, exact.antialiased)
    finally:
        torch.set_num_threads(count)


def _summary(r: dict[str, Any]) -> str:
    """Return the figures as one sentence for the user."""
    error = (
        f"{r['mean']:.1e} on average, {r['max']:.1e} at most, {r['psnr']:.0f} dB, on parts of {len(r['views'])} training views"
    )
    words = f"rule exact has the cut-offs of 3DGS (docs/conventions.md); within them, float32 differs from float64 by {error}"
    if r["rule"] != "exact":
        words = f"images by rule {r['rule']} differ from images by rule exact in float64 by {error}; a view took "
        words += f"{r['render_ms']:.1f} ms, and {r['exact_ms']:.1f} ms with rule exact"
    return words + f"; {r['half_resolution']:.0%} of the steps used views of half size" * (r["half_resolution"] > 0)


FOLDER = "sampling"
"""Subfolder of a run with the images, ``STEP.png``."""
SHOWN = 3
"""Number of views in an image."""
SHEET_WIDTH = 1600
"""Largest width of an image on the report page [px]."""
OPEN, CLOSED = (0.97, 0.97, 0.95), (0.17, 0.19, 0.22)
"""Colours of pixels that pass the gate, and of all others."""
FADED = 0.45
"""Contrast of the view's image behind the dots."""


def shown_steps(phases: Phases) -> set[int]:
    """Return the steps of the events that get an image: the first event, and the first event in the second half of phase 2."""
    middle = 0.5 * (phases.refine + phases.stable_start)
    return {*phases.events[:1], *[e for e in phases.events if e >= middle][:1]}


def _open_pixels(strategy: Sampling, consistent: bool, quantile: float) -> str:
    """Describe the pixels that pass a gate, in a view with or without ``consistent`` depth."""
    parts = ["with a depth that other views confirm"] * (consistent and strategy.consistent and strategy.gated)
    parts += [f"with S_geometry above its {quantile:g} quantile"] * (quantile > 0)
    return f"pixels {' and '.join(parts)}" if parts else "all pixels that Gaussians cover"


def view_sheet(
    name: str, step: int, view: TrainingView, disparity: np.ndarray | None, sampled: SampledView, strategy: Sampling
) -> np.ndarray:
    """Return a sheet of one view at one event, colours [rows, columns, 3]: images, gate, samples, scores of weight above 0."""
    image, at, gate = (t.cpu().numpy() for t in (view.image, sampled.at, sampled.gate))
    scores = {n: score.cpu().numpy() for n, score in sampled.scores.items()}
    tiles = [  # each score is shown below its inputs
        Tile("render before", sampled.rendered.cpu().numpy()),
        Tile("image", image),
        *([] if disparity is None else [Tile("disparity, near is 1", disparity, "TURBO")]),
        Tile("gate", np.where(gate[..., None], OPEN, CLOSED).astype(np.float32)),
        Tile("sampled pixels", 1 - FADED * (1 - image.mean(-1, keepdims=True).repeat(3, -1)), dots=at),
        *(Tile(n, score) for n, score in scores.items()),
    ]
    lines = [
        f"{len(at):,} pixels sampled of the {gate.sum():,} that pass the gate, {gate.mean():.0%} of the view.",
        f"Gate: {_open_pixels(strategy, view.consistent is not None, sampled.quantile)}.",
    ]
    return contact_sheet(f"{name}, step {step:,}", lines, tiles, columns=5, tile_width=320)


def _on_host(sampled: SampledView) -> SampledView:
    """Return a copy with its maps in host memory."""
    maps = {n: getattr(sampled, n).cpu() for n in ("rendered", "gate", "at")}
    return replace(sampled, scores={n: t.cpu() for n, t in sampled.scores.items()}, **maps)


@contextlib.contextmanager
def images_kept(fit: Trainer, names: list[str], out: Path) -> Iterator[Callable[[], None]]:
    """Write images of some events, ``sampling/STEP.png``, in a thread during the block; yields a function that awaits them."""
    # Call the function before a checkpoint, since a fit that continues from it does not write earlier images. If an image
    # cannot be written, the fit continues, with one message in ``fit.messages``.
    strategy, disparities = fit.strategy, fit.disparities or [None] * len(names)
    writing: list[Future[None]] = []

    def written() -> None:
        for sheet in writing:
            sheet.result()  # or what went wrong

    if not isinstance(strategy, Sampling):
        yield written
        return

    def write(step: int, views: list[TrainingView], kept: list[SampledView]) -> None:
        sheets = [view_sheet(names[d.view], step, v, disparities[d.view], d, strategy) for v, d in zip(views, kept)]
        try:
            make_folder(out / FOLDER)
            write_bytes(out / FOLDER / f"{step:06d}.png", png(np.concatenate(sheets)))
        except ResourceError as e:
            fit.messages.append(f"an image of sampling events is missing from the report: {e}")

    def on_event(step: int, sampled: Sequence[SampledView]) -> None:
        # the thread must not use the device, since steps may be captured at that time
        kept = [_on_host(d) for d in evenly_spaced(sampled, SHOWN)]
        views = [replace(fit.views[d.view], image=fit.views[d.view].image.cpu()) for d in kept]
        writing.append(thread.submit(write, step, views, kept))

    with ThreadPoolExecutor(1) as thread:
        strategy.on_event, strategy.shown = on_event, shown_steps(fit.phases)
        try:
            yield written
        finally:
            strategy.on_event = strategy.shown = None
    written()


def event_figures(fit: Trainer) -> dict[str, Any]:
    """Return for metrics.json the sums over the events of a fit (``events``), and the sizes of its two layers (``layers``)."""
    s = fit.strategy
    events, fine, asked = (s.events, int(s.fine.sum()), s.asked_quantile) if isinstance(s, Sampling) else ([], 0, 0.0)
    quantiles = [q for e in events for q in e["quantiles"]]
    return {
        "events": {
            "count": len(events), **{k: sum(e[k] for e in events) for k in ("added", "evicted")},
            "samplings": len(quantiles), "widened": sum(q < asked for q in quantiles),
        },
        "layers": {"coarse": len(fit.gaussians) - fine, "fine": fine},
    }  # fmt: skip


def sampling_report_of(fit: Trainer, out: Path) -> Section | None:
    """Return the report's part on the sampling events of a finished fit; None without events."""
    strategy, figures = fit.strategy, event_figures(fit)
    events, layers = figures["events"], figures["layers"]
    if not events["count"]:
        return None
    how = "sampled at random in proportion to S_importance" if strategy.scored else "sampled uniformly at random"
    if not strategy.at_random:
        how = "the highest in S_importance"
    depth = "consistent" if strategy.consistent else "rendered"
    words = (
        f"Each dot is a pixel behind which a fine Gaussian was added at the {depth} depth, while the layer had capacity. These "
        f"pixels are {how}, among {_open_pixels(strategy, True, strategy.asked_quantile)} (the gate)."
    )
    table = [
        ["sampling events", "Gaussians added", "evicted", "coarse at the end", "fine at the end"],
        [f"{n:,}" for n in (events["count"], events["added"], events["evicted"], layers["coarse"], layers["fine"])],
    ]
    files = sorted(p for p in (out / FOLDER).glob("*.png") if p.stem.isdecimal())  # others are not ours
    images = in_background(lambda p: webp(decode(p, data=read_file(p, out))[0], SHEET_WIDTH, 70), ((p,) for p in files))
    return words, [(f"sampling after step {int(p.stem):,}", image) for p, image in zip(files, images)], table, ""


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


def score_line(scores: dict[str, float]) -> str:
    """Return mean scores as one line for the user."""
    parts = [f"PSNR {scores['psnr']:.2f} dB", f"SSIM {scores['ssim']:.3f}"]
    parts += [f"PSNR of the foreground {scores['psnr_foreground']:.2f} dB"] if "psnr_foreground" in scores else []
    parts += [f"{LABELS[k]} {v:.3f}" for kind in ("alpha", "lpips") for k, v in scores.items() if k.startswith(kind)]
    return ", ".join([*parts, *([] if any(k.startswith("lpips") for k in scores) else ["LPIPS not measured"])])


def summary_line(metrics: dict[str, Any]) -> str:
    """Return scores, size and time of a run, from metrics.json, as one line for the user."""
    size = f"{metrics['gaussians']:,} Gaussians, {metrics['steps']:,} steps"
    return f"{score_line(metrics['test'])}; {size}, {duration(metrics['seconds']['total'])}"


def over_region(metrics: dict[str, Any]) -> str:
    """Return the pixels that the scores of metrics.json are of, as the end of a phrase; empty for all pixels."""
    return {"all": "", "mask": " over unmasked pixels"}.get(region := metrics.get("region", "all"), f" over {region}")


def result_lines(metrics: dict[str, Any], out: Path | None, tasks: Sequence[str] = ()) -> list[str]:
    """Return the final lines of a fit from metrics.json: scores, size, time, what to do, report, next steps."""
    over = over_region(metrics)
    lines = [f"training PSNR {metrics['train']['psnr']:.2f} dB{over} (no score of new views: no view is held out)"]
    if metrics["test"]:
        lines = [f"held-out {score_line(metrics['test'])} ({len(metrics['views'])} views{over})"]
        best = ", ".join(f"{BASELINES.get(name, name)} {value:.2f} dB" for name, value in metrics["baselines"].items())
        lines += [f"  for comparison, without a fit: {best}"] if best else []
        lines += [f"  {metrics['coverage']['summary']}"] if "coverage" in metrics else []
    once = ", with kernels compiled once on this machine" if metrics["seconds"].get("compiling", 0.0) >= 1 else ""
    size = format_bytes(metrics["complexity"]["bytes"])
    times = metrics["wall_seconds"]
    lines.append(f"{metrics['gaussians']:,} Gaussians, {size}, in {duration(times['total'])}{once}: {largest(times)}")
    lines += ["to do:", *(f"  {task}" for task in tasks)] if tasks else []
    if out is None:
        return [*lines, "nothing was written to disk, because no run folder (out) was given"]
    run, file = shlex.quote(str(out)), " --to scene.html"
    width = len(f"warpgs export {run}{file}")
    following = [
        f"  {f'warpgs view {run}':<{width}}  to look around in a browser",
        f"  {f'warpgs render {run}':<{width}}  for a film",
        f"  warpgs export {run}{file}  for one file that opens anywhere",
    ]
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
    renders: Renders,
    train: list[View],
    test: list[View],
    lpips: Lpips | None = None,
    *,
    names: dict[str, str] | None = None,
    tell: Say = silent,
) -> dict[str, Any]:
    """Score held-out and training views, and save a render and depth map of each held-out (else training) view in ``out``."""
    for folder in () if out is None else ("renders", "depth"):
        make_folder(out / folder)
    files, held_out = names or image_names(v.name for v in [*train, *test]), {v.name for v in test}

    def beside(image: np.ndarray, photo: np.ndarray) -> np.ndarray:
        return side_by_side([np.clip(image, 0, 1), photo, error_map(image, photo)])

    def save(folder: str, view: View, draw: Callable[..., np.ndarray], *parts: np.ndarray) -> None:
        if out is not None and (view.name in held_out or not test):
            write_bytes(out / folder / f"{files[view.name]}.png", png(draw(*parts)))

    def jobs() -> Iterator[tuple[Any, ...]]:
        for view in counted([*test, *train], tell, "scoring", "views"):
            image, depth, alpha = renders(view.camera)
            yield save, "renders", view, beside, image, view.image
            yield save, "depth", view, depth_map, depth, alpha
            yield score, view, image, lpips if view.name in held_out else None, alpha

    with ThreadPoolExecutor(1) as thread:
        plain = thread.submit(lambda: baselines(train, test) if test else {})
        # LPIPS needs much memory for each view
        found = in_background(lambda do, *parts: do(*parts), jobs(), 0 if lpips is None else 1)[2::3]
    rows, train_rows = found[: len(test)], found[len(test) :]
    return {
        "test": summarize(rows), "train": summarize(train_rows),
        "views": [r.row() for r in rows],
        "variants": variants(lpips, any(r.opacity for r in found)),
        "baselines": plain.result(), "region": ", ".join(sorted({r.region for r in found})),
    }  # fmt: skip


def _images(shown: list[View], renders: Renders, rows: dict[str, Any], tell: Say) -> list[tuple[Any, ...]]:
    """Render the views that the page shows, and encode their images."""
    captions = []
    for view in shown:
        row, caption = rows.get(view.name), "training view"
        if row:
            region = f", over {row['region']}" if row["region"] != "all" else ""
            caption = f"PSNR {row['psnr']:.2f} dB{region}, SSIM {row['ssim']:.3f}"
        captions.append(caption)

    def parts() -> Iterator[tuple[Any, ...]]:
        for view in counted(shown, tell, "making the report", "views"):
            image, depth, alpha = renders(view.camera)
            yield from ((np.asarray, a) for a in (image, view.image))
            yield from ((error_map, image, view.image), (depth_map, depth, alpha))

    files = iter(in_background(lambda draw, *maps: webp(draw(*maps)), parts()))
    return [(v.name, caption, *images) for v, caption, images in zip(shown, captions, zip(*[files] * 4))]


NEW_VIEWS = 8
"""Largest number of viewpoints from which the first image of the page is chosen."""


def new_view(rig: Rig, train: list[View], renders: Renders) -> list[tuple[np.ndarray, str]]:
    """Return the render midway between two training views that both show most of it, with its caption; empty without one."""
    best, picture = -1.0, []
    if not all(v.camera.model in CENTRAL for v in train):
        return []
    for i, j, camera in midways(rig, [v.camera for v in train], NEW_VIEWS):
        image, depth, alpha = renders(camera)
        pair = depth_views(renders, [train[k].camera for k in (i, j)], [train[k].mask for k in (i, j)])
        surface = torch.from_numpy(np.where(alpha >= MIN_ALPHA, depth, 0)).to(renders.gaussians.means.device)
        covered = float((coverage_map(surface, camera, pair)[0] == 2).double().mean())
        if covered > best:
            best, picture = covered, [(image, f"a new viewpoint, between {train[i].name} and {train[j].name}")]
    return picture


def _figures(metrics: dict[str, Any], seconds: float) -> list[tuple[str, str]]:
    """Return the main figures of the page as pairs of label and value."""
    test = metrics["test"]
    meaning = "how well the photographs are repeated, not how good new views are"
    held_out = [(f"training PSNR{over_region(metrics)}: {meaning}", f"{metrics['train']['psnr']:.2f} dB")]
    if test:
        best = max(metrics["baselines"].values(), default=math.nan)
        held_out = [
            (f"held-out PSNR{over_region(metrics)}", f"{test['psnr']:.2f} dB"), ("held-out SSIM", f"{test['ssim']:.3f}"),
            ("best without a fit", f"{best:.2f} dB"),
            *((LABELS[k], f"{test[k]:.3f}") for k in ("alpha_empty", "alpha_object") if k in test),
        ]  # fmt: skip
    size = format_bytes(metrics["complexity"]["bytes"])
    return [*held_out, ("Gaussians", f"{metrics['gaussians']:,}"), ("model", size), ("time", duration(seconds))]


def write_report(
    out: Path,
    scene: Scene,
    split: Split,
    renders: Renders,
    metrics: dict[str, Any],
    record: dict[str, Any],
    *,
    title: str,
    sampling: Callable[[], Section | None],
    times: Callable[[], dict[str, float]],
    tell: Say = silent,
) -> None:
    """Write report.html of a scored run, from metrics.json, config.json (``record``), metrics.jsonl and new renders."""
    train, test = [scene.view(n) for n in split.train], [scene.view(n) for n in split.test]
    tell("making the report")
    cameras = [v.camera for v in train], [v.camera for v in test]
    rig = rig_among(cameras[0], renders.gaussians.means.detach().cpu().numpy().astype(np.float64))
    covered, shown = None, evenly_spaced(test or train, SHOWN_VIEWS)
    with ThreadPoolExecutor() as threads:  # images are encoded while others are rendered
        threads.submit(import_module, "jinja2")  # takes a tenth of a second, at the end
        if "coverage" in metrics:
            names = image_names(v.name for v in scene.views)
            covered = threads.submit(coverage_section, out, metrics["coverage"], [v.name for v in shown], names)
        opening = new_view(rig, train, renders)
        if (overview := render_overview(renders.gaussians, renders.options, *cameras, rig.up)) is not None:
            opening.append((overview, "the Gaussians, training cameras teal" + ", held-out cameras orange" * bool(test)))
        pictures = [(threads.submit(webp, image), words) for image, words in opening]
        images = _images(shown, renders, {r["name"]: r for r in metrics["views"]}, tell)
    events = read_events(out / "metrics.jsonl")
    named = ("Training loss", "loss", ""), ("Training PSNR of whole images", "psnr", "dB"), ("Gaussians", "count", "")
    steps = [e["step"] for e in events]
    curves = [curve(title, steps, [e.get(name, math.nan) for e in events], unit) for title, name, unit in named]
    keys = [k for k in LABELS if k in metrics["test"]]
    table = [["view", *(LABELS[k] for k in keys), "pixels"]] + [
        [r["name"], *(f"{r.get(k, math.nan):.{2 if k.startswith('psnr') else 4}f}" for k in keys), r["region"]]
        for r in metrics["views"]
    ]
    camera = train[0].camera
    protocol = {k.replace("_", " "): ", ".join(v) if isinstance(v, list) else str(v) for k, v in metrics["protocol"].items()}
    protocol["configuration"] = f"{metrics['config_hash']}, step {metrics['steps']:,}"
    spent = times()
    notes = [*record["notes"], Detail(times_line(spent))]
    write_page(
        out / "report.html",
        title=title,
        subtitle=f"preset {metrics['preset']}, {len(train)} training views, {len(test)} held out, "
        f"{camera.width} x {camera.height} px, {metrics['device']}",
        figures=_figures(metrics, spent["total"]), notes=notes, scores=table, views=images, curves=curves,
        sampling=sampling(), pictures=[(p.result(), words) for p, words in pictures],
        coverage=covered and covered.result(), held_out=bool(test),
        record={k: v for k, v in record.items() if k != "cameras"},
        protocol=protocol | {LABELS.get(k, k): v for k, v in metrics["variants"].items()},
    )  # fmt: skip
