"""Models for others: a run or a file, filtered, in any format."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from warpgs.coordinates import convert_gaussians
from warpgs.errors import DataError, UsageError
from warpgs.export.formats import Format, format_of, read_gaussians, write_gaussians
from warpgs.kernels.knn import morton_codes
from warpgs.pipeline.model.compress import drop_unused_sh
from warpgs.pipeline.model.coverage import coverage
from warpgs.pipeline.model.filters import box_of, disturbing, inside, levelling, limit_degree, rotate, rotation_about, select
from warpgs.pipeline.runs.folder import StoredRun, open_run
from warpgs.pipeline.runs.mesh import upwards
from warpgs.runtime.folder_lock import hold_folder
from warpgs.scene import Gaussians


@dataclass(frozen=True)
class Filters:
    """Choices of what is done to a model on its way into a file."""

    crop: str | None = None
    """Box to keep, as `box_of` takes it; None for everything."""
    clean: bool | None = None
    """True to remove what only disturbs; None for what suits the format (`Format.cleaned`)."""
    sh_degree: int | None = None
    """Highest degree of harmonics; None for all that the format holds."""
    rotate: str | None = None
    """Axis and angle as x,y,z,degrees, or level: up as the cameras of a run say, to -y; None for no rotation."""


def convert(source: Path, target: Path, filters: Filters = Filters()) -> list[str]:
    """Write a file of Gaussians in another format; returns lines for the user.

    Args:
        source: The file to read.
        target: The file to write; its suffix says the format.
        filters: Filters, applied in the order rotate, crop, clean, sh_degree.

    Raises:
        DataError: The file cannot be read or is malformed, or nothing is left of it.
        ResourceError: Another process writes into the target's folder, or it cannot be written.
        UsageError: A suffix is unknown, a filter makes no sense, or needs the cameras of a run.
    """
    kind = format_of(target)
    format_of(source)
    if filters.rotate == "level":
        raise UsageError("--rotate level needs the cameras of a run: use warpgs export RUN, or give x,y,z,degrees")
    return _written(read_gaussians(source), None, target, kind, filters)


def export(folder: Path, target: Path, filters: Filters = Filters()) -> list[str]:
    """Write a run's Gaussians to a file, in the units of the scene's files; returns lines for the user.

    Args:
        folder: The run folder.
        target: The file to write; its suffix says the format.
        filters: Filters, applied in the order rotate, crop, clean, sh_degree.

    Raises:
        DataError: The folder is no run, or nothing is left of its model.
        ResourceError: Another process writes into the target's folder, or it cannot be written.
        UsageError: The suffix is not supported, or a filter makes no sense.
    """
    kind = format_of(target)
    stored = open_run(folder, torch.device("cpu"))
    gaussians = convert_gaussians(drop_unused_sh(stored.gaussians()), stored.normalization, "scene", "file")
    return _written(gaussians, stored, target, kind, filters)


def _written(gaussians: Gaussians, stored: StoredRun | None, target: Path, kind: Format, filters: Filters) -> list[str]:
    """Filter Gaussians in file units, and write them; returns lines for the user."""
    gaussians, lines = _filtered(gaussians, stored, filters, kind.cleaned if filters.clean is None else filters.clean)
    if not len(gaussians):
        raise DataError(f"{target}: not written, no Gaussian is left. Give a larger box, or --no-clean")
    degree = min(kind.max_degree, gaussians.sh_degree, 3 if filters.sh_degree is None else filters.sh_degree)
    if degree < gaussians.sh_degree:
        why = "as asked" if degree == filters.sh_degree else f"{kind.name} holds none"
        lines.append(f"harmonics above degree {degree} are left out, {why}")
    gaussians = limit_degree(gaussians, degree)
    if kind.sorted:
        gaussians = select(gaussians, torch.argsort(morton_codes(gaussians.means), stable=True))
    with hold_folder(target.parent) as notes:
        write_gaussians(target, gaussians, units="file")
    lines += _changes(target, gaussians) if kind.encode is not None else []
    return [*notes, *lines, f"{len(gaussians):,} Gaussians in {target}, {target.stat().st_size / 2**20:.2f} MiB"]


def _filtered(gaussians: Gaussians, stored: StoredRun | None, filters: Filters, clean: bool) -> tuple[Gaussians, list[str]]:
    """Rotate, crop and clean Gaussians in file units; returns what is left, and lines for the user."""
    lines = []
    keep = torch.ones(len(gaussians), dtype=torch.bool)
    removed = disturbing(gaussians, None if stored is None else _maxima(stored)) if clean else {}
    if filters.rotate is not None:
        rotation = _rotation(filters.rotate, stored)
        gaussians = rotate(gaussians, rotation)
        degrees = math.degrees(math.acos(min(1.0, max(-1.0, (float(np.trace(rotation)) - 1) / 2))))
        lines.append(f"turned by {degrees:.1f} degrees about the origin; cameras of the scene no longer fit this file")
    if filters.crop is not None:
        keep = inside(gaussians, box_of(filters.crop))
        lines.append(f"{int((~keep).sum()):,} Gaussians lie outside of the box")
    if removed:
        counts = ", ".join(f"{int((where & keep).sum()):,} {reason}" for reason, where in removed.items())
        lines.append(f"removed: {counts} (--no-clean keeps them)")
        keep &= ~torch.stack(list(removed.values())).any(0)
    return select(gaussians, keep), lines


def _changes(target: Path, gaussians: Gaussians) -> list[str]:
    """Return a line on what the format changed, from the file itself."""
    back = read_gaussians(target)
    moved = float((back.means.double() - gaussians.means.double()).abs().max())
    scales = (back.log_scales.double() - gaussians.log_scales.double()).abs().amax(1)
    clamped = int((scales > 0.1).sum())
    if moved == 0 and not scales.any():
        return []
    text = f"rounded by the format: positions by at most {moved:.2g} of the scene's units"
    return [text + (f"; {clamped:,} Gaussians are of another size by more than a tenth" if clamped else "")]


def _maxima(stored: StoredRun) -> torch.Tensor:
    """Return the largest blending weight of each Gaussian of a run over its training views, shape [N]."""
    gaussians = stored.gaussians()
    like = gaussians.means.new_tensor
    cameras = [stored.scene_cameras[name] for name in stored.train]
    tensors = [replace(c, viewmat=like(c.viewmat), K=like(c.K)) for c in cameras]
    return coverage(gaussians, tensors, stored.options()).maxima


def _rotation(wish: str, stored: StoredRun | None) -> np.ndarray:
    """Return the rotation [3, 3] that a user asks for; UsageError where the text is none."""
    if wish == "level" and stored is not None:
        up = upwards([stored.scene_cameras[name] for name in stored.train])
        if up is None:
            raise UsageError("--rotate level: the cameras do not agree on an upward direction; give x,y,z,degrees")
        return levelling(up)
    try:
        x, y, z, degrees = map(float, wish.split(","))
    except ValueError as e:
        raise UsageError(f"--rotate {wish[:60]}: give x,y,z,degrees, or level") from e
    return rotation_about(np.array([x, y, z]), math.radians(degrees))
