"""Files of Gaussians, trained with any program, with cameras from another file: models that render like runs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpgs.constants import LOW_PASS
from warpgs.coordinates import convert_camera
from warpgs.errors import DataError, UsageError
from warpgs.export.formats import format_of, read_with_antialiasing
from warpgs.io.camera_files import colmap_folder, read_cameras
from warpgs.io.decoding import MAX_PIXELS
from warpgs.io.load import load_scene
from warpgs.pipeline.model.model_file import FittedModel
from warpgs.pipeline.runs.request import choose_device
from warpgs.rules import rule_named
from warpgs.scene import Camera, Normalization

RULE = "inria"
"""Default rule for files of Gaussians: most models were trained with it."""


def open_file(
    path: Path,
    cameras: Path | None,
    rule: str | None = None,
    device: str = "auto",
    antialiased: bool = False,
) -> tuple[FittedModel, list[str]]:
    """Read a file of Gaussians and a file of cameras; returns the model and notes for the user.

    Args:
        path: The file, in any format of `warpgs.export.formats`.
        cameras: cameras.json, transforms.json, a COLMAP reconstruction, or a scene folder of any format.
        rule: Name of the cut-offs that the model was trained with: inria, gsplat-1.6 or another of `RULES`; None for inria.
        device: auto, cpu or cuda.
        antialiased: True for a model that was trained with `RasterizeOptions.antialiased`, if its file does not declare it.

    Raises:
        DataError: The model or the cameras cannot be read, or an image would be larger than the limit for photographs.
        ResourceError: The device is missing.
        UsageError: No cameras are given, or the rule is unknown.
    """
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
    gaussians, declared = read_with_antialiasing(path, normalization, "scene")
    gaussians = gaussians.to(where)
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
