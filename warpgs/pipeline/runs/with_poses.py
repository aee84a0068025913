"""Fits of photographs without cameras: poses are found first, and stored with the photographs as a scene in the run folder."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from warpgs.errors import UsageError
from warpgs.pipeline.runs.folder import POSED_SCENE
from warpgs.pipeline.runs.request import SceneRequest
from warpgs.poses.find import find_poses, needs_poses, source_digest
from warpgs.poses.record import JSON, TEXT, read_record


def with_poses(request: SceneRequest, out: Path | None, progress: Callable[[str], object]) -> tuple[SceneRequest, list[str]]:
    """Find the poses of photographs if a request names photographs without cameras; other requests are returned unchanged.

    Args:
        request: The request; its path may be a folder of images or a video.
        out: Run folder, whose subfolder `scene` stores the poses; a run that is continued or restarted reads them from there.
        progress: Called with lines for the user.

    Returns:
        The request for the scene with poses, and notes for the user.

    Raises:
        DataError: The photographs cannot be registered, or are too few.
        UsageError: There is no run folder for the poses, pycolmap is not installed, a continued run has other photographs, or a
            matcher is given for a scene with cameras.
    """
    source = Path(request.path)
    if request.reader is not None or not request.path or not needs_poses(source):
        if request.matcher is not None:
            raise UsageError(f"--matcher requires a folder of photographs without cameras; leave it out for {source}")
        return request, []
    if out is None:
        raise UsageError(f"{source}: has no cameras, and finding poses needs a run folder; give out=")
    scene = out / POSED_SCENE
    if (scene / JSON).is_file():
        record = read_record(scene)
        if record["source_sha256"] != source_digest(source, request.allow_outside):
            raise UsageError(f"{scene} holds poses of other photographs than {source}; give another --out")
    else:
        progress(f"{source} has no cameras: finding the poses of its photographs, to store them in {scene}")
        threads = torch.get_num_threads()
        record = find_poses(
            source, scene, threads=threads, max_pixels=request.max_pixels, allow_outside=request.allow_outside,
            matcher=request.matcher, progress=progress,
        )  # fmt: skip
    return replace(request, path=str(scene), matcher=None), _notes(record)


def lost_lines(out: Path | None) -> list[str]:
    """Return a line on the photographs without a pose, which a run leaves out; an empty list if all have one.

    Raises:
        DataError: The record of the run's poses is incomplete.
    """
    if out is None or not (out / POSED_SCENE / JSON).is_file():
        return []
    rows = read_record(out / POSED_SCENE)["photographs"]
    lost = sum(not p["registered"] for p in rows)
    why = out / POSED_SCENE / TEXT
    return (
        [f"{lost} of {len(rows)} photographs have no pose and were not used: {why} lists reasons and remedies"] if lost else []
    )


def _notes(record: dict[str, Any]) -> list[str]:
    """Return the report's notes on found poses: the method, and photographs without a pose."""
    lost = [f"no pose: {p['name']} {p['reason']}" for p in record["photographs"] if not p["registered"]]
    where = [f"{POSED_SCENE}/{TEXT} in the run folder lists what to photograph next"] if record["advice"] else []
    return [*record["notes"], *lost[:5], *([f"and {len(lost) - 5} more without a pose"] if len(lost) > 5 else []), *where]
