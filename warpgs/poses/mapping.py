"""Structure from motion of prepared photographs: runs the worker process and holds its results."""

from __future__ import annotations

import importlib.util
import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.errors import ResourceError, UsageError
from warpgs.files import write_json
from warpgs.poses.photographs import MATCHING_SIDE, Photograph
from warpgs.runtime.disk_space import disk_is_full
from warpgs.runtime.processor import usable_cores
from warpgs.runtime.subprocesses import ProcessFailed, python_lines
from warpgs.suggestion import install_extras

EXHAUSTIVE = 60
"""Largest number of photographs of which all pairs are matched; for more photographs, pairs are chosen."""
JOB = "job.json"
"""Name of the file with the worker's input."""
LEARNED = "learned.npz"
"""Name of the file with keypoints and matches of a network."""
LAST_WORDS = 500
"""Number of letters of pycolmap's last message that an error shows."""


@dataclass(frozen=True)
class FoundView:
    """A photograph with a pose."""

    rotation: np.ndarray
    """Rotation of camera_from_world, shape [3, 3]."""
    center: np.ndarray
    """Camera centre [file units], shape [3]."""
    points: int
    """Number of points that the photograph sees."""


@dataclass(frozen=True)
class FoundCamera:
    """Intrinsics that were found, of one or more photographs."""

    focal: float
    """Focal length [px of the photograph]."""
    distortion: float
    """Coefficient of the radius squared, on the plane at distance 1."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""


@dataclass(frozen=True)
class Mapping:
    """Result of structure from motion; photographs are indexed in the order of their names."""

    keypoints: tuple[int, ...]
    """Number of keypoints of each photograph."""
    matches: dict[tuple[int, int], int]
    """Number of matches that agree with one motion of the camera, by pair, the smaller index first."""
    tried: int
    """Number of pairs that were matched."""
    views: dict[int, FoundView]
    """Views of the largest model."""
    cameras: tuple[FoundCamera, ...]
    """Cameras of the views in ``views``."""
    groups: tuple[tuple[int, ...], ...]
    """Photographs of each model, the largest first: photographs of different models share too little."""
    points: int
    """Number of points of the largest model."""
    error: float
    """Mean reprojection error of the largest model's points [px of the photograph]; 0 without a model."""
    method: str
    """Mapper that made the model: incremental or global."""
    version: str
    """Version of pycolmap."""
    kept_focal: bool | None = None
    """True if the focal length of EXIF is kept, because so few photographs cannot improve it; False if it does not fit them;
    None if this was not tested."""

    @cached_property
    def links(self) -> dict[int, list[tuple[int, int]]]:
        """Photographs that each photograph matches, with the number of matches."""
        links: dict[int, list[tuple[int, int]]] = {}
        for (a, b), n in self.matches.items():
            if n > 0:
                links.setdefault(a, []).append((b, n))
                links.setdefault(b, []).append((a, n))
        return links


def check_installed() -> None:
    """Check that pycolmap is installed.

    Raises:
        UsageError: pycolmap is not installed.
    """
    if importlib.util.find_spec("pycolmap") is None:
        raise UsageError(f"finding poses needs pycolmap, which is not installed; {install_extras('poses')}")


def camera_groups(photographs: list[Photograph]) -> list[int]:
    """Return each photograph's camera number; photographs of one device, focal length and image size share a camera."""
    numbers: dict[tuple[str, float | None, int, int], int] = {}
    return [numbers.setdefault((p.device, p.focal, p.width, p.height), len(numbers)) for p in photographs]


def cameras_of(photographs: list[Photograph], groups: list[int]) -> list[Photograph]:
    """Return the first photograph of each camera, in the order of the camera numbers (``groups``, from `camera_groups`)."""
    first: dict[int, Photograph] = {}
    for number, photograph in zip(groups, photographs):
        first.setdefault(number, photograph)
    return [first[number] for number in range(len(first))]


def _job(
    photographs: list[Photograph], names: list[str], kind: str, folder: Path, threads: int, learned: bool
) -> dict[str, Any]:
    """Return the worker's input."""
    of = camera_groups(photographs)
    cameras = []
    for p in cameras_of(photographs, of):
        scale = min(1.0, MATCHING_SIDE / max(p.width, p.height))
        width, height = round(scale * p.width), round(scale * p.height)
        focal = None if p.focal is None else p.focal * max(width, height)
        cameras.append({"focal": focal, "width": width, "height": height})
    (folder / "models").mkdir()
    return {
        "names": names, "camera_of": of, "cameras": cameras, "kind": kind, "threads": threads, "exhaustive": EXHAUSTIVE,
        "sizes": [(p.width, p.height) for p in photographs], "scene_names": [p.name for p in photographs],
        # relative to the folder that the worker runs in: pycolmap takes names in UTF-8 alone
        "images": "small", "database": "matches.db", "pairs": "pairs.txt", "models": "models", "model": "model",
        "learned": LEARNED if learned else None,
    }  # fmt: skip


def _lines(job: dict[str, Any], folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the worker's messages; end the worker when the reader stops."""
    write_json(folder / JOB, job)
    try:
        for line in python_lines("warpgs.poses.worker", JOB, folder=folder, environment={"GLOG_logtostderr": "1"}):
            if line.startswith("{"):
                yield json.loads(line)
    except ProcessFailed as e:
        if disk_is_full(folder, e.errors):
            # the work folder is temporary, and its name means nothing to the user
            raise ResourceError(
                f"{folder.parents[1]}: its disk is full, so pycolmap cannot write features and matches. Free some disk space, "
                "or choose another --out"
            ) from e
        last = e.errors[-LAST_WORDS:].replace("\n", " ")
        raise ResourceError(
            f"pycolmap ended with code {e.code}; it may have had too little memory. Its last message: {last}"
        ) from e


def find_model(
    photographs: list[Photograph],
    names: list[str],
    kind: str,
    folder: Path,
    progress: Callable[[str], object],
    threads: int = 0,
    learned: bool = False,
) -> Mapping:
    """Find poses of photographs and write the model of those that fit together into ``folder``/model, in COLMAP's files.

    The same photographs give the same bits on the same machine with any number of threads, except with the global mapper.

    Args:
        photographs: The photographs, sorted by name.
        names: Names of their copies in ``folder``/small.
        kind: photographs or video.
        folder: Folder to work in.
        progress: Called with lines for the user.
        threads: CPU threads; 0 for as many as there are cores.
        learned: True if ``folder`` contains keypoints and matches of a network instead of SIFT's.

    Raises:
        ResourceError: pycolmap failed.
    """
    result: dict[str, Any] | None = None
    for said in _lines(_job(photographs, names, kind, folder, threads or usable_cores(), learned), folder):
        if "progress" in said:
            progress(said["progress"])
        result = said.get("result", result)
    if result is None:
        raise ResourceError("pycolmap ended without a result; try again, with fewer photographs if memory is short")
    index, model = (
        {n: i for i, n in enumerate(names)},
        result["model"] or {"views": {}, "cameras": {}, "points": 0, "error": 0.0},
    )
    views = {int(i): FoundView(np.array(v["rotation"]), np.array(v["center"]), v["points"]) for i, v in model["views"].items()}
    p = photographs[min(views, default=0)]
    scale = max(1.0, max(p.width, p.height) / MATCHING_SIDE)
    return Mapping(
        tuple(result["keypoints"]), {(i, j): n for i, j, n in result["pairs"]}, result["tried"], dict(sorted(views.items())),
        tuple(FoundCamera(**c) for c in model["cameras"].values()),
        tuple(tuple(sorted(index[n] for n in group)) for group in result["groups"]),
        model["points"], scale * model["error"], result["method"], result["version"], result["kept_focal"],
    )  # fmt: skip
