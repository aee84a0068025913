"""Films of a model: what they show, rendered frame by frame."""

import collections
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from warpgs.device import background
from warpgs.errors import UsageError, did_you_mean, expect, explained, listed
from warpgs.files import make_folder, write_bytes
from warpgs.geometry import convert_camera, pinhole_of
from warpgs.locks import hold_file, hold_folder
from warpgs.mesh.views import MIN_ALPHA
from warpgs.pipeline.films import paths
from warpgs.pipeline.metrics.coverage import classes_of, coverage_map, depth_views, fraction_outside
from warpgs.pipeline.metrics.scores import Renders
from warpgs.pipeline.model.table import FittedModel
from warpgs.process import Say, counted, say, silent
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.report.film import SUFFIXES, write_film
from warpgs.report.images import coverage_image, frame_sheet, png, straight_alpha
from warpgs.report.page import image_names
from warpgs.scene import Camera, Gaussians, View

EMPTY = 0.1
"""A frame shows nearly nothing if its mean alpha is below this fraction of the mean alpha of the training views' renders."""
MIN_COVERAGE = 0.002
"""A frame also shows nearly nothing if its mean alpha is below this value."""
BLACK = 1 / 255
"""Mean of the brightest channel below which a frame is black."""

OUTSIDE = 0.1
"""Fraction of a frame outside all photographs above which a note is printed."""


NEARLY_NOTHING, ARE_BLACK = "show nearly nothing", "are black"
ARE_OUTSIDE = f"have over {OUTSIDE:.0%} of their pixels outside all photographs"


def fault_of(image: np.ndarray, alpha: np.ndarray, coverage: float, outside: float = 0.0) -> str:
    """Return the fault of a frame [H, W, 3] with alpha [H, W] and a fraction outside all photographs; empty for none."""
    if float(alpha.mean(dtype=np.float64)) < max(EMPTY * coverage, MIN_COVERAGE):
        return NEARLY_NOTHING
    if float(image.max(2).mean(dtype=np.float64)) < BLACK:
        return ARE_BLACK
    return ARE_OUTSIDE if outside > OUTSIDE else ""


def cut_advice(model: FittedModel, cameras: Sequence[Camera]) -> str:
    """Return advice where the near plane cuts most of the Gaussians in front of the cameras off; else an empty text."""
    means, near = model.gaussians().means.double().cpu().numpy(), model.options().cut_offs().near
    depths = np.concatenate([means @ np.asarray(c.viewmat, np.float64)[2, :3] + float(c.viewmat[2, 3]) for c in cameras])
    depths = depths[depths > 0]
    share = float((depths < near).mean()) if len(depths) else 0.0
    cut = f"{share:.0%} of the Gaussians in front of the cameras are nearer than the near plane, {near:g} units"
    return f"{cut}; lower it, such as with --near {np.median(depths) / 100:.1g}" if share > 0.5 else ""


def fault_notes(faults: list[str], remedy: str, cut: str = "") -> list[str]:
    """Return a line for the user on each fault, with its meaning and the ``remedy``."""
    advice = {
        NEARLY_NOTHING: cut or f"the path leaves the captured area; {remedy}",
        ARE_BLACK: f"the camera is inside geometry, or the scene is unlit; {remedy}",
        ARE_OUTSIDE: f"expect artefacts there; {remedy}",
    }
    frames = {fault: [i for i, f in enumerate(faults) if f == fault] for fault in advice}
    return [
        f"{len(numbers)} of {len(faults)} frames {fault} (frames {listed(numbers, 8)}): {advice[fault]}"
        for fault, numbers in frames.items() if numbers
    ]  # fmt: skip


PATHS = ("auto", "views", "turntable", "spiral", "interpolate")
"""Names of paths; a path may also be a JSON file of keyframes."""
SECONDS = 3.0
"""Default duration of a film [s]."""
VIEW_SECONDS, MAX_SECONDS = 0.5, 20.0
"""Duration of a film through training views [s]: per view, and at most in all."""
MIN_FRAMES_PER_VIEW = 4
"""Fewest frames from one training view to the next; a film with too few frames skips some of the views."""
MAX_FRAMES = 1_000_000
WIDER = 1.02
"""A film counts as wider than the photographs if its field of view exceeds theirs by this factor."""
AT_VIEWS = "score each view with `warpgs eval`; --coverage marks these places"
"""Advice for frames at training views."""


@dataclass(frozen=True)
class FilmSettings:
    """Settings of a film."""

    frames: int | None = None
    """Number of frames; None for seconds times fps. The number of frames of ``views`` and of the user's own cameras is
    fixed."""
    seconds: float | None = None
    """Duration [s]; None for the default of the path."""
    fps: int = 30
    """Frames per second."""
    size: tuple[int, int] | None = None
    """Width and height [px]; None for the size of the photographs."""
    fov_y: float | None = None
    """Vertical field of view [rad]; None for that of the photographs, or less if frames of another shape would show more."""
    background: tuple[float, float, float] | None = None
    """Colour behind the scene, in [0, 1]; None for the background of the fit."""

    def __post_init__(self) -> None:
        """Check what can be checked before any work."""
        (least, most), (low, high) = paths.LIMITS["width"], paths.LIMITS["fov"]
        with explained("these settings give no film", "change that number", ValueError, UsageError):
            expect(all(least <= s <= most for s in self.size or ()), f"sides must have {least} to {most} px, not {self.size}")
            fits = self.fov_y is None or math.radians(low) <= self.fov_y <= math.radians(high)
            expect(fits, f"--fov must be {low:g} to {high:g} degrees")
            counts = self.frames, self.seconds and self.seconds * self.fps
            expect(all(n is None or 0 < n <= MAX_FRAMES for n in counts), f"it must have 1 to {MAX_FRAMES:,} frames")

    def count(self, seconds: float) -> int:
        """Return the number of frames of a film; ``seconds`` is its duration if the settings have none."""
        return self.frames or min(max(1, round((self.seconds or seconds) * self.fps)), MAX_FRAMES)


@dataclass(frozen=True)
class FilmPlan:
    """The frames of a film before they are rendered."""

    cameras: list[tuple[str, Camera]]
    """File name without suffix, and camera, of each frame, in scene units [u]."""
    coverage: float
    """Fraction of a training view's pixels that the model covers; 0 if unknown."""
    remedy: str
    """Advice for frames that show nothing, or areas outside the photographs."""
    notes: list[str]
    """Lines for the user on the choices made."""


@torch.no_grad()
def depth_and_coverage(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions) -> tuple[float, float]:
    """Return the median depth [u] of covered pixels, 1 without any, and the median of mean alpha, for up to nine cameras."""
    depths, alphas = [], []
    for camera in cameras[:: max(1, len(cameras) // 5)]:
        r = rasterize(gaussians, camera, options)
        alpha = r.alpha.cpu().numpy()
        depths.append(r.depth.cpu().numpy()[alpha > 0.5])
        alphas.append(float(alpha.mean(dtype=np.float64)))
    values = np.concatenate(depths)
    return float(np.median(values)) if len(values) else 1.0, float(np.median(alphas))


def _tour(rig: paths.Rig, train: list[Camera], settings: FilmSettings) -> tuple[list[Camera], str]:
    """Return the cameras of a film through training views, and a description of the path."""
    frames = settings.count(min(max(SECONDS, VIEW_SECONDS * len(train)), MAX_SECONDS))
    cameras = [paths.upright(rig, c) for c in train]
    reaches = [rig.reach(c) for c in train]
    keyframes, closed, by_name = paths.tour_of(cameras, reaches, frames / settings.fps, max(2, frames // MIN_FRAMES_PER_VIEW))
    words = "in the given order" if by_name else "from neighbour to neighbour"
    words += ", and back to the first" if closed else ""
    count = f"{len(keyframes) - closed} of {len(train)} cameras"
    return paths.through(keyframes, frames, closed=closed), f"path: interpolate, through {count} {words}"


def _keyframes(
    model: FittedModel, path: Path, rig: paths.Rig, first: Camera, settings: FilmSettings
) -> tuple[list[Camera], str]:
    """Return the cameras of a film through the keyframes of a file, and a description of the path."""
    if settings.fov_y is not None:
        raise UsageError(f"{path}: keyframes have their own fields of view; leave out --fov")
    keyframes = paths.read_keyframes(path, paths.framed(first, settings.size), model.normalization)
    if rig.is_watched([k.camera for k in keyframes]):  # then the path goes around it, and not across
        keyframes = [replace(k, reach=rig.reach(k.camera)) for k in keyframes]
    last = keyframes[-1].seconds
    cameras = paths.through(keyframes, settings.count(last + 1 / settings.fps))
    return cameras, f"path: {len(keyframes)} keyframes over {last:g} s"


def plan_film(model: FittedModel, path: str, settings: FilmSettings) -> FilmPlan:
    """Return the cameras of a path, one of `PATHS` or a JSON file of keyframes, for a model."""
    if path not in PATHS and not path.lower().endswith(".json"):
        hint = did_you_mean(path, PATHS) or f"choose one of {', '.join(PATHS)}, or give a .json file of keyframes"
        raise UsageError(f"unknown path {path!r}; {hint}")
    scene = model.cameras()
    train = [scene[n] for n in model.train]
    depth, coverage = depth_and_coverage(model.gaussians(), train, model.options())
    if path == "views":
        if settings.frames is not None or settings.seconds is not None:
            raise UsageError("--path views gives one image for each view; leave out --frames and --seconds")
        names = image_names(scene)
        shown = [(names[n], paths.framed(c, settings.size, settings.fov_y)) for n, c in scene.items()]
        return FilmPlan(shown, coverage, AT_VIEWS, _cropped(train[0], settings))
    rig = paths.rig_of(train, depth, model.normalization.up)
    if path.lower().endswith(".json"):
        cameras, words = _keyframes(model, Path(path), rig, train[0], settings)
        remedy = "move the keyframes nearer to the photographs; c2w is in OpenCV axes, in the units of the scene's files"
        return FilmPlan(_numbered(cameras), coverage, remedy, [words])
    notes = [f"{len(train)} {'training ' if model.test else ''}cameras {rig.describe()}"]
    notes += ["the photographs are rotated; the film takes its upward direction from the plane of the cameras"] * rig.turned
    kind = paths.path_of(rig) if path == "auto" else path
    if kind == "interpolate":
        far = [c for c in train if not 0 < rig.reach(c) < paths.CLOSE * rig.distance]
        left_out = len(train) - len(far) if path == "auto" and len(far) > 1 else 0
        cameras, words = _tour(rig, far if left_out else train, settings)
        words += f"; {left_out} close-ups are left out" * bool(left_out)
        words += "; --path turntable is calmer" * (path == "auto" and rig.kind == "forward")
        remedy = AT_VIEWS
    else:
        cameras = paths.camera_path(kind, rig, train, settings.count(SECONDS))
        words = f"path: {kind}" + ", there and back over the captured area" * (rig.span is not None and kind == "turntable")
        remedy = "--path interpolate stays at the training views"
    notes += _cropped(cameras[0], settings)
    cameras = [paths.framed(c, settings.size, settings.fov_y) for c in cameras]
    return FilmPlan(_numbered(cameras), coverage, remedy, [*notes, words])


def _cropped(camera: Camera, settings: FilmSettings) -> list[str]:
    """Return a line for the user on what frames of another shape do not show of a photograph."""
    if settings.size is None or settings.fov_y is not None:
        return []
    camera = pinhole_of(camera)
    zooms = settings.size[0] / camera.width, settings.size[1] / camera.height
    whole = math.degrees(2 * math.atan(0.5 * settings.size[1] / (min(zooms) * camera.K[1, 1])))
    shown = f"{min(zooms) / max(zooms):.0%} of their {'height' if zooms[0] > zooms[1] else 'width'}"
    words = f"frames have another shape than the photographs, and show {shown}; --fov {whole:.0f} shows all"
    return [words] * (max(zooms) > WIDER * min(zooms))


def _numbered(cameras: list[Camera]) -> list[tuple[str, Camera]]:
    return [(f"{i:04d}", c) for i, c in enumerate(cameras)]


FILM = "film.mp4"
SHEET = "sheet.png"
SHEET_FRAMES = 6
"""Frames of a sheet, evenly spaced."""
COVERAGE = "coverage"
"""Subfolder for images that mark regions by the number of training views that saw them."""


def check_plan(plan: FilmPlan, out: Path, coverage: bool, sheet: bool) -> tuple[bool, bool]:
    """Return whether ``out`` is a film and not a folder, and whether all frames have one size."""
    alone, one_size = out.suffix.lower() in SUFFIXES, len({(c.width, c.height) for _, c in plan.cameras}) == 1
    with explained(f"{out}: not rendered", "give the name of a folder, or leave out that flag", ValueError, UsageError):
        expect(plan.cameras, "no camera is given")
        expect(alone or not out.suffix or out.is_dir(), f"films end in {', '.join(SUFFIXES)}")
        expect(one_size or not (alone or sheet), "views differ in size, but a film or sheet needs one: give --size")
        expect(not (alone and coverage), "coverage images are PNG files in a folder")
    return alone, one_size


def sheet_path(out: Path) -> Path:
    """Return the path of the sheet: in the folder, or beside the film."""
    return out.with_name(f"{out.stem}-{SHEET}") if out.suffix.lower() in SUFFIXES else out / SHEET


def _frames(
    model: FittedModel, cameras: Sequence[Camera], settings: FilmSettings, coverage: bool | Sequence[View]
) -> Iterator[tuple[np.ndarray, np.ndarray, float, np.ndarray | None]]:
    """Yield each frame's image [H, W, 3], alpha [H, W], fraction outside all photographs, and coverage image (or None)."""
    gaussians, options = model.gaussians(), model.options()
    if settings.background is not None:
        options = replace(options, background=gaussians.means.new_tensor(settings.background))
    photographs, views = [model.cameras()[n] for n in model.train], coverage if isinstance(coverage, Sequence) else []
    cut_out, masks = any(v.alpha is not None for v in views), [v.mask for v in views] or None
    training = depth_views(Renders(gaussians, options), [v.camera for v in views] or photographs, masks) if coverage else None
    shown = options if coverage else options.for_display(gaussians)  # coverage needs exact depths
    for camera in cameras:
        with torch.no_grad():
            r = rasterize(gaussians, camera, shown)
        image, surface, covered = r.rgb.cpu().numpy(), torch.where(r.alpha >= MIN_ALPHA, r.depth, 0), None
        if training is not None:
            classes = classes_of(coverage_map(surface, camera, training)[0], (surface <= 0) & cut_out)
            covered = coverage_image(image, classes["0"], classes["1"])
        yield image, r.alpha.cpu().numpy(), fraction_outside(surface, camera, photographs, not model.transparent), covered


def render_film(
    model: FittedModel,
    plan: FilmPlan,
    out: Path,
    settings: FilmSettings,
    *,
    coverage: bool | Sequence[View] = False,
    sheet: bool = False,
    tell: Say = silent,
) -> tuple[list[Path], list[str]]:
    """Render a plan to PNG files and film.mp4, or to a film alone; ``sheet`` adds six frames in one image. Files and notes."""
    alone, one_size = check_plan(plan, out, bool(coverage), sheet)
    folder, film = (out.parent, out) if alone else (out, out / FILM)
    files = [] if alone else [folder / f"{name}.png" for name, _ in plan.cameras]
    older = [] if alone else [p for p in folder.glob("*.png") if p not in files and p.name != SHEET]
    faults: list[str] = []
    chosen, count, straight = [], len(plan.cameras), model.transparent and settings.background is None

    def write(file: Path, image: np.ndarray, alpha: np.ndarray | None = None) -> None:
        write_bytes(file, png(image if alpha is None else straight_alpha(image, alpha, model.background)))

    def images() -> Iterator[np.ndarray]:
        frames = _frames(model, [c for _, c in plan.cameras], settings, coverage)
        with background() as start:
            for i in counted(range(count), tell, "rendering", "frames"):
                image, alpha, outside, covered = next(frames)
                faults.append(fault_of(image, alpha, plan.coverage, outside))
                if files:
                    start(write, files[i], image, alpha if straight else None)
                if covered is not None:
                    start(write, out / COVERAGE / files[i].name, covered)
                if i in {k * count // SHEET_FRAMES for k in range(SHEET_FRAMES)}:
                    chosen.append(image)
                yield image
        if one_size:
            tell(f"writing {film.name}")

    with hold_file(out) if alone else hold_folder(out, COVERAGE) as notes:
        if coverage:
            make_folder(out / COVERAGE)
        if one_size:
            write_film(film, images(), settings.fps)
        else:
            collections.deque(images(), maxlen=0)
        if sheet:
            write_bytes(sheet_path(out), png(frame_sheet(chosen)))
    cut = cut_advice(model, [c for _, c in plan.cameras]) if NEARLY_NOTHING in faults else ""
    notes = [*notes, *plan.notes, *fault_notes(faults, plan.remedy, cut)]
    notes += [f"{len(older)} older images are also in {folder}: remove them, or give a new folder"] if older else []
    return [*files, film] if one_size else files, notes


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
        fov_y: Vertical field of view [rad]; None for that of the photographs, or less if frames of another shape would show
            more. Ignored with your own cameras.
        background: Colour behind the scene, in [0, 1]; None for the background of the fit.
        coverage: True to also write images into the subfolder coverage, with magenta stripes on pixels that no training view
            saw, and amber stripes on pixels that one view saw. Or the training views, to respect their masks.

    Returns:
        The files written: a PNG for each camera in order, then the film, if any; without the coverage images.

    Raises:
        DataError: A file of keyframes cannot be read.
        ResourceError: A file cannot be written, or another process writes into the folder.
        TypeError: The model is none.
        UsageError: The path or the units are unknown, or a number is out of its range.
    """
    if not isinstance(model, FittedModel):
        kind = type(model).__name__
        raise TypeError(f"model must be the result of fit or open_run, not {kind}; `warpgs.rasterize` renders Gaussians alone")
    settings = FilmSettings(frames, seconds, fps, size, fov_y, background)
    if isinstance(path, str):
        plan = plan_film(model, path, settings)
    else:
        own = [convert_camera(c, model.normalization, units, "scene") for c in path]
        plan = FilmPlan(_numbered(own), 0.0, "move the cameras nearer to the photographs, and check their poses and units", [])
    files, notes = render_film(model, plan, Path(out), settings, coverage=coverage)
    for note in notes:
        say(f"warpgs: {note}", error=True)
    return files
