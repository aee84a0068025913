"""Films of a fitted model along a path of cameras."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
import torch

from warpgs.coordinates import convert_camera
from warpgs.errors import UsageError
from warpgs.files import write_bytes
from warpgs.pipeline.runs.camera_paths import PATHS, camera_path
from warpgs.pipeline.runs.image_names import image_names
from warpgs.pipeline.runs.model_file import FittedModel
from warpgs.render.rasterize import rasterize
from warpgs.report.film import write_mp4
from warpgs.report.images import png, straight_alpha
from warpgs.runtime.folder_lock import hold_folder
from warpgs.runtime.terminal import say
from warpgs.scene import Camera, Gaussians

FILM = "film.mp4"


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


def render_path(
    model: FittedModel,
    path: str | Sequence[Camera] = "orbit",
    *,
    out: str | Path,
    units: str = "scene",
    frames: int = 90,
    fps: int = 30,
    background: tuple[float, float, float] | None = None,
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

    Returns:
        The files written: a PNG for each camera in order, then the film, if any.

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

    def images() -> Iterator[np.ndarray]:
        for file, (_, camera) in zip(files, cameras):
            with torch.no_grad():
                r = rasterize(gaussians, camera, options)
            image = r.rgb.cpu().numpy()
            write_bytes(file, png(straight_alpha(image, r.alpha.cpu().numpy(), model.background) if transparent else image))
            yield image

    with hold_folder(out) as notes:
        for note in notes:
            say(f"warpgs: {note}", error=True)
        if len({(c.width, c.height) for _, c in cameras}) == 1:
            write_mp4(out / FILM, images(), fps)
            return [*files, out / FILM]
        for _ in images():
            pass
    return files
