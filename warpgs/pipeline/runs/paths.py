"""Films of a fitted model along a path of cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from warpgs.coordinates import convert_camera
from warpgs.errors import UsageError
from warpgs.files import make_folder, write_bytes
from warpgs.pipeline.metrics.coverage_map import MIN_ALPHA, DepthView, coverage_map, depth_views
from warpgs.pipeline.metrics.coverage_scores import classes_of
from warpgs.pipeline.runs.camera_paths import PATHS, camera_path
from warpgs.pipeline.runs.image_names import image_names
from warpgs.pipeline.runs.model_file import FittedModel
from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.report.coverage_image import coverage_image
from warpgs.report.film import write_mp4
from warpgs.report.images import png, straight_alpha
from warpgs.runtime.folder_lock import hold_folder
from warpgs.runtime.terminal import say
from warpgs.scene import Camera, Gaussians, Render, View

FILM = "film.mp4"
COVERAGE = "coverage"
"""Subfolder for the images of what training views saw."""


@torch.no_grad()
def _median_depth(gaussians: Gaussians, cameras: list[Camera]) -> float:
    """Return the median rendered depth [u] over covered pixels of at most five cameras; 1 where nothing is covered."""
    depths = []
    for camera in cameras[:: max(1, len(cameras) // 5)]:
        r = rasterize(gaussians, camera)
        depths.append(r.depth[r.alpha > 0.5].flatten().cpu().numpy())
    values = np.concatenate(depths)
    return float(np.median(values)) if len(values) else 1.0


def _named_cameras(model: FittedModel, path: str, frames: int) -> list[tuple[str, Camera]]:
    """Return the cameras of a path in scene units [u], with the stems of their files."""
    if path not in PATHS:
        raise UsageError(f"path {path!r} is not one of {', '.join(PATHS)}")
    if path == "views":
        names = image_names(model.scene_cameras)
        return [(names[n], c) for n, c in model.cameras().items()]
    train = [model.cameras()[n] for n in model.train]
    cameras = camera_path(path, train, _median_depth(model.gaussians(), train), frames)
    return [(f"{i:04d}", c) for i, c in enumerate(cameras)]


def _training_depths(model: FittedModel, views: bool | Sequence[View], options: RasterizeOptions) -> list[DepthView]:
    """Return the depths of the training views of a model; with their masks where the views themselves are given."""
    masks = [v.mask for v in views] if isinstance(views, Sequence) else None
    cameras = [v.camera for v in views] if isinstance(views, Sequence) else [model.cameras()[n] for n in model.train]
    return depth_views(model.gaussians(), cameras, options, masks)


def _covered(image: np.ndarray, render: Render, camera: Camera, training: list[DepthView], cut_out: bool) -> bytes:
    """Return the PNG of an image [H, W, 3] that shows what no training view saw, and what one saw."""
    seen = coverage_map(torch.where(render.alpha >= MIN_ALPHA, render.depth, 0), camera, training)
    classes = classes_of(seen, cut_out)
    return png(coverage_image(image, classes["0"], classes["1"]))


def render_path(
    model: FittedModel,
    path: str | Sequence[Camera] = "orbit",
    *,
    out: str | Path,
    units: str = "scene",
    frames: int = 90,
    fps: int = 30,
    background: tuple[float, float, float] | None = None,
    coverage: bool | Sequence[View] = False,
) -> list[Path]:
    """Render a model along a path of cameras to PNG files and, where all images have one size, to a film.

    Images of a model whose scene knows its opacity are transparent, with straight alpha, unless a background is named; a film
    never is.

    Args:
        model: Result of `fit` or `open_run`.
        path: views (every view of the scene), orbit or spiral; or cameras of your own.
        out: Folder to write; it may exist.
        units: Units of your own cameras: scene or file.
        frames: Number of frames of an orbit or a spiral.
        fps: Frames per second of the film.
        background: Colour behind the scene, in [0, 1]; None for that of the fit.
        coverage: Whether to write, into the subfolder coverage, each image with what no training view saw striped in magenta
            and what one saw in amber; or the training views, whose masks then count.

    Returns:
        The files written: a PNG for each camera in order, then the film, if any; the images of coverage are not among them.

    Raises:
        ResourceError: A file cannot be written, or another process writes into the folder.
        UsageError: The path or the units are unknown, or there are no frames.
    """
    if isinstance(path, str):
        cameras = _named_cameras(model, path, frames)
    else:
        cameras = [(f"{i:04d}", convert_camera(c, model.normalization, units, "scene")) for i, c in enumerate(path)]
    if not cameras:
        raise UsageError("there is no camera to render; give at least one")
    out, gaussians, options = Path(out), model.gaussians(), model.options()
    files = [out / f"{name}.png" for name, _ in cameras]
    transparent = model.transparent and background is None
    if background is not None:
        options = dataclasses.replace(options, background=gaussians.means.new_tensor(background))

    training = _training_depths(model, coverage, options) if coverage else None
    cut_out = isinstance(coverage, Sequence) and any(v.alpha is not None for v in coverage)

    def images() -> Iterator[np.ndarray]:
        for file, (_, camera) in zip(files, cameras):
            with torch.no_grad():
                r = rasterize(gaussians, camera, options)
            image = r.rgb.cpu().numpy()
            write_bytes(file, png(straight_alpha(image, r.alpha.cpu().numpy(), model.background) if transparent else image))
            if training is not None:
                write_bytes(out / COVERAGE / file.name, _covered(image, r, camera, training, cut_out))
            yield image

    with hold_folder(out, COVERAGE) as notes:
        if training is not None:
            make_folder(out / COVERAGE)
        for note in notes:
            say(f"warpgs: {note}", error=True)
        if len({(c.width, c.height) for _, c in cameras}) == 1:
            write_mp4(out / FILM, images(), fps)
            return [*files, out / FILM]
        for _ in images():
            pass
    return files
