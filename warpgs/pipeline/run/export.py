"""Files from a run: filtered Gaussians, cameras, meshes."""

import copy
import math
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from warpgs.device import format_bytes
from warpgs.errors import DataError, UsageError, explained, listed
from warpgs.export.base import Format, find_format, format_of, origin_of, write_gaussians
from warpgs.export.meshes_and_cameras import check_suffix, holds_cameras, write_cameras, write_mesh
from warpgs.geometry import convert_box, convert_camera, convert_gaussians, convert_points, matmul, rotate
from warpgs.io.transforms import read_cameras, stated_origin
from warpgs.kernels.neighbours import morton_codes
from warpgs.locks import hold_file
from warpgs.mesh.fuse import GridPlan, MeshOptions, fuse
from warpgs.pipeline.films.paths import common_up
from warpgs.pipeline.model import edit
from warpgs.pipeline.run.folder import CONFIG, POSED_SCENE, StoredRun, open_run
from warpgs.pipeline.run.request import choose_device
from warpgs.poses.find import JSON as POSES
from warpgs.process import Say
from warpgs.scene import Camera, Gaussians, Normalization, base_colors


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
    gaussians: Gaussians, stored: StoredRun | None, filters: Filters, cleaned: bool, origin: np.ndarray
) -> tuple[Gaussians, np.ndarray | None, list[str]]:
    """Filter Gaussians in file units about an origin [3]; returns them with the rotation, if any, and lines for the user."""
    rotation = rotation_of(filters.rotate, None if stored is None else upward(stored))
    keep, lines = torch.ones(len(gaussians), dtype=torch.bool, device="cpu"), []
    if filters.crop is not None:
        center, *rest = edit.box_of(filters.crop)
        keep = edit.inside(gaussians, (center - origin, *rest))
        lines.append(f"{int((~keep).sum()):,} Gaussians outside the box are left out")
    if cleaned if filters.clean is None else filters.clean:
        maxima = None
        if stored is not None:  # the largest blending weight of each Gaussian over the training views
            maxima = edit.coverage(stored.gaussians(), training_cameras(stored), stored.options())[0]
        removed = edit.first_reasons(edit.floaters(gaussians, maxima))
        counts = {reason: int((where & keep).sum()) for reason, where in removed.items()}
        if words := [f"{count:,} {reason}" for reason, count in counts.items() if count]:
            lines.append(f"removed Gaussians: {', '.join(words)} (--no-clean keeps them)")
        for where in removed.values():
            keep &= ~where
    gaussians = edit.select(gaussians, keep)
    if rotation is not None:
        gaussians = rotate(gaussians, rotation)
        lines.append(turned_line(rotation))
    if filters.sh_degree is not None:
        if filters.sh_degree < gaussians.sh_degree:
            lines.append(f"harmonics above degree {filters.sh_degree} are left out (--sh-degree)")
        gaussians = edit.limit_degree(gaussians, filters.sh_degree)
    return gaussians, rotation, lines


def file_gaussians(stored: StoredRun) -> Gaussians:
    """Return the Gaussians of a run in file units about its origin, without harmonics that are all zero."""
    return convert_gaussians(edit.drop_unused_sh(stored.gaussians()), stored.normalization.local, "scene", "file")


def origin_line(origin: np.ndarray) -> list[str]:
    """Return a line for the user on the origin [3] of a file, if it is not 0."""
    at = ", ".join(f"{v:.12g}" for v in origin)
    return [
        f"coordinates in the file are relative to {at}, because float32 is too coarse for map coordinates; the file states "
        "this point. Other programs need cameras relative to it, too: `warpgs export RUN --to transforms.json`"
    ] * bool(origin.any())


def training_cameras(stored: StoredRun) -> list[Camera]:
    """Return the training cameras of a run in scene units, numpy arrays."""
    return [stored.scene_cameras[name] for name in stored.train]


def upward(stored: StoredRun) -> np.ndarray | None:
    """Return the upward direction [3] in a run's files: as levelled, else as its cameras agree; None if they do not."""
    n = stored.normalization
    return common_up(training_cameras(stored)) if n.up is None else matmul(n.rotation.T, n.up)


def _ahead(stored: StoredRun) -> np.ndarray | None:
    """Return the mean viewing direction [3] in a run's files if their axes are arbitrary: poses were found, and no place."""
    scenes = stored.folder / POSED_SCENE, Path(stored.record["scene"]["path"] or stored.folder)
    if stored.normalization.place is not None or not any(os.path.isfile(scene / POSES) for scene in scenes):
        return None
    return matmul(stored.normalization.rotation.T, np.mean([c.viewmat[2, :3] for c in training_cameras(stored)], axis=0))


def rotation_of(wish: str | None, up: np.ndarray | None) -> np.ndarray | None:
    """Return the rotation [3, 3] that a user's text specifies, for files with an upward direction [3]; None for no rotation."""
    if wish is None:
        return None
    if wish == "level":
        if up is None:
            raise UsageError("--rotate level needs the cameras of a run that agree on an upward direction; give x,y,z,degrees")
        return edit.levelling(up)
    with explained(f"--rotate {wish[:60]}: not four numbers", "give x,y,z,degrees, or level", ValueError, UsageError):
        x, y, z, degrees = map(float, wish.split(","))
    return edit.rotation_about(np.array([x, y, z]), math.radians(degrees))


def turned_line(rotation: np.ndarray) -> str:
    """Return a line for the user on a rotation [3, 3]."""
    degrees = math.degrees(math.acos(min(1.0, max(-1.0, (float(np.trace(rotation)) - 1) / 2))))
    return f"rotated by {degrees:.1f} degrees about the origin; use the same --rotate for Gaussians and cameras"


MAX_POINTS = 100_000
"""Largest number of points that COLMAP's files get: as many as a reconstruction of some hundred photographs."""


def convert(
    source: Path, target: Path, filters: Filters = NO_FILTERS, formats: Sequence[str | type[Format] | Format] = ()
) -> list[str]:
    """Write the Gaussians of one file to another format, or cameras to another file; returns lines for the user."""
    if holds_cameras(target):
        _check_for_cameras(filters, formats)
        found, notes = read_cameras(source)
        if not (origin := stated_origin(source)).any():
            origin = origin_of(np.array([c.center for c in found.values()]))
        return [*notes, *_cameras_written(found, common_up(list(found.values())), target, filters, origin)]
    given = [find_format(f) for f in formats]
    for unused in (f for f in given if not (f.fits(source) or f.fits(target))):
        format_of(target, unused)  # says that its name is another
    if (source / CONFIG).is_file():
        raise UsageError(f"{source}: is a run; use `warpgs export {shlex.quote(str(source))} --to {shlex.quote(str(target))}`")
    read, kind = (format_of(p, next((f for f in given if f.fits(p)), None)) for p in (source, target))
    rotation_of(filters.rotate, None)  # before anything is read
    read = copy.copy(read)
    gaussians, antialiased = read.read_stored(source), read.is_antialiased(source)
    lines = [*read.notes, *_written(gaussians, None, target, kind, filters, antialiased, read.origin)]
    return [read.note, *lines] if read.note and not kind.note else lines


def export(
    folder: Path, target: Path, filters: Filters = NO_FILTERS, format: str | type[Format] | Format | None = None,
    keep_names: bool = False,
) -> list[str]:  # fmt: skip
    """Write a run's Gaussians, or its cameras, in file units, in the format of the suffix; returns lines for the user."""
    if holds_cameras(target):
        _check_for_cameras(filters, () if format is None else (format,))
        stored = open_run(folder, torch.device("cpu"))
        origin, models = stored.normalization.origin, file_gaussians(stored)
        return _cameras_written(stored.cameras("file"), upward(stored), target, filters, origin, keep_names, models)
    if keep_names:
        raise UsageError(f"{target}: --keep-names requires cameras; name the file cameras.json, transforms.json or sparse")
    kind = format_of(target, format)
    stored = open_run(folder, torch.device("cpu"))
    origin = stored.normalization.origin
    return _written(file_gaussians(stored), stored, target, kind, filters, stored.antialiased, origin)


def _written(
    gaussians: Gaussians, stored: StoredRun | None, target: Path, kind: Format, filters: Filters, antialiased: bool,
    origin: np.ndarray | None,
) -> list[str]:  # fmt: skip
    """Filter Gaussians in file units about an origin [3], and write them; returns lines for the user."""
    origin = np.zeros(3) if origin is None else origin
    gaussians, _, lines = filtered(gaussians, stored, filters, kind.cleaned, origin)
    if not len(gaussians):
        raise DataError(f"{target}: not written, because no Gaussian is left; give a larger --crop, or --no-clean")
    if kind.max_degree < gaussians.sh_degree:
        lines.append(f"harmonics above degree {kind.max_degree} are dropped, because {kind.suffix} files cannot store them")
        gaussians = edit.limit_degree(gaussians, kind.max_degree)
    lines = [*(stored.notes() if stored is not None else []), *lines]
    if stored is not None and any(stored.background):
        color = "".join(f"{round(255 * v):02x}" for v in stored.background)
        lines.append(f"the file does not store the background colour of the fit, #{color}; set it in your viewer")
    if antialiased and not kind.declares:
        lines.append(f"{kind.suffix} files cannot say a model is antialiased; choose the antialiased mode in your viewer")
    if kind.sorted:
        gaussians = edit.select(gaussians, torch.argsort(morton_codes(gaussians.means), stable=True))
    kind = copy.copy(kind)
    kind.origin = origin
    with hold_file(target) as notes:
        write_gaussians(target, gaussians, units="file", format=kind, antialiased=antialiased)
    if type(kind).decode is not Format.decode:  # the rounding errors, measured on the file
        back, unit = kind.read_stored(target), "units" if stored is None else stored.normalization.unit
        moved = float((back.means.double() - gaussians.means.double()).abs().max())
        other = int(((back.log_scales.double() - gaussians.log_scales.double()).abs().amax(1) > 0.1).sum())
        if moved or other:
            more = f"; axis lengths of {other:,} Gaussians change by more than 10 %" if other else ""
            lines.append(f"the format rounds positions, by at most {moved:.2g} {unit}{more}")
    lines += ([kind.note] if kind.note else []) + origin_line(origin)
    return [*notes, *lines, f"{len(gaussians):,} Gaussians in {target}, {format_bytes(kind.size(target))}"]


def _check_for_cameras(filters: Filters, formats: Sequence[object]) -> None:
    """Check that only a rotation is requested."""
    if formats:
        raise UsageError("--format does not apply to cameras; leave it out")
    if any(v is not None for v in (filters.crop, filters.clean, filters.sh_degree)):
        raise UsageError("--crop, --clean and --sh-degree do not apply to cameras; use --rotate only")


def _cameras_written(
    named: Mapping[str, Camera], up: np.ndarray | None, target: Path, filters: Filters, origin: np.ndarray,
    keep_names: bool = False, gaussians: Gaussians | None = None,
) -> list[str]:  # fmt: skip
    """Rotate cameras about an origin in file units, with an upward direction, and write them; returns lines for the user.

    The most opaque of the Gaussians become COLMAP's points.
    """
    rotation, lines, points, cameras = rotation_of(filters.rotate, up), [], None, list(named.values())
    if origin.any():
        cameras = [convert_camera(c, Normalization(origin), "file", "scene") for c in cameras]
    if rotation is not None:
        cameras = [convert_camera(c, Normalization(rotation=rotation.T), "scene", "file") for c in cameras]
        lines.append(turned_line(rotation))
    if gaussians is not None and target.name == "sparse":
        shown = gaussians.logit_opacities.argsort(descending=True, stable=True)[:MAX_POINTS]
        turned = gaussians if rotation is None else rotate(gaussians, rotation)
        points = turned.means[shown].numpy(), base_colors(gaussians.sh[shown]).numpy()
        lines.append(f"points3D.txt has positions and colours of {len(shown):,} Gaussians, for trainers that start from points")
    with hold_file(target) as notes:
        lines += write_cameras(target, cameras, list(named) if keep_names else None, points, origin)
    lines += origin_line(origin)
    sizes = sorted({(c.width, c.height) for c in cameras})
    some = listed([f"{w} x {h}" for w, h in sizes], 3)
    names = "kept" if keep_names else "numbers"
    return [*notes, *lines, f"{len(cameras):,} cameras for images of {some} px in {target}; their names are {names}"]


def mesh(
    folder: Path, target: Path, options: MeshOptions, device_name: str, *, crop: str | None = None, stage: Say, say: Say
) -> list[str]:
    """Write the mesh of the surfaces that a run's training views see, in file units, as is ``voxel``; returns lines."""
    check_suffix(target)
    device, _ = choose_device(device_name)
    run = open_run(folder, device)
    cameras, scale, up = training_cameras(run), run.normalization.scale, upward(run)
    if options.voxel is not None:
        options = replace(options, voxel=options.voxel * scale)
    if crop is not None:
        box = crop if crop == "auto" else convert_box(edit.box_of(crop), run.normalization, "file", "scene")
        options = replace(options, crop=box)

    def planned(plan: GridPlan, memory: str) -> None:
        size = f"{' x '.join(map(str, plan.shape))} points, {memory}, voxel {plan.voxel / scale:.4g} {run.normalization.unit}"
        lost = f"; {1 - plan.inside:.1%} of the observed surface is outside the grid and left out"
        say(f"grid: {size}{lost * (plan.inside < 0.9995)}")

    ahead = _ahead(run)
    with hold_file(target) as notes:
        found = fuse(run.scene_gaussians, cameras, run.options(), options, stage=stage, planned=planned)
        made = replace(found.mesh, vertices=convert_points(found.mesh.vertices, run.normalization.local, "scene", "file"))
        write_mesh(target, made, up, run.normalization.origin, ahead)
    remedies = ["--crop auto"] * (options.crop is None) + ["--fill-holes"] * (not options.fill_holes)
    lines = [
        f"{found.extracted:,} triangles extracted, {found.removed:,} small parts removed; the mesh has "
        f"{len(made.faces):,} triangles and {len(made.vertices):,} vertices",
        f"{100 * found.unseen:.1f} % of the volume, such as backs and insides, was not observed by the {len(cameras)} training "
        "views; the mesh is open there" + (f"; try {' and '.join(remedies)}" if remedies else ""),
    ]
    if found.uncolored:
        lines.append(f"{found.uncolored:,} vertices without an observed colour take the colour of the nearest coloured vertex")
    if up is None and target.suffix.lower() == ".glb":
        notes = [*notes, "the cameras have no common upward direction, so the mesh may be tilted in a viewer"]
    lines += origin_line(run.normalization.origin)
    return [*run.notes(), *notes, *lines, f"{target}: {format_bytes(target.stat().st_size)}"]
