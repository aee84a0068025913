"""The record of a job: job.json in the job's folder holds the state, and checksums to verify that the results are complete."""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import asdict, dataclass, field
from pathlib import Path

from warpgs import schema
from warpgs.errors import ResourceError
from warpgs.files import write_json
from warpgs.input_files import input_digest, unread_reason
from warpgs.pipeline.farm.job import FarmJob
from warpgs.pipeline.runs.folder import CONFIG
from warpgs.version import __version__

RECORD = "job.json"
LOG = "log.txt"
"""Name of the file with the output of a job."""
THUMBNAIL = "thumbnail.jpg"
PLY = "point_cloud.ply"
CHECKED = (PLY, "metrics.json", CONFIG)
"""Files of a run with a checksum in the record."""
FORMAT = 1
MOST_FILES = 100_000
"""Largest number of files and folders of a scene to list. Changes of a larger scene are detected only when a fit reads it."""

_DIGEST = schema.text
_SCHEMA = schema.fields(
    {
        "name": schema.text, "identity": schema.text, "state": schema.one_of("done", "failed"), "how": schema.text,
        "message": schema.text, "again": schema.flag, "source": schema.text, "seconds": schema.number(0),
        "psnr": schema.or_null(schema.real), "ssim": schema.or_null(schema.real), "gaussians": schema.whole(0),
        "steps": schema.whole(0), "ply_bytes": schema.whole(0), "files": schema.mapping(_DIGEST), "version": schema.text,
        "format": schema.one_of(FORMAT),
    },
    others=False,
)  # fmt: skip


@dataclass(frozen=True)
class JobRecord:
    """Outcome of a job."""

    name: str
    identity: str
    """Digest of the job, `FarmJob.identity`."""
    state: str
    """done or failed."""
    how: str = ""
    """kept, continued, fitted or redone."""
    message: str = ""
    """Error of a failed job, or a note on a finished one."""
    again: bool = False
    """True if a failed job may succeed when it is repeated."""
    source: str = ""
    """SHA-256 of the scene's file names, sizes and times; empty if unknown."""
    seconds: float = 0.0
    """Wall time of the job, reading and scores included [s]."""
    psnr: float | None = None
    """Mean PSNR over held-out views [dB]; None without held-out views."""
    ssim: float | None = None
    """Mean SSIM over held-out views."""
    gaussians: int = 0
    steps: int = 0
    ply_bytes: int = 0
    """Size of the PLY file."""
    files: dict[str, str] = field(default_factory=dict)
    """SHA-256 of files by their names in the run folder."""
    version: str = __version__
    """Version of warpgs."""
    format: int = FORMAT


def write_record(folder: Path, record: JobRecord) -> None:
    """Write the record of a job.

    Raises:
        ResourceError: The record cannot be written.
    """
    write_json(folder / RECORD, asdict(record))


def read_record(folder: Path) -> JobRecord | None:
    """Read the record of a job; None if it is missing or incomplete."""
    try:
        values = schema.read(folder / RECORD, folder)
        _SCHEMA(values, "")
    except (OSError, schema.SchemaError):
        return None
    return JobRecord(**values)


def file_digest(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal digits.

    Raises:
        ResourceError: The file cannot be read.
    """
    try:
        return input_digest(path, path.parent)
    except OSError as e:
        raise ResourceError(f"{path}: cannot be read ({unread_reason(e)}); check the disk, and fit the scene again") from e


def source_stamp(scene: Path) -> str:
    """Return the SHA-256 of the names, sizes and times of a scene's files; empty if they cannot be listed or are too many."""
    rows = []
    try:
        if scene.is_file():
            found = scene.stat()
            rows.append((scene.name, found.st_size, found.st_mtime_ns))
        for count, (folder, _, names) in enumerate(os.walk(scene, followlinks=True)):
            if count > MOST_FILES:  # links may show a folder in many places
                return ""
            for name in names:
                path = Path(folder, name)
                found = path.stat()
                rows.append((path.relative_to(scene).as_posix(), found.st_size, found.st_mtime_ns))
                if len(rows) > MOST_FILES:
                    return ""
    except OSError:  # the fit reports the error
        return ""
    return hashlib.sha256(json.dumps(sorted(rows)).encode()).hexdigest() if rows else ""


def is_whole(folder: Path, record: JobRecord) -> bool:
    """Return whether the files of a finished run match the checksums of its record."""
    try:
        return set(record.files) == set(CHECKED) and all(file_digest(folder / n) == d for n, d in record.files.items())
    except ResourceError:
        return False


def finished(job: FarmJob) -> JobRecord | None:
    """Return the record of a job that is finished and valid: same scene, settings and version, and intact files; else None."""
    record = read_record(job.folder)
    if record is None or record.state != "done" or record.identity != job.identity() or record.version != __version__:
        return None
    if not record.source or record.source != source_stamp(Path(job.request.scene.path)):
        return None
    return record if is_whole(job.request.out, record) else None
