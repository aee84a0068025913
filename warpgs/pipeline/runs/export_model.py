"""Export of a model or of its cameras, from a run or a file, filtered, in any format."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from pathlib import Path

import torch

from warpgs.errors import DataError, UsageError
from warpgs.export.base import Format
from warpgs.export.cameras import holds_cameras, write_cameras
from warpgs.export.formats import find_format, format_of, read_with_antialiasing, write_gaussians
from warpgs.io.camera_files import read_cameras
from warpgs.kernels.knn import morton_codes
from warpgs.pipeline.model.filters import limit_degree, select
from warpgs.pipeline.runs.export_filters import (
    NO_FILTERS,
    Filters,
    file_gaussians,
    filtered,
    rotate_camera,
    rotation_of,
    training_cameras,
    turned_line,
)
from warpgs.pipeline.runs.folder import CONFIG, StoredRun, open_run
from warpgs.runtime.byte_units import format_bytes
from warpgs.runtime.folder_lock import hold_file
from warpgs.scene import Camera, Gaussians

ROUNDING = 1e-4
"""Smallest change of a log scale that is reported: a hundredth of a percent."""


def convert(
    source: Path, target: Path, filters: Filters = NO_FILTERS, formats: Sequence[str | type[Format] | Format] = ()
) -> list[str]:
    """Write a file of Gaussians, or of cameras, in another format; returns lines for the user.

    Args:
        source: The file to read; for cameras also a folder with a COLMAP reconstruction.
        target: The file to write; its suffix selects the format.
        filters: Filters; cameras are only rotated.
        formats: Formats that have priority for files with their suffix, as in `write_gaussians`.

    Raises:
        DataError: The file cannot be read or is malformed, or no Gaussian is left.
        ResourceError: Another process writes into the target's folder, or the target cannot be written.
        UsageError: A suffix is unknown, ``source`` is a run folder, a given format fits neither file, a filter is invalid, or a
            filter needs the cameras of a run.
    """
    if holds_cameras(target):
        _check_for_cameras(filters, formats)
        found, notes = read_cameras(source)
        return [*notes, *_cameras_written(list(found.values()), list(found.values()), target, filters)]
    given = [find_format(f) for f in formats]
    for unused in (f for f in given if not (f.fits(source) or f.fits(target))):
        format_of(target, unused)  # says that its name is another
    if (source / CONFIG).is_file():
        raise UsageError(
            f"{source}: is a run folder; use `warpgs export {shlex.quote(str(source))} --to {shlex.quote(str(target))}`"
        )
    read, kind = (format_of(p, next((f for f in given if f.fits(p)), None)) for p in (source, target))
    rotation_of(filters.rotate, None)  # before anything is read
    gaussians, antialiased = read_with_antialiasing(source, None, "file", read)
    lines = _written(gaussians, None, target, kind, filters, antialiased)
    return [read.note, *lines] if read.note and not kind.note else lines


def export(
    folder: Path, target: Path, filters: Filters = NO_FILTERS, format: str | type[Format] | Format | None = None
) -> list[str]:
    """Write a run's Gaussians, or its cameras, to a file, in the units of the scene's files; returns lines for the user.

    Args:
        folder: The run folder.
        target: The file to write; its suffix selects the format.
        filters: Filters; cameras are only rotated.
        format: Format to write, as in `write_gaussians`; None for the format of the suffix.

    Raises:
        DataError: The folder is not a run, or no Gaussian is left.
        ResourceError: Another process writes into the target's folder, or the target cannot be written.
        UsageError: No format has the suffix, ``format`` has another suffix, or a filter is invalid.
    """
    if holds_cameras(target):
        _check_for_cameras(filters, () if format is None else (format,))
        stored = open_run(folder, torch.device("cpu"))
        return _cameras_written(list(stored.cameras("file").values()), training_cameras(stored), target, filters)
    kind = format_of(target, format)
    stored = open_run(folder, torch.device("cpu"))
    return _written(file_gaussians(stored), stored, target, kind, filters, stored.antialiased)


def _written(
    gaussians: Gaussians, stored: StoredRun | None, target: Path, kind: Format, filters: Filters, antialiased: bool
) -> list[str]:
    """Filter Gaussians in file units, and write them; returns lines for the user."""
    gaussians, _, lines = filtered(gaussians, stored, filters, kind.cleaned)
    if not len(gaussians):
        raise DataError(f"{target}: not written, because no Gaussian is left; give a larger --crop, or --no-clean")
    if kind.max_degree < gaussians.sh_degree:
        lines.append(f"harmonics above degree {kind.max_degree} are dropped, because {kind.suffix} files cannot store them")
        gaussians = limit_degree(gaussians, kind.max_degree)
    if stored is not None:
        lines = [*stored.notes(), *lines]
    if stored is not None and any(stored.background):
        color = "".join(f"{round(255 * v):02x}" for v in stored.background)
        lines.append(f"the file does not store the background colour of the fit, #{color}; set it in your viewer")
    if antialiased and not kind.declares:
        lines.append(
            f"{kind.suffix} files cannot declare that the model is antialiased; choose the antialiased mode in your viewer"
        )
    if kind.sorted:
        gaussians = select(gaussians, torch.argsort(morton_codes(gaussians.means), stable=True))
    with hold_file(target) as notes:
        write_gaussians(target, gaussians, units="file", format=kind, antialiased=antialiased)
    lines += _changes(target, gaussians, kind) if type(kind).decode is not Format.decode else []
    lines += [kind.note] if kind.note else []
    return [*notes, *lines, f"{len(gaussians):,} Gaussians in {target}, {format_bytes(target.stat().st_size)}"]


def _changes(target: Path, gaussians: Gaussians, kind: Format) -> list[str]:
    """Return a line on the rounding errors of the format, measured on the file; none for a format in float32."""
    back, _ = read_with_antialiasing(target, None, "file", kind)
    moved = float((back.means.double() - gaussians.means.double()).abs().max())
    scales = (back.log_scales.double() - gaussians.log_scales.double()).abs().amax(1)
    if moved == 0 and float(scales.max()) < ROUNDING:
        return []
    other = int((scales > 0.1).sum())
    text = f"the format rounds positions, by at most {moved:.2g} units of the scene's files"
    return [text + (f"; axis lengths of {other:,} Gaussians change by more than 10 %" if other else "")]


def _check_for_cameras(filters: Filters, formats: Sequence[object]) -> None:
    """Check that only a rotation is requested.

    Raises:
        UsageError: A filter other than a rotation, or a format of Gaussians, is requested.
    """
    if formats:
        raise UsageError("--format does not apply to cameras; leave it out")
    if any(v is not None for v in (filters.crop, filters.clean, filters.sh_degree)):
        raise UsageError("--crop, --clean and --sh-degree do not apply to cameras; use --rotate only")


def _cameras_written(cameras: list[Camera], level: list[Camera], target: Path, filters: Filters) -> list[str]:
    """Rotate cameras in file units, and write them; ``level`` are the cameras that define up. Returns lines for the user."""
    rotation, lines = rotation_of(filters.rotate, level), []
    if rotation is not None:
        cameras = [rotate_camera(c, rotation) for c in cameras]
        lines.append(turned_line(rotation))
    with hold_file(target) as notes:
        lines += write_cameras(target, cameras)
    sizes = sorted({(c.width, c.height) for c in cameras})
    some = ", ".join(f"{w} x {h}" for w, h in sizes[:3]) + (" ..." if len(sizes) > 3 else "")
    return [*notes, *lines, f"{len(cameras):,} cameras for images of {some} px in {target}; their names are numbers"]
