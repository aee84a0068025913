"""What commands do with a finished run: score, render, prune, plot; and the preview of priors."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import os
import shlex
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgs.constants import LOW_PASS, rule_named
from warpgs.device import format_bytes
from warpgs.errors import DataError, UsageError, WarpgsError
from warpgs.export.base import format_of, read_with_antialiasing
from warpgs.export.ply import write_ply
from warpgs.files import filling, write_bytes, write_json, writing_into
from warpgs.geometry import convert_camera, rotation_matrices
from warpgs.io.image_files import MAX_PIXELS
from warpgs.io.load import Split, load_scene
from warpgs.io.transforms import colmap_folder, read_cameras
from warpgs.locks import hold_file, hold_folder
from warpgs.pipeline.films.film import (
    COVERAGE,
    FILM,
    SHEET_FRAMES,
    FilmSettings,
    depth_and_coverage,
    plan_film,
    render_film,
    sheet_path,
)
from warpgs.pipeline.films.paths import Rig, rig_of
from warpgs.pipeline.metrics.coverage import coverage_lines, coverage_of_run
from warpgs.pipeline.metrics.lpips import load_lpips
from warpgs.pipeline.metrics.scores import counted_region, psnr, render_view, scored_region, to_8_bit
from warpgs.pipeline.model import edit
from warpgs.pipeline.model.edit import coverage
from warpgs.pipeline.model.start import InitConfig, consistent_depths, seen_points
from warpgs.pipeline.model.table import FittedModel, model_bytes, pack
from warpgs.pipeline.paper.scores import CURVATURE, geometry_score, semantic_score
from warpgs.pipeline.run.folder import CONFIG, IMAGE_FOLDERS, StoredRun, camera_values, open_run, save_checkpoint, with_cameras
from warpgs.pipeline.run.request import NO_SCORES, SceneRequest, choose_device, read_scene
from warpgs.pipeline.run.results import evaluate_run, protocol_of, score_line
from warpgs.pipeline.train.schedule import color_of, over_background
from warpgs.pipeline.train.trainer import train_views
from warpgs.pipeline.train.views import TrainingView
from warpgs.priors.networks import cache_folder
from warpgs.priors.views import PriorConfig, view_priors
from warpgs.render.options import RasterizeOptions
from warpgs.report.images import COVERAGE_LEGEND, Tile, contact_sheet, png
from warpgs.report.overview import ScenePlot, render_plot
from warpgs.report.page import image_names, renaming_notes
from warpgs.report.progress import Stages, waiting
from warpgs.scene import Camera, Gaussians, Normalization, Prior, Scene, View, base_colors

RULE = "inria"
"""Default rule for files of Gaussians: most models were trained with it."""


def open_file(
    path: Path,
    cameras: Path | None,
    rule: str | None = None,
    device: str = "auto",
    antialiased: bool = False,
) -> tuple[FittedModel, list[str]]:
    """Read a file of Gaussians, and cameras from a file or a scene folder; ``rule`` None is inria. Returns model and notes."""
    if cameras is None:
        raise UsageError(
            f"{path}: a file of Gaussians has no cameras; give --cameras cameras.json, transforms.json, or a scene"
        )
    rule_named(rule or RULE)
    where, _ = choose_device(device)
    found, notes = _cameras_of(cameras)
    for name, c in found.items():
        if c.width * c.height > MAX_PIXELS:
            raise DataError(
                f"{cameras}, {name}: an image of {c.width} x {c.height} px has over {MAX_PIXELS:,} pixels; give a smaller size"
            )
    # the unit stays that of the file, since the near plane of a rule is in that unit
    normalization = Normalization(np.mean([c.center for c in found.values()], axis=0))
    gaussians, declared, lost = read_with_antialiasing(path, normalization, "scene")
    gaussians, notes = gaussians.to(where), [*notes, *lost]
    notes += [note] if (note := format_of(path).note) else []
    if declared:
        notes.append(f"{path.name} declares an antialiased model; renders use a pixel filter of {LOW_PASS:g} px²")
    if rule is None:
        notes.append(f"rendered with the cut-offs of {RULE}; for models of gsplat, give --rule gsplat-1.6 or gsplat-1.5")
    in_scene = {name: convert_camera(c, normalization, "file", "scene") for name, c in found.items()}
    shown = (in_scene, tuple(in_scene), (), rule or RULE, (0.0, 0.0, 0.0), 0)
    model = FittedModel(gaussians, normalization, *shown, antialiased=antialiased or declared)
    return model, [*notes, f"{len(gaussians):,} Gaussians, {len(found)} cameras"]


def _cameras_of(path: Path) -> tuple[dict[str, Camera], list[str]]:
    """Return cameras by name in file units, and notes; a folder may hold a scene of any format."""
    if path.is_dir() and ((path / "images").is_dir() or colmap_folder(path) is None):
        scene = load_scene(path)
        return {v.name: convert_camera(v.camera, scene.normalization, "scene", "file") for v in scene.views}, list(scene.notes)
    return read_cameras(path)


VP9 = (
    "the film is VP9, which browsers and VLC play; convert it for other players: "
    "ffmpeg -i {} -c:v libx264 -pix_fmt yuv420p film-h264.mp4"
)
"""Note on a film in .mp4; {} stands for its path."""
ALPHAS = {"alpha_empty": "where empty", "alpha_object": "in the object"}
"""Scores of the rendered alpha, with their names in the line of a view."""


def scene_of(
    stored: StoredRun, reader: str | None = None, tell: Callable[[str], object] | None = None
) -> tuple[Scene, list[View], list[View]]:
    """Read the scene of a run, with its training and held-out views; refuse a scene that has changed since the fit."""
    scene, _, _ = read_scene(stored.scene_request(reader), tell)
    if scene.fingerprint != stored.record["fingerprint"]:
        raise DataError(f"{scene.path}: images or cameras have changed since the fit of {stored.folder}; restore them")
    if stored.record["config"]["view_modules"]:
        scene = with_cameras(scene, stored.scene_cameras)
    scene, split = over_background(scene, stored.background), Split(stored.train, stored.test)
    return scene, train_views(scene, split.train), train_views(scene, split.test)


def evaluate(
    folder: Path,
    device_name: str,
    lpips_weights: Path | None = None,
    reader: str | None = None,
    by_coverage: bool = False,
) -> list[str]:
    """Score a run on its held-out views and render them again, into eval.json and images; returns lines for the user."""
    device, _ = choose_device(device_name)
    lpips = None if lpips_weights is None else load_lpips(lpips_weights, device)
    stored, tell = open_run(folder, device), waiting()
    scene, train, test = scene_of(stored, reader, tell)
    request = stored.scene_request(reader)
    with hold_folder(folder, *IMAGE_FOLDERS) as notes:
        names = image_names(v.name for v in scene.views)
        metrics = evaluate_run(folder, stored.gaussians(), train, test, stored.options(), lpips, names=names, tell=tell)
        if by_coverage and test:
            metrics["coverage"] = coverage_of_run(
                folder, stored.gaussians(), train, test, stored.options(), names=names, tell=tell
            )
        metrics |= {
            "protocol": protocol_of(scene, request.split, request.downscale, train, test),
            "config_hash": stored.record["config_hash"], "steps": stored.step,
        }  # fmt: skip
        write_json(folder / "eval.json", metrics)
    notes = [*stored.notes(), *notes, *renaming_notes(names)]
    if not test:
        return [*notes, f"no view is held out; training PSNR {metrics['train']['psnr']:.2f} dB"]
    lines = [_view_line(r) for r in metrics["views"]]
    lines += coverage_lines(metrics["coverage"]) if by_coverage else []
    return [*notes, *lines, f"mean of {len(test)} held-out views: {score_line(metrics['test'])}"]


def _view_line(row: dict[str, Any]) -> str:
    """Return the scores of a view as a line for the user."""
    alphas = [f", alpha {row[k]:.3f} {words}" for k, words in ALPHAS.items() if not math.isnan(row.get(k, math.nan))]
    region = "" if row["region"] == "all" else f" (over {row['region']})"
    return f"{row['name']}: PSNR {row['psnr']:.2f} dB, SSIM {row['ssim']:.3f}{''.join(alphas)}{region}"


def render(
    folder: Path, path: str, out: Path | None, settings: FilmSettings, device_name: str, *,
    background: str = "auto", coverage: bool = False, sheet: bool = False,
    file_of: tuple[Path | None, str | None] | None = None,
    antialiased: bool = False,
) -> list[str]:  # fmt: skip
    """Render a run, or a file of Gaussians with ``file_of`` (cameras, rule), to images and a film; returns lines."""
    color = color_of(background)
    if color is None and background != "auto":
        raise UsageError(f"--background {background}: expected auto, black, white, #rrggbb or r,g,b")
    home, named = folder if file_of is None else folder.parent, out is not None
    out = home / f"path-{Path(path).stem.replace('.', '-')}" if out is None else out
    notes: list[str] = []
    stored: FittedModel
    if file_of is None:
        stored = open_run(folder, device_name)
        notes = stored.notes()
    else:
        stored, notes = open_file(folder, *file_of, device_name, antialiased)
        notes += ["the background is black; choose another colour with --background"] if color is None else []
    tell = Stages()
    settings = replace(settings, background=color)
    plan = plan_film(stored, path, settings)
    training: list[View] | bool = False
    if coverage:
        try:
            training = scene_of(stored)[1] if isinstance(stored, StoredRun) else True
        except WarpgsError as e:
            training = True
            notes.append(f"masked-out regions are shown as seen, since the scene cannot be read: {e}")
        notes.append(f"images in {out / COVERAGE}: {COVERAGE_LEGEND}")
    with contextlib.nullcontext() if named else writing_into(home):
        files, faults = render_film(stored, plan, out, settings, coverage=training, sheet=sheet, tell=tell)
    *others, last = files
    if last.suffix.lower() == ".mp4":
        notes.append(VP9.format(shlex.quote(str(last))))
    notes += faults + ([f"sheet of {min(SHEET_FRAMES, len(plan.cameras))} frames in {sheet_path(out)}"] if sheet else [])
    if last == out:
        return [*notes, f"{len(plan.cameras)} frames in {out}"]
    if last.name == FILM:
        return [*notes, f"{len(others)} images and {FILM} in {out}"]
    return [*notes, f"{len(files)} images in {out}; no film, since the views differ in size"]


def mean_psnr(gaussians: Gaussians, views: list[View], options: RasterizeOptions) -> float:
    """Return the mean PSNR [dB] over views as in `warpgs eval`: rounded to 8 bits, over scored pixels; NaN without views."""
    if not views:
        return math.nan
    scores = []
    for v in views:
        image = to_8_bit(render_view(gaussians, v, options)[0])
        scores.append(psnr(image, to_8_bit(v.image), scored_region(v)[0]))
    return float(np.mean(scores))


def _new_folder(folder: Path, out: Path | None) -> Path:
    """Return the folder to write; UsageError if it exists already or cannot be made."""
    out = folder.resolve().with_name(f"{folder.resolve().name}-pruned") if out is None else out
    if os.path.exists(out):
        raise UsageError(f"{out} exists already; choose another --out")
    if not os.path.isdir(out.parent):
        raise UsageError(f"{out.parent} is not a folder; create it, or choose another --out")
    return out


def _write(out: Path, record: dict[str, Any], made: edit.Pruned, step: int, normalization: Normalization) -> list[str]:
    """Write the new run folder atomically; returns notes for the user."""
    tensors = {f"params.{n}": t for n, t in made.gaussians.tensors().items() if n != "sh"}
    tensors |= {"params.sh_packed": pack(made.gaussians.sh, made.degrees), "degrees": made.degrees}
    with hold_folder(out.parent) as notes:
        _new_folder(out, out)  # another process may have made it before this one held the folder above
        with filling(out) as temporary:
            write_json(temporary / CONFIG, record)
            save_checkpoint(temporary, tensors, {"step": step})
            antialiased = record["config"].get("antialiased", False)
            write_ply(temporary / "point_cloud.ply", made.gaussians, normalization, antialiased=antialiased)
    return notes


def prune(
    folder: Path, keep_psnr: float, out: Path | None, device_name: str, reader: str | None = None,
    tell: Callable[[str], object] = lambda line: None,
) -> list[str]:  # fmt: skip
    """Shrink a run into a new folder whose mean training PSNR falls by at most ``keep_psnr`` [dB]; returns lines."""
    if not 0 < keep_psnr < math.inf:
        raise UsageError(f"--keep-psnr must be above 0 dB, not {keep_psnr}; a loss of 0.1 dB is invisible")
    device, _ = choose_device(device_name)
    stored = open_run(folder, device)
    out = _new_folder(folder, out)
    _, train, test = scene_of(stored, reader, tell)
    before, options = stored.gaussians(), stored.options()
    tell("ranking Gaussians")
    made = _pruned(stored, train, options, keep_psnr, tell)
    tell("scoring the smaller model")

    degrees = edit.stored_degrees(before.sh)
    sizes = [model_bytes(d) for d in (degrees, made.degrees)]
    scores = [(mean_psnr(before, v, options), mean_psnr(made.gaussians, v, options)) for v in (train, test)]
    figures: dict[str, Any] = {
        "source": str(folder.resolve()), "keep_psnr": keep_psnr, "count": [len(before), len(made.degrees)], "bytes": sizes,
        "mean_degree": [float(d.double().mean()) for d in (degrees, made.degrees)],
        "train_psnr": scores[0], "test_psnr": scores[1] if test else None,
    }  # fmt: skip
    # the new checkpoint has no increments of poses: its record holds the cameras after them
    record = stored.record | {"pruned": figures, "cameras": {n: camera_values(c) for n, c in stored.scene_cameras.items()}}
    notes = _write(out, record, made, stored.step, stored.normalization)
    lines = [
        *stored.notes(),
        *notes,
        f"{len(before):,} -> {len(made.degrees):,} Gaussians, mean SH degree {figures['mean_degree'][0]:.2f} -> "
        f"{figures['mean_degree'][1]:.2f}",
        f"{format_bytes(sizes[0])} -> {format_bytes(sizes[1])} uncompressed, {sizes[0] / sizes[1]:.2f} times smaller",
        f"training PSNR {scores[0][0]:.2f} -> {scores[0][1]:.2f} dB over {len(train)} views",
    ]
    if test:
        lines.append(f"held-out PSNR {scores[1][0]:.2f} -> {scores[1][1]:.2f} dB over {len(test)} views")
    run = shlex.quote(str(out))
    return [*lines, f"in {out}: checkpoint, PLY; `warpgs eval {run}` scores it, `warpgs render {run}` renders it"]


def _pruned(
    stored: StoredRun, train: list[View], options: RasterizeOptions, keep_psnr: float, tell: Callable[[str], object]
) -> edit.Pruned:
    """Prune the model of a run; DataError if its PSNR on the training views is not finite."""
    before = stored.gaussians()
    device = before.means.device
    whole = mean_psnr(before, train, options)
    if not math.isfinite(whole):
        raise DataError(f"{stored.folder}: training PSNR is {whole} dB, so its loss cannot be limited; fit again")
    kinds = torch.zeros(len(before), dtype=torch.int64, device=device)
    view_set = edit.ViewSet([TrainingView.of(v, device).camera for v in train], options, stored.record["config"]["seed"])
    tried = itertools.count(1)

    def accepted(gaussians: Gaussians, fraction: float) -> bool:
        tell(f"trying smaller models: number {next(tried)}, {len(gaussians):,} Gaussians")
        return mean_psnr(gaussians, train, options) >= whole - fraction * keep_psnr

    made = edit.prune_model(before, kinds, view_set, accepted)
    return dataclasses.replace(made, gaussians=edit.drop_unused_sh(made.gaussians))


PLOT = "plot.png"
POINTS, COLORS, BACKGROUNDS = ("gaussians", "start"), ("own", "coverage"), ("white", "black")
SIZES = (64, 8192)
"""Smallest and largest side of a plot [px]."""
MIN_OPACITY = 0.1
"""Least opacity of a Gaussian that is shown: fainter ones are invisible."""
MAX_POINTS = {"gaussians": 50_000, "start": 300_000}
"""Largest number of Gaussians and of points shown; larger sets are sampled at random."""
CLASSES = (
    (0, "seen by no training view", "#d6219c"), (1, "by 1", "#f0a020"), (2, "by 2", "#a6bf3a"), (3, "by 3 to 5", "#2fa37c"),
    (6, "by 6 and more", "#2878b5"),
)  # fmt: skip
"""Least number of training views, description and colour of each class of coverage."""


@dataclass(frozen=True)
class PlotSettings:
    """Settings of a plot."""

    points: str = "gaussians"
    """Points shown: gaussians, or start (the points of the scene's reconstruction)."""
    color: str = "own"
    """Colour of the points: own, or coverage (how many training views see a Gaussian)."""
    background: str = "white"
    """Background: white or black."""
    size: tuple[int, int] = (1600, 1000)
    """Width and height [px]."""
    cameras: bool = True
    """True to show cameras."""

    def __post_init__(self) -> None:
        """Check what can be checked before any work."""
        for flag, value, known in (
            ("--points", self.points, POINTS), ("--color", self.color, COLORS), ("--background", self.background, BACKGROUNDS),
        ):  # fmt: skip
            if value not in known:
                raise UsageError(f"{flag} {value}: give one of {', '.join(known)}")
        if not all(SIZES[0] <= s <= SIZES[1] for s in self.size):
            raise UsageError(f"--size {self.size[0]} {self.size[1]}: each side must have {SIZES[0]} to {SIZES[1]} px")
        if self.points == "start" and self.color == "coverage":
            raise UsageError("--color coverage needs Gaussians; leave out --points start")


def _gaussians(stored: StoredRun, train: list[Camera], by_coverage: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions [N, 3], colours [N, 3] and axes [N, 3, 3] of the Gaussians that can be seen."""
    gaussians = stored.gaussians()
    shown = (torch.sigmoid(gaussians.logit_opacities) >= MIN_OPACITY).cpu()
    if not by_coverage:
        colors = np.clip(base_colors(gaussians.sh[:, :1].cpu().numpy()), 0, 1)
    else:
        tensors = [replace(c, viewmat=gaussians.means.new_tensor(c.viewmat), K=gaussians.means.new_tensor(c.K)) for c in train]
        views = coverage(gaussians, tensors, stored.options()).views.cpu().numpy()
        lowest, palette = np.array([c[0] for c in CLASSES]), [c[2] for c in CLASSES]
        values = np.array([[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in palette])
        colors = values[np.searchsorted(lowest, views, side="right") - 1]
    means, quats, log_scales = (t.detach().cpu().double() for t in (gaussians.means, gaussians.quats, gaussians.log_scales))
    rotations = rotation_matrices(torch.nn.functional.normalize(quats[shown], dim=1).numpy())
    return means[shown].numpy(), colors[shown.numpy()], rotations * np.exp(log_scales[shown].numpy())[:, None]


def _start(stored: StoredRun) -> tuple[np.ndarray, np.ndarray, None]:
    """Return positions [N, 3] and colours [N, 3] of the points of the scene's reconstruction."""
    scene, _, _ = scene_of(stored)
    if scene.points is None or not len(scene.points):
        raise DataError(f"{scene.path}: its format ({scene.format}) has no points; leave out --points start")
    return scene.points.points, scene.points.colors, None


def _eye(rig: Rig) -> np.ndarray:
    """Return the direction [3] from the scene to the viewer: from above at an angle, behind cameras that look to one side."""
    azimuth = 0.0 if rig.span is None else 0.5 * (rig.span[0] + rig.span[1])
    return rig.direction(azimuth + 0.7, max(rig.elevation + 0.35, 0.5))


def plot(folder: Path, out: Path | None, settings: PlotSettings, device_name: str = "auto") -> list[str]:
    """Write a plot of a run as PNG; returns lines for the user."""
    out = folder / PLOT if out is None else out
    if out.suffix.lower() != ".png":
        raise UsageError(f"{out}: a plot is a .png file; give a name that ends in .png")
    stored, tell = open_run(folder, device_name), waiting()
    tell("rendering depth")
    cameras = stored.cameras()
    train, test = ([cameras[n] for n in names] for names in (stored.train, stored.test))
    depth, _ = depth_and_coverage(stored.gaussians(), train, stored.options())
    rig = rig_of(train, depth)
    by_coverage = settings.color == "coverage"
    points, colors, axes = _start(stored) if settings.points == "start" else _gaussians(stored, train, by_coverage)
    if not len(points):
        raise DataError(f"{folder}: no Gaussian has an opacity of {MIN_OPACITY} or more; there is nothing to show")
    most = MAX_POINTS[settings.points]
    notes = stored.notes() + ([] if len(points) <= most else [f"showing a random sample of {most:,} of {len(points):,}"])
    chosen = np.sort(np.random.default_rng(0).permutation(len(points))[:most])
    shown = (train, test) if settings.cameras else ([], [])
    legend = [(words, color) for _, words, color in CLASSES] if by_coverage else []
    axes = None if axes is None else axes[chosen]
    contents = ScenePlot(points[chosen], colors[chosen], axes, *shown, rig.up, _eye(rig), legend)
    with hold_file(out) as held:
        tell("rendering the plot")
        write_bytes(out, render_plot(contents, settings.size, settings.background))
    faint = f"Gaussians of opacity {MIN_OPACITY:g} or more"
    what = "points of the reconstruction" if settings.points == "start" else faint
    return [*held, *notes, f"{len(points):,} {what}, {len(train)} training and {len(test)} held-out cameras in {out}"]


SOURCES = ("sweep", "flow")


def prior_sheet(view: View, prior: Prior) -> np.ndarray:
    """Return one sheet, [rows, columns, 3] in [0, 1]: image, the four maps, and the two scores computed from them."""
    disparity, *semantics = map(torch.from_numpy, (prior.disparity, prior.confidence, prior.boundary, prior.foreground))
    tiles = [
        Tile("image", view.image),
        Tile("disparity, near is 1", prior.disparity, "TURBO"),
        Tile("confidence of the likeliest class", prior.confidence, "VIRIDIS"),
        Tile("foreground", prior.foreground, "VIRIDIS"),
        Tile("boundary", prior.boundary),
        Tile("S_semantic = confidence (boundary + foreground)", semantic_score(*semantics).numpy()),
        Tile(f"S_geometry = |grad D| + {CURVATURE:g} kappa", geometry_score(disparity).numpy()),
    ]
    size = f"{view.camera.width} x {view.camera.height} px"
    lines = [
        f"{size}. Scores are scaled to the 2nd and 98th percentile of the view.",
        f"Depth: {prior.depth_source}.",
        f"Semantics: {prior.semantics_source}. Mean foreground {prior.foreground.mean():.1%}.",
    ]
    return contact_sheet(view.name, lines, tiles)


def show_priors(request: SceneRequest, config: PriorConfig, source: str, out: Path, threads: int = 0) -> list[str]:
    """Write a sheet of the priors of each training view as PNG; ``source`` finds depth without a network. Returns lines."""
    if source not in SOURCES:
        raise UsageError(f"source {source!r} is not one of {', '.join(SOURCES)}")
    scene, split, notes = read_scene(request)
    views = [scene.view(name) for name in split.train]
    names = image_names(v.name for v in scene.views)
    with hold_folder(out) as held:
        regions = [counted_region(v)[0] for v in views]
        depths = None
        if config.depth_model is None and len(views) > 1:
            depths = consistent_depths(views, seen_points(views, scene.points), InitConfig(source=source))
        cache = cache_folder()
        priors, found = view_priors(views, config, depths=lambda: depths, regions=regions, threads=threads, cache=cache)
        for view, prior in zip(views, priors):
            write_bytes(out / f"{names[view.name]}.png", png(prior_sheet(view, prior)))
        notes = [n for n in notes if n != NO_SCORES]
        return [*notes, *held, *renaming_notes(names), *found, f"{len(views)} sheets in {out}"]
