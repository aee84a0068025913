"""Plans of films: the cameras of a path for a model, and notes on the choices made."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from warpgs.errors import UsageError
from warpgs.pipeline.films.camera_paths import LIMITS, camera_path, framed, path_of, upright
from warpgs.pipeline.films.keyframes import read_keyframes, through
from warpgs.pipeline.films.rig import Rig, rig_of
from warpgs.pipeline.films.view_tour import tour_of
from warpgs.pipeline.model.model_file import FittedModel
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.report.image_names import image_names
from warpgs.scene import Camera, Gaussians
from warpgs.suggestion import did_you_mean

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
EMPTY_VIEW = "score each view with `warpgs eval`"
"""Advice for training views that show nothing."""


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
    """Vertical field of view [rad]; None for the field of view of the photographs."""
    background: tuple[float, float, float] | None = None
    """Colour behind the scene, in [0, 1]; None for the background of the fit."""

    def __post_init__(self) -> None:
        """Check what can be checked before any work.

        Raises:
            UsageError: A number is out of its range.
        """
        low, high = LIMITS["width"]
        if self.size is not None and not all(low <= s <= high for s in self.size):
            raise UsageError(f"each side of a film must have {low} to {high} px, not {self.size[0]} x {self.size[1]}")
        narrow, wide = (math.radians(v) for v in LIMITS["fov"])
        if self.fov_y is not None and not narrow <= self.fov_y <= wide:
            raise UsageError(
                f"--fov must be {LIMITS['fov'][0]:g} to {LIMITS['fov'][1]:g} degrees, not {math.degrees(self.fov_y):g}"
            )
        if self.seconds is not None and not 0 < self.seconds * self.fps <= MAX_FRAMES:
            raise UsageError(f"a film must be longer than 0 s and have at most {MAX_FRAMES:,} frames, not {self.seconds:g} s")
        if self.frames is not None and not 1 <= self.frames <= MAX_FRAMES:
            raise UsageError(f"a film must have 1 to {MAX_FRAMES:,} frames, not {self.frames}")

    def count(self, seconds: float) -> int:
        """Return the number of frames of a film; ``seconds`` is its duration if the settings have none."""
        if self.frames is not None:
            return self.frames
        return min(max(1, round((self.seconds or seconds) * self.fps)), MAX_FRAMES)


@dataclass(frozen=True)
class FilmPlan:
    """The frames of a film before they are rendered."""

    cameras: list[tuple[str, Camera]]
    """File name without suffix, and camera, of each frame, in scene units [u]."""
    coverage: float
    """Fraction of a training view's pixels that the model covers; 0 if unknown."""
    remedy: str
    """Advice for frames that show nothing."""
    notes: list[str]
    """Lines for the user on the choices made."""
    nearer: str = "move the cameras nearer to the photographs' cameras"
    """Advice for frames that show areas outside the photographs."""


@torch.no_grad()
def depth_and_coverage(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions) -> tuple[float, float]:
    """Return the median depth [u] over covered pixels, and the median over images of their mean alpha, for up to nine cameras.

    The depth is 1 if no pixel is covered.
    """
    depths, alphas = [], []
    for camera in cameras[:: max(1, len(cameras) // 5)]:
        r = rasterize(gaussians, camera, options)
        alpha = r.alpha.cpu().numpy()
        depths.append(r.depth.cpu().numpy()[alpha > 0.5])
        alphas.append(float(alpha.mean(dtype=np.float64)))
    values = np.concatenate(depths)
    return float(np.median(values)) if len(values) else 1.0, float(np.median(alphas))


def _tour(rig: Rig, train: list[Camera], settings: FilmSettings) -> tuple[list[Camera], str]:
    """Return the cameras of a film through training views, and a description of the path."""
    frames = settings.count(min(max(SECONDS, VIEW_SECONDS * len(train)), MAX_SECONDS))
    cameras = [upright(rig, c) for c in train]
    reaches = [rig.reach(c) for c in train]
    tour = tour_of(cameras, reaches, frames / settings.fps, max(2, frames // MIN_FRAMES_PER_VIEW))
    count = len(tour.keyframes) - tour.closed
    words = "in the given order" if tour.by_name else "from neighbour to neighbour"
    back = ", and back to the first" if tour.closed else ""
    cameras = through(tour.keyframes, frames, closed=tour.closed)
    return cameras, f"path: interpolate, through {count} of {len(train)} cameras {words}{back}"


def _keyframes(model: FittedModel, path: Path, rig: Rig, first: Camera, settings: FilmSettings) -> tuple[list[Camera], str]:
    """Return the cameras of a film through the keyframes of a file, and a description of the path."""
    if settings.fov_y is not None:
        raise UsageError(f"{path}: keyframes have their own fields of view; leave out --fov")
    keyframes = read_keyframes(path, framed(first, settings.size), model.normalization)
    if rig.is_watched([k.camera for k in keyframes]):  # then the path goes around it, and not across
        keyframes = [replace(k, reach=rig.reach(k.camera)) for k in keyframes]
    last = keyframes[-1].seconds
    cameras = through(keyframes, settings.count(last + 1 / settings.fps))
    return cameras, f"path: {len(keyframes)} keyframes over {last:g} s"


def plan_film(model: FittedModel, path: str, settings: FilmSettings) -> FilmPlan:
    """Return the cameras of a path for a model.

    Args:
        model: The model.
        path: One of `PATHS`, or the name of a JSON file of keyframes.
        settings: Settings of the film.

    Raises:
        DataError: The file of keyframes cannot be read.
        UsageError: The path is unknown, or a setting does not apply to it.
    """
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
        shown = [(names[n], framed(c, settings.size, settings.fov_y)) for n, c in scene.items()]
        return FilmPlan(shown, coverage, EMPTY_VIEW, [], _nearer([c for _, c in shown], train, "--coverage marks these places"))
    rig = rig_of(train, depth)
    if path.lower().endswith(".json"):
        cameras, words = _keyframes(model, Path(path), rig, train[0], settings)
        remedy = "c2w of keyframes is camera-to-world in OpenCV axes, in the units of the scene's files"
        nearer = _nearer(cameras, train, "move the keyframes nearer to the photographs' cameras")
        return FilmPlan(_numbered(cameras), coverage, remedy, [words], nearer)
    notes = [f"{len(train)} {'training ' if model.test else ''}cameras {rig.describe()}"]
    if rig.turned:
        notes.append("the photographs are rotated; the film takes its upward direction from the common plane of the cameras")
    kind = path_of(rig) if path == "auto" else path
    if kind == "interpolate":
        cameras, words = _tour(rig, train, settings)
        if path == "auto" and rig.kind == "forward":
            words += "; --path turntable is calmer"
        remedy, nearer = EMPTY_VIEW, "--coverage marks these places"
    else:
        cameras = camera_path(kind, rig, train, settings.count(SECONDS))
        there_and_back = ", there and back over the captured area" if rig.span is not None and kind == "turntable" else ""
        words = f"path: {kind}{there_and_back}"
        remedy = nearer = "--path interpolate stays at the training views"
    cameras = [framed(c, settings.size, settings.fov_y) for c in cameras]
    return FilmPlan(_numbered(cameras), coverage, remedy, [*notes, words], _nearer(cameras, train, nearer))


def _nearer(cameras: Sequence[Camera], train: Sequence[Camera], path: str) -> str:
    """Return advice for frames that show areas outside the photographs: on size if the film is wider, else ``path``."""
    (wide, high), photo = _field(cameras[0]), [_field(c) for c in train]
    if min(wide, high) > WIDER * min(map(min, photo)) or max(wide, high) > WIDER * max(map(max, photo)):
        return "keep the shape and the field of view of the photographs"
    return path


def _field(camera: Camera) -> tuple[float, float]:
    """Return width and height of what a camera sees, as fractions of the depth."""
    return camera.width / float(camera.K[0, 0]), camera.height / float(camera.K[1, 1])


def _numbered(cameras: list[Camera]) -> list[tuple[str, Camera]]:
    return [(f"{i:04d}", c) for i, c in enumerate(cameras)]
