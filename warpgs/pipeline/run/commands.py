"""What commands do with a finished run: score, render, prune, plot; and the preview of priors."""

import contextlib
import itertools
import math
import os
import shlex
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgs.constants import LOW_PASS, rule_named
from warpgs.device import format_bytes
from warpgs.errors import DataError, UsageError, WarpgsError, expect, explained
from warpgs.export.base import format_of, read_with_antialiasing
from warpgs.export.ply import write_ply
from warpgs.files import filling, write_bytes, write_json, writing_into
from warpgs.geometry import camera_extent, convert_camera, evenly_spaced, in_image
from warpgs.io.image_files import MAX_PIXELS
from warpgs.io.load import Split, load_scene
from warpgs.io.transforms import colmap_folder, read_cameras
from warpgs.locks import hold_file, hold_folder
from warpgs.pipeline.films import film
from warpgs.pipeline.films.paths import rig_among
from warpgs.pipeline.metrics.coverage import coverage_lines, coverage_of_run
from warpgs.pipeline.metrics.lpips import Lpips
from warpgs.pipeline.metrics.scores import Renders, counted_region, psnr, render_view, scored_region, to_8_bit
from warpgs.pipeline.model import edit
from warpgs.pipeline.model.clean import chosen_reasons, counted_lines, in_colors, reasons_of
from warpgs.pipeline.model.edit import coverage
from warpgs.pipeline.model.start import InitConfig, consistent_depths, isotropic, seen_points
from warpgs.pipeline.model.table import FittedModel, model_bytes, pack
from warpgs.pipeline.paper.scores import CURVATURE, geometry_score, semantic_score
from warpgs.pipeline.run.folder import CONFIG, IMAGE_FOLDERS, StoredRun, camera_values, open_run, save_checkpoint, with_cameras
from warpgs.pipeline.run.request import NO_SCORES, SceneRequest, choose_device, read_scene
from warpgs.pipeline.run.results import evaluate_run, over_region, protocol_of, score_line
from warpgs.pipeline.train.schedule import color_of, over_background
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.trainer import train_views
from warpgs.priors.views import PriorConfig, view_priors
from warpgs.process import Say, say, silent
from warpgs.render.options import RasterizeOptions
from warpgs.report.film import h264_encoder
from warpgs.report.images import COVERAGE_LEGEND, Tile, contact_sheet, png
from warpgs.report.overview import LEGEND_HEIGHT, TEST_COLOR, TRAIN_COLOR, render_overview, with_legend
from warpgs.report.page import image_names, renaming_notes
from warpgs.report.progress import Stages, waiting
from warpgs.scene import Camera, Gaussians, Normalization, PointCloud, Prior, Scene, Tensors, View, base_coefficients

RULE = "inria"
"""Default rule for files of Gaussians: most models were trained with it."""


def open_file(
    path: Path, cameras: Path | None, rule: str | None, device: str, antialiased: bool = False, near: float | None = None
) -> tuple[FittedModel, list[str]]:
    """Read a file of Gaussians, and cameras from a file or a scene folder; returns model and notes.

    ``rule`` None is exact for files that name warpgs, else inria; ``near`` [file units] None is that of the rule.
    """
    if cameras is None:
        raise UsageError(f"{path}: a file of Gaussians has no cameras; give --cameras cameras.json, transforms.json or a scene")
    rule_named(rule or RULE)
    where, _ = choose_device(device)
    found, notes = _cameras_of(cameras)
    for name, c in found.items():
        if c.width * c.height > MAX_PIXELS:
            raise DataError(f"{cameras}, {name}: {c.width} x {c.height} px are over {MAX_PIXELS:,} pixels; give a smaller size")
    # the unit stays that of the file, since the near plane of a rule is in that unit; our fits have that of `load_scene`
    own = rule is None and format_of(path).is_own(path)
    extent = camera_extent(list(found.values())) if own else 0.0
    normalization = Normalization(np.mean([c.center for c in found.values()], axis=0), 1 / extent if extent > 0 else 1.0)
    gaussians, declared, lost = read_with_antialiasing(path, normalization, "scene")
    notes += lost
    notes += [note] if (note := format_of(path).note) else []
    notes += [f"{path.name} declares an antialiased model; renders use a pixel filter of {LOW_PASS:g} px²"] * declared
    if own:
        notes.append(f"rendered with the cut-offs of {FitConfig.rule}, as warpgs fits; --rule chooses others")
    elif rule is None:
        notes.append(f"rendered with the cut-offs of {RULE}; for models of gsplat, give --rule gsplat-1.6 or gsplat-1.5")
    notes.append(f"{len(gaussians):,} Gaussians, {len(found)} cameras")
    in_scene = {name: convert_camera(c, normalization, "file", "scene") for name, c in found.items()}
    shown = (in_scene, tuple(in_scene), (), rule or (FitConfig.rule if own else RULE), (0.0, 0.0, 0.0), 0)
    cut = None if near is None else near * normalization.scale
    return FittedModel(gaussians.to(where), normalization, *shown, antialiased=antialiased or declared, near=cut), notes


def _cameras_of(path: Path) -> tuple[dict[str, Camera], list[str]]:
    """Return cameras by name in file units, and notes; a folder may hold a scene of any format."""
    if path.is_dir() and ((path / "images").is_dir() or colmap_folder(path) is None):
        scene = load_scene(path)
        return {v.name: convert_camera(v.camera, scene.normalization, "scene", "file") for v in scene.views}, list(scene.notes)
    return read_cameras(path)


VP9 = (
    "the film will be VP9, which browsers and VLC play, but many phones do not; for H.264, which all play, install ffmpeg "
    "(https://ffmpeg.org/download.html) and repeat the command"
)
"""Note on a film in .mp4 without an encoder of H.264."""


def scene_of(stored: StoredRun, reader: str | None = None, tell: Say | None = None) -> tuple[Scene, list[View], list[View]]:
    """Read the scene of a run, with its training and held-out views; refuse a scene that has changed since the fit."""
    scene, _, _ = read_scene(stored.scene_request(reader), tell)
    if scene.fingerprint != stored.record["fingerprint"]:
        raise DataError(f"{scene.path}: images or cameras have changed since the fit of {stored.folder}; restore them")
    if stored.record["config"]["view_modules"]:
        scene = with_cameras(scene, stored.scene_cameras)
    scene, split = over_background(scene, stored.background), Split(stored.train, stored.test)
    return scene, train_views(scene, split.train), train_views(scene, split.test)


def evaluate(
    folder: Path, device_name: str, lpips_weights: Path | None = None, reader: str | None = None, by_coverage: bool = False
) -> list[str]:
    """Score a run on its held-out views and render them again, into eval.json and images; returns lines for the user."""
    device, _ = choose_device(device_name)
    lpips = None if lpips_weights is None else Lpips(lpips_weights, device)
    stored, tell = open_run(folder, device), waiting()
    scene, train, test = scene_of(stored, reader, tell)
    request, names = stored.scene_request(reader), image_names(v.name for v in scene.views)
    scored = (folder, Renders(stored.gaussians(), stored.options()), train, test)
    with hold_folder(folder, *IMAGE_FOLDERS) as held:
        metrics = evaluate_run(*scored, lpips, names=names, tell=tell)
        if by_coverage and test:
            metrics["coverage"] = coverage_of_run(*scored, names=names, tell=tell)
        metrics |= {
            "protocol": protocol_of(scene, request.split, request.downscale, train, test),
            "config_hash": stored.record["config_hash"], "steps": stored.step,
        }  # fmt: skip
        write_json(folder / "eval.json", metrics)
    lines = [*stored.notes(), *held, *renaming_notes(names)]
    if not test:
        return [*lines, f"no view is held out; training PSNR {metrics['train']['psnr']:.2f} dB{over_region(metrics)}"]
    for row in metrics["views"]:
        region = "" if row["region"] == "all" else f" (over {row['region']})"
        lines.append(f"{row['name']}: PSNR {row['psnr']:.2f} dB, SSIM {row['ssim']:.3f}{region}")
    lines += coverage_lines(metrics["coverage"]) if by_coverage else []
    return [*lines, f"mean of {len(test)} held-out views: {score_line(metrics['test'])}"]


def render(
    folder: Path, path: str, out: Path | None, settings: film.FilmSettings, device_name: str, *,
    background: str = "auto", coverage: bool = False, sheet: bool = False,
    file_of: tuple[Path | None, str | None] | None = None,
    antialiased: bool = False, near: float | None = None,
) -> list[str]:  # fmt: skip
    """Render a run, or a file of Gaussians with ``file_of`` (cameras, rule), to images and a film; returns lines."""
    color = color_of(background)
    if color is None and background != "auto":
        raise UsageError(f"--background {background}: expected auto, black, white, #rrggbb or r,g,b")
    home = folder if file_of is None else folder.parent
    named, out = out is not None, out or home / f"path-{Path(path).stem.replace('.', '-')}"
    stored: FittedModel
    if file_of is None:
        stored = open_run(folder, device_name)
        notes = stored.notes()
    else:
        stored, notes = open_file(folder, *file_of, device_name, antialiased, near)
        notes += ["the background is black; choose another colour with --background"] if color is None else []
    tell = Stages()
    settings = replace(settings, background=color)
    plan = film.plan_film(stored, path, settings)
    training: list[View] | bool = coverage
    alone, one_size = film.check_plan(plan, out, coverage, sheet)
    told = not alone and any(p.is_file() for p in (out / film.FILM, *home.glob(f"path-*/{film.FILM}")))
    if one_size and not told and (not alone or out.suffix.lower() == ".mp4") and h264_encoder() is None:
        say(VP9)
    if coverage:
        try:
            training = scene_of(stored)[1] if isinstance(stored, StoredRun) else True
        except WarpgsError as e:
            notes.append(f"masked-out regions are shown as seen, since the scene cannot be read: {e}")
        notes.append(f"images in {out / film.COVERAGE}: {COVERAGE_LEGEND}")
    with contextlib.nullcontext() if named else writing_into(home):
        _, faults = film.render_film(stored, plan, out, settings, coverage=training, sheet=sheet, tell=tell)
    notes += faults + [f"sheet of {min(film.SHEET_FRAMES, len(plan.cameras))} frames in {film.sheet_path(out)}"] * sheet
    if alone:
        return [*notes, f"{len(plan.cameras)} frames in {out}"]
    ending = f" and {film.FILM} in {out}" if one_size else f" in {out}; no film, since the views differ in size"
    return [*notes, f"{len(plan.cameras)} images{ending}"]


def view_psnrs(gaussians: Gaussians, views: list[View], options: RasterizeOptions) -> np.ndarray:
    """Return the PSNR [dB] of each view as in `warpgs eval`: rounded to 8 bits, over scored pixels."""
    images = ((v, to_8_bit(render_view(gaussians, v, options)[0])) for v in views)
    return np.array([psnr(image, to_8_bit(v.image), scored_region(v)[0]) for v, image in images])


TRIED_VIEWS = 8
"""Number of training views, evenly chosen, on which smaller models are tried."""


def _new_folder(folder: Path, out: Path | None) -> Path:
    """Return the folder to write; UsageError if it exists already."""
    out = folder.resolve().with_name(f"{folder.resolve().name}-pruned") if out is None else out
    if os.path.exists(out):
        raise UsageError(f"{out} exists already; choose another --out")
    return out


def _write(out: Path, stored: StoredRun, figures: dict[str, Any], made: Gaussians) -> list[str]:
    """Write the new run folder, whose record has ``figures``, atomically; returns notes for the user."""
    # the new checkpoint has no increments of poses: its record holds the cameras after them
    record = stored.record | {"pruned": figures, "cameras": {n: camera_values(c) for n, c in stored.scene_cameras.items()}}
    tensors, degrees = {f"params.{n}": t for n, t in made.tensors().items() if n != "sh"}, edit.stored_degrees(made.sh)
    tensors |= {"params.sh_packed": pack(made.sh, degrees), "degrees": degrees}
    with hold_folder(out.parent) as notes:
        _new_folder(out, out)  # another process may have made it before this one held the folder above
        with filling(out) as temporary:
            write_json(temporary / CONFIG, record)
            save_checkpoint(temporary, tensors, {"step": stored.step})
            write_ply(temporary / "point_cloud.ply", made, stored.normalization, antialiased=stored.antialiased)
    return notes


def prune(
    folder: Path, keep_psnr: float, out: Path | None, device_name: str, reader: str | None = None, tell: Say = silent
) -> list[str]:
    """Shrink a run into a new folder whose mean training PSNR falls by at most ``keep_psnr`` [dB]; returns lines."""
    if not 1e-6 <= keep_psnr <= 100:
        raise UsageError(f"--keep-psnr must be in [1e-6, 100] dB, not {keep_psnr}; a loss of 0.1 dB is invisible")
    device, _ = choose_device(device_name)
    stored = open_run(folder, device)
    out = _new_folder(folder, out)
    _, train, test = scene_of(stored, reader, tell)
    before, options, tried = stored.gaussians(), stored.options(), itertools.count(1)
    tell("ranking Gaussians")
    psnrs = view_psnrs(before, train, options)
    if not math.isfinite(whole := float(np.mean(psnrs))):
        raise DataError(f"{stored.folder}: training PSNR is {whole} dB, so its loss cannot be limited; fit again")

    def loss(gaussians: Gaussians, on_all: bool) -> float:
        rows = range(len(train)) if on_all else evenly_spaced(range(len(train)), TRIED_VIEWS)
        tell(f"trying smaller models: number {next(tried)}, {len(gaussians):,} Gaussians, {len(rows)} views")
        return float(np.mean(psnrs[rows] - view_psnrs(gaussians, [train[i] for i in rows], options)))

    # the changes of all images that would lower PSNR by this much if they had nothing to do with the errors
    values = np.array([v.image.size for v in train])
    first = float((values * 10 ** (-psnrs / 10)).sum()) * (10 ** (keep_psnr / 10) - 1)
    cameras = [v.camera for v in train]
    made, lost = edit.prune_model(before, cameras, options, stored.record["config"]["seed"], loss, keep_psnr, first)
    tell("scoring the smaller model")
    degrees = [edit.stored_degrees(g.sh) for g in (before, made)]
    counts, sizes = [len(d) for d in degrees], [model_bytes(d) for d in degrees]
    means = [float(d.double().mean()) for d in degrees]
    held_out = tuple(float(np.mean(view_psnrs(g, test, options))) if test else math.nan for g in (before, made))
    scores = [(whole, whole - lost), held_out]
    figures: dict[str, Any] = {
        "source": str(folder.resolve()), "keep_psnr": keep_psnr, "count": counts, "bytes": sizes, "mean_degree": means,
        "train_psnr": scores[0], "test_psnr": scores[1] if test else None,
    }  # fmt: skip
    held, run = _write(out, stored, figures, made), shlex.quote(str(out))
    kinds = zip(("training", "held-out"), scores, (train, test))
    return [
        *stored.notes(),
        *held,
        f"{counts[0]:,} -> {counts[1]:,} Gaussians, mean SH degree {means[0]:.2f} -> {means[1]:.2f}",
        f"{format_bytes(sizes[0])} -> {format_bytes(sizes[1])} uncompressed, {sizes[0] / sizes[1]:.2f} times smaller",
        *(f"{kind} PSNR {old:.2f} -> {new:.2f} dB over {len(of)} views" for kind, (old, new), of in kinds if of),
        f"in {out}: checkpoint, PLY; `warpgs eval {run}` scores it, `warpgs render {run}` renders it",
    ]


CLEAN = "clean.png"
"""Picture of what a clean-up would remove, in the folder of a run."""


def clean_picture(model: FittedModel, found: Tensors, views: list[View]) -> np.ndarray:
    """Return a sheet: before, what would go in colours over gray, and after, in one view; and from beside the cameras."""
    gaussians, options = model.gaussians(), model.options()
    goes = edit.any_of(found.values(), gaussians.logit_opacities)
    means = gaussians.means[goes].cpu().double().numpy()
    view = max(views, key=lambda v: int(in_image(v.camera, means).sum()))
    pair, cameras, up = (gaussians, edit.select(gaussians, ~goes)), [v.camera for v in views], -view.camera.viewmat[1, :3]
    before, after = (render_view(g, view, options)[0] for g in pair)
    colors, _, alpha = render_view(edit.select(in_colors(gaussians, found), goes), view, replace(options, background=None))
    over = colors + (1 - alpha[..., None]) * before.mean(-1, keepdims=True)
    tiles = [Tile("before", before), Tile("what would go, also behind surfaces", over), Tile("after", after)]
    for when, g in zip(("before", "after"), pair):
        image = render_overview(g, options, cameras, [], up, size=before.shape[1::-1], background=None, cameras=False)
        tiles += [Tile(f"from beside the photographs, {when}", image)] if image is not None else []
    lines = [f"{int(goes.sum()):,} of {len(goes):,} Gaussians would go:", *counted_lines(found)]
    return contact_sheet(view.name, lines, tiles, columns=3)


def write_clean(stored: StoredRun, out: Path, found: Tensors, scores: dict[str, list[float]] | None = None) -> list[str]:
    """Write a run without the Gaussians of some masks [N] into a new folder; returns lines for the user."""
    goes = edit.any_of(found.values(), stored.gaussians().logit_opacities)
    left = edit.by_degree(edit.select(stored.gaussians(), ~goes))
    figures = {
        "source": str(stored.folder.resolve()), "removed": {name: int(where.sum()) for name, where in found.items()},
        "count": [len(goes), len(left)], "psnr": scores,
    }  # fmt: skip
    held = _write(out, stored, figures, left)
    return [*held, f"{len(left):,} Gaussians in {out}: checkpoint, PLY; {stored.folder} keeps the model before"]


def clean(
    folder: Path, wish: str, out: Path | None, device_name: str, reader: str | None = None, tell: Say = silent
) -> list[str]:
    """Write a run without what ``wish`` names (`chosen_reasons`), or for show only a picture of that; returns lines."""
    show = wish == "show"
    names, (device, _) = chosen_reasons("all" if show else wish), choose_device(device_name)
    if show and out is not None:
        raise UsageError(f"--clean show writes {CLEAN} into the run; leave out --out, or choose what to remove")
    stored = open_run(folder, device)
    out = _new_folder(folder, out) if not show else folder / CLEAN
    _, train, test = scene_of(stored, reader, tell)
    tell("finding what would go")
    before, options = stored.gaussians(), stored.options()
    reasons = reasons_of(before, coverage(before, [v.camera for v in train], options)[0])
    found = edit.first_reasons({name: reasons[name] for name in names if name in reasons})
    goes = edit.any_of(found.values(), before.logit_opacities)
    if (count := int(goes.sum())) in (0, len(goes)):
        return [*stored.notes(), f"{'all' if count else 'none'} of {len(goes):,} Gaussians would go; nothing is changed"]
    tell("scoring")
    after, kinds = edit.select(before, ~goes), (("training", train), ("held-out", test))
    scores = {k: [float(np.mean(view_psnrs(g, views, options))) for g in (before, after)] for k, views in kinds if views}
    if show:
        tell("drawing")
        with hold_file(out) as last:
            write_bytes(out, png(clean_picture(stored, found, train)))
        home = shlex.quote(str(folder))
        last.append(f"picture in {out}; `warpgs prune {home} --clean all`, or with some of these names, removes them")
        box = f"save a crop box in `warpgs view {home}`, then `warpgs export {home} --to FILE --crop {home}/crop.json`"
        last.append(f"if smears remain, cut them off: {box}")
    else:
        last = write_clean(stored, out, found, scores)
    return [
        *stored.notes(),
        f"{count:,} of {len(goes):,} Gaussians {'would go' if show else 'removed'}:",
        *(f"  {line}" for line in counted_lines(found)),
        *(f"{kind} PSNR {old:.2f} -> {new:.2f} dB" for kind, (old, new) in scores.items()),
        *last,
    ]


SIZES = (64, 8192)
"""Smallest and largest side of a plot [px]."""
POINT_SIZE = 1e-3
"""Standard deviation of a reconstruction's point as it is shown, as a fraction of the size of the scene."""
CLASSES = (
    (0, "seen by no training view", "#d6219c"), (1, "by 1", "#f0a020"), (2, "by 2", "#a6bf3a"), (3, "by 3 to 5", "#2fa37c"),
    (6, "by 6 and more", "#2878b5"),
)  # fmt: skip
"""Least number of training views, description and colour of each class of coverage."""


def _points(cloud: PointCloud, device: torch.device) -> Gaussians:
    """Return small opaque Gaussians of the points and colours of a reconstruction."""
    low, high = np.percentile(cloud.points, [5, 95], axis=0)
    size = POINT_SIZE * max(float(np.linalg.norm(high - low)), 1e-6)
    means, colors = (torch.as_tensor(a, dtype=torch.float32, device=device) for a in (cloud.points, cloud.colors))
    return isotropic(means, colors, means.new_full((len(means),), math.log(size)), means.new_full((len(means),), 6.0), 1)


def _by_coverage(gaussians: Gaussians, train: list[Camera], options: RasterizeOptions) -> Gaussians:
    """Return Gaussians in the colours of `CLASSES`, by the number of training views that see them."""
    views = coverage(gaussians, train, options)[1].cpu().numpy()
    palette = np.array([[int(color[i : i + 2], 16) / 255 for i in (1, 3, 5)] for _, _, color in CLASSES])
    colors = palette[np.searchsorted([least for least, _, _ in CLASSES], views, side="right") - 1]
    return replace(gaussians, sh=gaussians.means.new_tensor(base_coefficients(colors))[:, None])


def plot(
    folder: Path, out: Path | None, device_name: str = "auto", *, points: str = "gaussians", color: str = "own",
    background: str = "white", size: tuple[int, int] = (1600, 1000), cameras: bool = True,
) -> list[str]:  # fmt: skip
    """Write a plot of a run as PNG, with the options of `warpgs plot`; returns lines for the user."""
    start, by_coverage, out = points == "start", color == "coverage", folder / "plot.png" if out is None else out
    with explained(f"{out}: not drawn", "change that flag", ValueError, UsageError):
        expect(all(SIZES[0] <= s <= SIZES[1] for s in size), f"each side of --size must have {SIZES[0]} to {SIZES[1]} px")
        expect(not (start and by_coverage), "--color coverage needs Gaussians, not --points start")
        expect(out.suffix.lower() == ".png", "a plot is a .png file")
    stored, tell = open_run(folder, device_name), waiting()
    found, gaussians = stored.cameras(), stored.gaussians()
    train, test = ([found[n] for n in names] for names in (stored.train, stored.test))
    up = stored.normalization.up
    up = rig_among(train, gaussians.means.cpu().numpy().astype(np.float64)).up if up is None else up
    if start:
        scene, _, _ = scene_of(stored)
        if scene.points is None or not len(scene.points):
            raise DataError(f"{scene.path}: its format ({scene.format}) has no points; leave out --points start")
        gaussians = _points(scene.points, gaussians.means.device)
    elif by_coverage:
        gaussians = _by_coverage(gaussians, train, stored.options())
    legend = [("training cameras", TRAIN_COLOR), ("held-out cameras", TEST_COLOR)][: 1 + bool(test)] if cameras else []
    legend += [(words, color) for _, words, color in CLASSES] if by_coverage else []
    rows = size[1] - (round(LEGEND_HEIGHT * size[1]) if legend else 0)
    with hold_file(out) as held:
        tell("rendering the plot")
        shown = {"size": (size[0], rows), "background": background, "cameras": cameras}
        if (image := render_overview(gaussians, stored.options(), train, test, up, **shown)) is None:
            raise DataError(f"{folder}: the model has no Gaussians; there is nothing to show")
        write_bytes(out, png(with_legend(image, legend, size[1], background)))
    what = "points of the reconstruction" if start else "Gaussians"
    counts = f"{len(gaussians):,} {what}, {len(train)} training and {len(test)} held-out cameras"
    return [*held, *stored.notes(), f"{counts} in {out}"]


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
    lines = [
        f"{view.camera.width} x {view.camera.height} px. Scores are scaled to the 2nd and 98th percentile of the view.",
        f"Depth: {prior.depth_source}.",
        f"Semantics: {prior.semantics_source}. Mean foreground {prior.foreground.mean():.1%}.",
    ]
    return contact_sheet(view.name, lines, tiles)


def show_priors(request: SceneRequest, config: PriorConfig, source: str, out: Path, threads: int = 0) -> list[str]:
    """Write a sheet of the priors of each training view as PNG; ``source`` finds depth without a network. Returns lines."""
    scene, split, notes = read_scene(request)
    views = [scene.view(name) for name in split.train]
    names = image_names(v.name for v in scene.views)
    with hold_folder(out) as held:
        regions = [counted_region(v)[0] for v in views]
        depths = None
        if config.depth_model is None and len(views) > 1:
            depths = consistent_depths(views, seen_points(views, scene.points), InitConfig(source=source))
        priors, found = view_priors(views, config, depths=lambda: depths, regions=regions, threads=threads)
        for view, prior in zip(views, priors):
            write_bytes(out / f"{names[view.name]}.png", png(prior_sheet(view, prior)))
        notes = [n for n in notes if n != NO_SCORES]
        return [*notes, *held, *renaming_notes(names), *found, f"{len(views)} sheets in {out}"]
