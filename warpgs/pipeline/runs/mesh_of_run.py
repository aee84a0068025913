"""The mesh of a run, from the depth of its training views, as a file."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from warpgs.coordinates import convert_mesh
from warpgs.errors import DataError
from warpgs.export.mesh_files import check_suffix, write_mesh
from warpgs.mesh.fuse import FusedMesh, MeshOptions, fuse
from warpgs.mesh.grid import GridPlan
from warpgs.pipeline.films.rig import common_up
from warpgs.pipeline.runs.folder import open_run
from warpgs.pipeline.runs.request import choose_device
from warpgs.runtime.byte_units import format_bytes
from warpgs.runtime.folder_lock import hold_file


def mesh(
    folder: Path, target: Path, options: MeshOptions, device_name: str, *, stage: Callable[[str], object],
    say: Callable[[str], object],
) -> list[str]:  # fmt: skip
    """Write the mesh of the surfaces that a run's training views see, in the units of the scene's files.

    Args:
        folder: The run folder.
        target: .ply or .glb file to write.
        options: Options; ``voxel`` is in units of the scene's files.
        device_name: auto, cpu or cuda.
        stage: Function that shows a line of progress.
        say: Called with the automatic choices before the work starts.

    Returns:
        Lines for the user.

    Raises:
        DataError: The folder is not a run, or its training views see no surface.
        ResourceError: Memory does not suffice, the device is missing, or the file cannot be written.
        UsageError: The suffix is not supported, or an option is out of range.
    """
    check_suffix(target)
    device, _ = choose_device(device_name)
    run = open_run(folder, device)
    if not run.train:
        raise DataError(f"{folder}: the run has no training views, so coverage is unknown; fit again")
    cameras, scale = [run.scene_cameras[n] for n in run.train], run.normalization.scale
    if options.voxel is not None:
        options = replace(options, voxel=options.voxel * scale)

    def planned(plan: GridPlan, memory: str) -> None:
        lost = f"{100 * (1 - plan.inside):.1f} %"
        say(
            f"grid: {' x '.join(map(str, plan.shape))} points, {memory}, voxel {plan.voxel / scale:.4g} in units of the "
            "scene's files" + (f"; {lost} of the observed surface is outside the grid and left out" if lost != "0.0 %" else "")
        )

    with hold_file(target) as notes:
        found = fuse(run.scene_gaussians, cameras, run.options(), options, stage=stage, planned=planned)
        made = convert_mesh(found.mesh, run.normalization, "scene", "file")
        up = common_up(cameras)
        write_mesh(target, made, up)
    if up is None and target.suffix.lower() == ".glb":
        notes = [*notes, "the cameras have no common upward direction, so the mesh may be tilted in a viewer"]
    return [*run.notes(), *notes, *_lines(found, len(cameras)), f"{target}: {format_bytes(os.path.getsize(target))}"]


def _lines(found: FusedMesh, views: int) -> list[str]:
    """Return lines for the user on the size and the coverage of a mesh."""
    mesh, lines = found.mesh, []
    lines.append(
        f"{found.extracted:,} triangles extracted, {found.removed:,} small parts removed; "
        f"the mesh has {len(mesh.faces):,} triangles and {len(mesh.vertices):,} vertices"
    )
    lines.append(
        f"{100 * found.unseen:.1f} % of the volume, such as backs and insides, was not observed by the {views} training views; "
        "the mesh is open there"
    )
    if found.uncolored:
        lines.append(f"{found.uncolored:,} vertices without an observed colour take the colour of the nearest coloured vertex")
    return lines
