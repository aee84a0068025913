"""Films of a fitted model along a path of cameras."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from warpgs.coordinates import convert_camera
from warpgs.errors import UsageError
from warpgs.files import make_folder, write_bytes
from warpgs.pipeline.films.frame_check import FrameCheck
from warpgs.pipeline.films.plan import FilmPlan, FilmSettings, plan_film
from warpgs.pipeline.metrics.coverage_map import MIN_ALPHA, DepthView, coverage_map, depth_views, fraction_outside
from warpgs.pipeline.metrics.coverage_scores import classes_of
from warpgs.pipeline.model.model_file import FittedModel
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.report.coverage_image import coverage_image
from warpgs.report.film import SUFFIXES, write_film
from warpgs.report.images import frame_sheet, png, straight_alpha
from warpgs.runtime.folder_lock import check_file_path, hold_folder
from warpgs.runtime.terminal import say
from warpgs.scene import Camera, View

FILM = "film.mp4"
SHEET = "sheet.png"
SHEET_FRAMES = 6
"""Frames of a sheet, evenly spaced."""
COVERAGE = "coverage"
"""Subfolder for images that mark regions by the number of training views that saw them."""


def _training_depths(model: FittedModel, views: bool | Sequence[View], options: RasterizeOptions) -> list[DepthView]:
    """Return the depths of the training views of a model; masks apply if the views themselves are given."""
    masks = [v.mask for v in views] if isinstance(views, Sequence) else None
    cameras = [v.camera for v in views] if isinstance(views, Sequence) else [model.cameras()[n] for n in model.train]
    return depth_views(model.gaussians(), cameras, options, masks)


def _covered(image: np.ndarray, depth: torch.Tensor, camera: Camera, training: list[DepthView], cut_out: bool) -> bytes:
    """Return the PNG of an image [H, W, 3] that marks regions that no training view saw, and regions that one view saw."""
    seen = coverage_map(depth, camera, training)
    classes = classes_of(seen, cut_out)
    return png(coverage_image(image, classes["0"], classes["1"]))


@dataclass(frozen=True)
class RenderedPath:
    """Result of `render_film`: files, and lines for the user."""

    files: list[Path]
    """A PNG for each camera in order, unless only a film was requested; and last the film, if any."""
    notes: list[str]
    """Lines for the user: choices made, and frames that show nothing."""


def _check_plan(plan: FilmPlan, out: Path, coverage: bool, sheet: bool) -> tuple[bool, bool]:
    """Return whether ``out`` is a film and not a folder, and whether all frames have one size.

    Raises:
        UsageError: There is no camera, or the frames do not allow the requested film or output.
    """
    if not plan.cameras:
        raise UsageError("no camera to render; give at least one")
    alone = out.suffix.lower() in SUFFIXES
    if not alone and out.suffix and not out.is_dir():
        raise UsageError(f"{out}: unknown film suffix; use {', '.join(SUFFIXES)}, or a folder without a suffix for images")
    one_size = len({(c.width, c.height) for _, c in plan.cameras}) == 1
    if (alone or sheet) and not one_size:
        raise UsageError(
            f"{out}: the views differ in size, but a film or sheet needs one size; give --size, or a folder without --sheet"
        )
    if alone and coverage:
        raise UsageError(f"{out}: coverage images are PNG files; give a folder instead of a film")
    return alone, one_size


def sheet_path(out: Path) -> Path:
    """Return the path of the sheet: in the folder, or beside the film."""
    return out.with_name(f"{out.stem}-{SHEET}") if out.suffix.lower() in SUFFIXES else out / SHEET


def _frames(
    model: FittedModel, plan: FilmPlan, files: Sequence[Path], settings: FilmSettings, coverage: bool | Sequence[View],
    check: FrameCheck, tell: Callable[[str], object] | None,
) -> Iterator[np.ndarray]:  # fmt: skip
    """Render the frames of a plan, check each, and write its images; yields each image [H, W, 3].

    Args:
        model: The model.
        plan: The frames.
        files: File of each frame's image; none to write no images.
        settings: Settings of the film.
        coverage: As in `render_path`; the images lie in a subfolder beside ``files``.
        check: Check of the frames.
        tell: Called with a line for each frame before it is rendered.
    """
    gaussians, options = model.gaussians(), model.options()
    if settings.background is not None:
        options = dataclasses.replace(options, background=gaussians.means.new_tensor(settings.background))
    straight = model.transparent and settings.background is None
    photographs = [model.cameras()[n] for n in model.train]
    training = _training_depths(model, coverage, options) if coverage else None
    cut_out = isinstance(coverage, Sequence) and any(v.alpha is not None for v in coverage)
    for i, (_, camera) in enumerate(plan.cameras):
        if tell is not None:
            tell(f"rendering: {i + 1} of {len(plan.cameras)} frames")
        with torch.no_grad():
            r = rasterize(gaussians, camera, options)
        image, alpha = r.rgb.cpu().numpy(), r.alpha.cpu().numpy()
        surface = torch.where(r.alpha >= MIN_ALPHA, r.depth, 0)
        check.look(image, alpha, fraction_outside(surface, camera, photographs, not model.transparent))
        if files:
            write_bytes(files[i], png(straight_alpha(image, alpha, model.background) if straight else image))
        if training is not None:
            write_bytes(files[i].parent / COVERAGE / files[i].name, _covered(image, surface, camera, training, cut_out))
        yield image


def _older_images(folder: Path, files: list[Path]) -> list[str]:
    """Return notes on images of an earlier film in the same folder."""
    older = [p for p in folder.glob("*.png") if p not in files and p.name != SHEET]
    return [f"{len(older)} older images are also in {folder}: remove them, or give a new folder"] if older else []


def render_film(
    model: FittedModel,
    plan: FilmPlan,
    out: Path,
    settings: FilmSettings,
    *,
    coverage: bool | Sequence[View] = False,
    sheet: bool = False,
    tell: Callable[[str], object] | None = None,
) -> RenderedPath:
    """Render the cameras of a plan to files.

    Args:
        model: The model.
        plan: The frames.
        out: Folder for a PNG of each frame and film.mp4; or a film with one of the suffixes of `warpgs.report.film`, to write
            only the film.
        settings: Settings of the film.
        coverage: As in `render_path`; only if ``out`` is a folder.
        sheet: True to also write six frames in one image: sheet.png in the folder, or beside the film.
        tell: Called with a line before each frame is rendered, and before the film is finished.

    Raises:
        ResourceError: A file cannot be written, or another process writes into the folder.
        UsageError: There is no camera, or one film was requested of images that differ in size.
    """
    alone, one_size = _check_plan(plan, out, bool(coverage), sheet)
    folder, film = (out.parent, out) if alone else (out, out / FILM)
    if alone:
        check_file_path(out)
    files = [] if alone else [folder / f"{name}.png" for name, _ in plan.cameras]
    left = [] if alone else _older_images(folder, files)
    check, chosen, count = FrameCheck(plan.coverage), [], len(plan.cameras)
    in_sheet = {i * count // SHEET_FRAMES for i in range(SHEET_FRAMES)} if sheet else set()

    def images() -> Iterator[np.ndarray]:
        for i, image in enumerate(_frames(model, plan, files, settings, coverage, check, tell)):
            if i in in_sheet:
                chosen.append(image)
            yield image
        if one_size and tell is not None:
            tell(f"writing {film.name}")

    with hold_folder(folder, *([] if alone else [COVERAGE])) as notes:
        if coverage:
            make_folder(out / COVERAGE)
        if one_size:
            write_film(film, images(), settings.fps)
        else:
            collections.deque(images(), maxlen=0)
        if sheet:
            write_bytes(sheet_path(out), png(frame_sheet(chosen)))
    notes = [*notes, *plan.notes, *check.notes(plan.remedy, plan.nearer), *left]
    return RenderedPath([*files, film] if one_size else files, notes)


def render_path(
    model: FittedModel,
    path: str | Sequence[Camera] = "auto",
    *,
    out: str | Path,
    units: str = "scene",
    frames: int | None = None,
    fps: int = 30,
    seconds: float | None = None,
    size: tuple[int, int] | None = None,
    fov_y: float | None = None,
    background: tuple[float, float, float] | None = None,
    coverage: bool | Sequence[View] = False,
) -> list[Path]:
    """Render a model along a camera path to PNG files and, if all images have one size, to a film.

    If the scene has alpha channels, the PNG files are transparent, with straight alpha, unless a background is given. Films
    are never transparent. Automatic choices, and warnings about empty frames, are printed on stderr.

    Args:
        model: Result of `fit` or `open_run`.
        path: views (every view of the scene); turntable, spiral or interpolate (through the training views); auto (chosen by
            the positions of the training cameras); the name of a JSON file of keyframes; or your own cameras.
        out: Folder to write, which may exist; or a film file (.mp4, .webm, .webp or .gif), to write only the film.
        units: Units of your own cameras: scene or file.
        frames: Number of frames; None for ``seconds`` times ``fps``. Ignored with your own cameras.
        fps: Frames per second of the film.
        seconds: Duration of the film [s]; None for the default of the path. Ignored with your own cameras.
        size: Width and height of the frames [px]; None for the size of the photographs. Ignored with your own cameras.
        fov_y: Vertical field of view [rad]; None for the field of view of the photographs. Ignored with your own cameras.
        background: Colour behind the scene, in [0, 1]; None for the background of the fit.
        coverage: True to also write images into the subfolder coverage, with magenta stripes on pixels that no training view
            saw, and amber stripes on pixels that one view saw. Or the training views, to respect their masks.

    Returns:
        The files written: a PNG for each camera in order, then the film, if any; without the coverage images.

    Raises:
        DataError: A file of keyframes cannot be read.
        ResourceError: A file cannot be written, or another process writes into the folder.
        UsageError: The path or the units are unknown, or a number is out of its range.
    """
    settings = FilmSettings(frames, seconds, fps, size, fov_y, background)
    if isinstance(path, str):
        plan = plan_film(model, path, settings)
    else:
        own = [(f"{i:04d}", convert_camera(c, model.normalization, units, "scene")) for i, c in enumerate(path)]
        plan = FilmPlan(own, 0.0, "check the poses and the units of the cameras", [])
    done = render_film(model, plan, Path(out), settings, coverage=coverage)
    for note in done.notes:
        say(f"warpgs: {note}", error=True)
    return done.files
