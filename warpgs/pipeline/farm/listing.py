"""Lists of jobs: a folder of scenes, a glob, or a file with a line of JSON for each job."""

from __future__ import annotations

import glob
import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from warpgs import schema
from warpgs.errors import DataError, UsageError
from warpgs.input_files import read_input, unread_reason
from warpgs.io.readers import all_readers

NAME = re.compile(r"(?:[^\W_]|[\udc80-\udcff])[^/\\:*?\"<>|\x00-\x1f]{0,99}")
"""Pattern of a job's name: a valid folder name on any system. Bytes that are not text are allowed, as folders may have them."""
MOST_BYTES = 200
"""Longest name of a job [bytes]: file systems allow 255, and longer names such as NAME.old1 must fit, too."""
OWN_FILES = ("index.html", "results.csv")
"""Names in a results folder that do not belong to a job."""
PLUGINS = ("preset", "strategy", "loss-terms", "view-modules", "reader")
"""Flags that can name code; in a file of jobs they may only name code of warpgs."""
FARM_FLAGS = (
    "out", "resume", "view", "view-port", "device", "threads", "time-budget", "allow-outside", "help", "help-all", "h",
)  # fmt: skip
"""Flags of `warpgs fit` that a single job may not set."""


@dataclass(frozen=True)
class ListedJob:
    """A scene to fit, and the job's flags in addition to those of all jobs."""

    name: str
    """Name, unique in the farm; the folder of its results."""
    scene: Path
    """Folder of the scene, or a video."""
    flags: tuple[str, ...] = ()
    """Arguments of `warpgs fit`."""


def list_jobs(jobs: str) -> list[ListedJob]:
    """List the jobs of a folder of scenes, a glob, or a .jsonl file, by name or in the order of the file.

    Raises:
        DataError: A line of the file is not a job, or a name is not valid for a folder.
        UsageError: There is nothing to fit, the folder is a single scene, or two jobs have the same name.
    """
    path = Path(jobs)
    if path.is_dir():
        if any(r.probe(path) is not None for r in all_readers()):
            raise UsageError(f"{jobs} is a single scene: fit it with `warpgs fit`, or give its parent folder")
        found = _named(sorted(p for p in path.iterdir() if p.is_dir() and not p.name.startswith(".")))
    elif path.suffix == ".jsonl":
        found = _read(path)
    else:
        found = _named(sorted(Path(p) for p in glob.glob(jobs)))
    if not found:
        raise UsageError(f"{jobs}: no scene found; give a folder of scenes, a glob in quotes, or a .jsonl file")
    taken: dict[str, ListedJob] = {}
    for job in found:
        if not NAME.fullmatch(job.name) or job.name.endswith((".", " ")) or job.name in OWN_FILES:
            raise DataError(
                f"{jobs}: {job.name[:100]!r} is not a valid name for a job and its folder; give another name in a .jsonl file"
            )
        if (size := len(os.fsencode(job.name))) > MOST_BYTES:
            raise DataError(
                f"{jobs}: {job.name[:100]!r} has {size} bytes, but a job's name may have at most {MOST_BYTES}; give another "
                "name in a .jsonl file"
            )
        if job.name.casefold() in taken:
            raise UsageError(f"{jobs}: two jobs have the name {job.name!r}; give each line of a .jsonl file its own name")
        taken[job.name.casefold()] = job
    return found


def _named(scenes: list[Path]) -> list[ListedJob]:
    """Name scenes by their folders; if two folders have the same name, by their paths below the common folder."""
    scenes = [Path(os.path.abspath(s)) for s in scenes]
    if len({s.name.casefold() for s in scenes}) == len(scenes):
        return [ListedJob(s.name, s) for s in scenes]
    above = os.path.commonpath(scenes)
    return [ListedJob("-".join(s.relative_to(above).parts), s) for s in scenes]


def _read(path: Path) -> list[ListedJob]:
    """Read a file of jobs: ``{"scene": FOLDER}`` per line, optionally with a ``name`` and flags of `warpgs fit`."""
    try:
        data = read_input(path, schema.MAX_BYTES)
    except OSError as e:
        raise DataError(
            f"{path}: cannot be read ({unread_reason(e)}); give a file with one line of JSON per job, and split a large one"
        ) from e
    found = []
    for number, line in enumerate(data.splitlines(), 1):
        if line.strip():
            try:
                found.append(_job(schema.parse(line), path.parent))
            except schema.SchemaError as e:
                raise DataError(f'{path}, line {number}: {e}; write {{"scene": FOLDER, "steps": 500}}') from e
    return found


_LINE = schema.fields({"scene": schema.text}, {"name": schema.text})


def _job(values: Any, folder: Path) -> ListedJob:
    """Return the job of a line; SchemaError if it is not a job."""
    _LINE(values, "")
    scene = Path(os.path.abspath(folder / values["scene"]))
    flags = [word for key, value in values.items() if key not in ("scene", "name") for word in _flag(key, value)]
    return ListedJob(values.get("name", scene.name), scene, tuple(flags))


def _flag(key: str, value: Any) -> list[str]:
    """Return a setting of a line as arguments of a command line."""
    name = key.replace("_", "-")
    if not re.fullmatch(r"[a-zA-Z][a-zA-Z0-9.-]{0,99}", name) or name in FARM_FLAGS:
        raise schema.SchemaError(f"{key[:40]!r} cannot be set for a single job")
    if isinstance(value, bool):
        group, dot, last = name.rpartition(".")
        return [f"--{name}" if value else f"--{group}{dot}no-{last}"]
    if not isinstance(value, (str, int, float)):
        raise schema.SchemaError(f"{key[:40]} must be text, a number, true or false")
    schema.text(str(value), key[:40])
    if name in PLUGINS and ":" in str(value):
        raise schema.SchemaError(f"{key} names user code; give it as --{name} on the command line of the farm")
    return [f"--{name}={value}"]
