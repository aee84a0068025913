"""Filters of an export: which Gaussians are kept, and how the model is rotated, with a line for the user on each."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch

from warpgs.coordinates import convert_gaussians
from warpgs.errors import UsageError
from warpgs.geometry import matmul
from warpgs.pipeline.films.rig import common_up
from warpgs.pipeline.model.compress import drop_unused_sh
from warpgs.pipeline.model.coverage import coverage
from warpgs.pipeline.model.filters import box_of, disturbing, inside, levelling, limit_degree, rotate, rotation_about, select
from warpgs.pipeline.runs.folder import StoredRun
from warpgs.scene import Camera, Gaussians


@dataclass(frozen=True)
class Filters:
    """Filters of a model before it is written, in this order: crop and clean, rotate, sh_degree."""

    crop: str | None = None
    """Box to keep, as `box_of` takes it; None for everything."""
    clean: bool | None = None
    """True to remove floaters and needles; None for the format's default (`Format.cleaned`)."""
    sh_degree: int | None = None
    """Highest degree of harmonics; None for all that the format can store."""
    rotate: str | None = None
    """Axis and angle as x,y,z,degrees; or level, to rotate the upward direction of a run's cameras to -y; None for no
    rotation."""


NO_FILTERS = Filters()
"""The default filters: the format determines cleaning."""


def filtered(
    gaussians: Gaussians, stored: StoredRun | None, filters: Filters, cleaned: bool
) -> tuple[Gaussians, np.ndarray | None, list[str]]:
    """Filter Gaussians in file units.

    Args:
        gaussians: N Gaussians in file units.
        stored: The run of the Gaussians; None without cameras.
        filters: The filters.
        cleaned: Default for cleaning.

    Returns:
        The remaining Gaussians, their rotation [3, 3] (None for no rotation), and lines for the user.

    Raises:
        UsageError: A filter is invalid, or needs the cameras of a run.
    """
    rotation = rotation_of(filters.rotate, None if stored is None else training_cameras(stored))
    keep, lines = torch.ones(len(gaussians), dtype=torch.bool, device="cpu"), []
    if filters.crop is not None:
        keep = inside(gaussians, box_of(filters.crop))
        lines.append(f"{int((~keep).sum()):,} Gaussians outside the box are left out")
    if cleaned if filters.clean is None else filters.clean:
        removed = disturbing(gaussians, None if stored is None else _maxima(stored))
        counts = {reason: int((where & keep).sum()) for reason, where in removed.items()}
        if words := [f"{count:,} {reason}" for reason, count in counts.items() if count]:
            lines.append(f"removed Gaussians: {', '.join(words)} (--no-clean keeps them)")
        for where in removed.values():
            keep &= ~where
    gaussians = select(gaussians, keep)
    if rotation is not None:
        gaussians = rotate(gaussians, rotation)
        lines.append(turned_line(rotation))
    if filters.sh_degree is not None and filters.sh_degree < gaussians.sh_degree:
        lines.append(f"harmonics above degree {filters.sh_degree} are left out (--sh-degree)")
    if filters.sh_degree is not None:
        gaussians = limit_degree(gaussians, filters.sh_degree)
    return gaussians, rotation, lines


def file_gaussians(stored: StoredRun) -> Gaussians:
    """Return the Gaussians of a run in file units, without harmonics that are all zero."""
    return convert_gaussians(drop_unused_sh(stored.gaussians()), stored.normalization, "scene", "file")


def training_cameras(stored: StoredRun) -> list[Camera]:
    """Return the training cameras of a run in scene units, numpy arrays."""
    return [stored.scene_cameras[name] for name in stored.train]


def _maxima(stored: StoredRun) -> torch.Tensor:
    """Return the largest blending weight of each Gaussian of a run over its training views, shape [N]."""
    gaussians = stored.gaussians()
    like = gaussians.means.new_tensor
    tensors = [replace(c, viewmat=like(c.viewmat), K=like(c.K)) for c in training_cameras(stored)]
    return coverage(gaussians, tensors, stored.options()).maxima


def rotation_of(wish: str | None, cameras: list[Camera] | None) -> np.ndarray | None:
    """Return the rotation [3, 3] that a user's text specifies; None for no rotation.

    Args:
        wish: Axis and angle as x,y,z,degrees; level; or None.
        cameras: Cameras that define the upward direction for `level`; None if unknown.

    Raises:
        UsageError: The text is not a rotation, or there are no cameras for `level`.
    """
    if wish is None:
        return None
    if wish == "level":
        if cameras is None:
            raise UsageError("--rotate level needs the cameras of a run: use warpgs export RUN, or give x,y,z,degrees")
        up = common_up(cameras)
        if up is None:
            raise UsageError("--rotate level: the cameras do not agree on an upward direction; give x,y,z,degrees")
        return levelling(up)
    try:
        x, y, z, degrees = map(float, wish.split(","))
    except ValueError as e:
        raise UsageError(f"--rotate {wish[:60]}: give x,y,z,degrees, or level") from e
    return rotation_about(np.array([x, y, z]), math.radians(degrees))


def turned_line(rotation: np.ndarray) -> str:
    """Return a line for the user on a rotation [3, 3]."""
    degrees = math.degrees(math.acos(min(1.0, max(-1.0, (float(np.trace(rotation)) - 1) / 2))))
    return f"rotated by {degrees:.1f} degrees about the origin; use the same --rotate for Gaussians and cameras"


def rotate_camera(camera: Camera, rotation: np.ndarray) -> Camera:
    """Return a camera after a rotation [3, 3] of the scene about the origin; numpy arrays."""
    viewmat = np.array(camera.viewmat, np.float64)
    viewmat[:3, :3] = matmul(viewmat[:3, :3], rotation.T)
    return replace(camera, viewmat=viewmat)
