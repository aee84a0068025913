"""A job of a farm: its description, the list that it comes from, its record, and the interface of an engine."""

import glob
import hashlib
import json
import os
import re
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol, get_type_hints

from warpgs import schema
from warpgs.errors import DataError, UsageError, expect, explained
from warpgs.files import input_digest, read_file, write_json
from warpgs.io.folder import READERS, all_readers
from warpgs.pipeline.run.folder import CONFIG
from warpgs.pipeline.run.request import FitRequest, SceneRequest
from warpgs.pipeline.train.loss import LOSS_TERMS
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.pipeline.train.view_modules import VIEW_MODULES
from warpgs.plugins import module_of, own_places
from warpgs.version import __version__


@dataclass(frozen=True)
class FarmJob:
    """A fit that an engine runs."""

    name: str
    """Name, unique in the farm."""
    request: FitRequest
    """The fit; ``out`` is its run folder."""
    folder: Path
    """Folder of the job's record, log and thumbnail, which is locked while a farm works on it."""
    results: Path
    """Folder of all results, which contains ``folder``; links below it are not followed."""

    def identity(self) -> str:
        """Return an identifier of all inputs except the images: the first 16 hexadecimal digits of their SHA-256."""
        r = self.request
        values = [asdict(r.scene), r.config.to_json(), None if r.lpips_weights is None else str(r.lpips_weights), r.device]
        values += [own] if (own := r.config.own_code()) else []
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()[:16]

    def text(self) -> str:
        """Return the job as one line of JSON."""
        r = self.request
        return json.dumps({
            "name": self.name, "folder": str(self.folder.absolute()), "results": str(self.results.absolute()),
            "scene": asdict(r.scene), "out": str(r.out.absolute()), "config": r.config.to_json(), "device": r.device,
            "lpips_weights": None if r.lpips_weights is None else str(r.lpips_weights.resolve()), "notes": r.notes,
            "own_code": own_places(r.config.plugged_in()),
        })  # fmt: skip


def job_of(text: str) -> FarmJob:
    """Return the job of `FarmJob.text`; user code that the job names is imported, as in the process that wrote the text."""
    v = schema.parse(text)
    scene, config = SceneRequest(**v["scene"]), v["config"]
    if scene.reader is not None:
        READERS.load(scene.reader)
    for place in v["own_code"]:  # a class of a preset's file cannot be imported by its name
        fix = "put it where all processes can import it"
        with explained(f"your code {place} cannot be imported", fix, (ImportError, OSError), UsageError):
            module_of(place)
    STRATEGIES.load(config["strategy"])
    for registry, key in ((LOSS_TERMS, "loss_terms"), (VIEW_MODULES, "view_modules")):
        for part in config[key]:
            registry.load(part["name"])
    weights = None if v["lpips_weights"] is None else Path(v["lpips_weights"])
    fit = scene, Path(v["out"]), FitConfig.from_json(config), v["device"]
    request = FitRequest(*fit, lpips_weights=weights, notes=tuple(v["notes"]))
    return FarmJob(v["name"], request, Path(v["folder"]), Path(v["results"]))


Event = tuple[str, str, str | int]
"""A change of a job: its name; its state: running, or at its end done, failed, held (another process works on it) or crashed
(its process ended); and the number of steps done, or the reason of a crash."""


class Engine(Protocol):
    """A place where jobs run."""

    name: str
    """Name shown to the user."""
    slots: int
    """Largest number of jobs that run at a time."""

    def start(self, job: FarmJob) -> None:
        """Start a job; called while fewer than `slots` jobs run."""

    def wait(self, seconds: float) -> list[Event]:
        """Return new events, after at most ``seconds`` [s]."""

    def close(self) -> None:
        """Stop all jobs. A fit saves its state if it can, and the next farm continues it."""


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


ListedJob = tuple[str, Path, tuple[str, ...]]
"""Name, unique in the farm, which is also that of the folder of results; folder of the scene, or a video; flags of `warpgs fit`
in addition to those of all jobs."""


def list_jobs(jobs: str) -> list[ListedJob]:
    """List the jobs of a folder of scenes, a glob, or a .jsonl file, by name or in the order of the file."""
    if (path := Path(jobs)).is_dir():
        if any(r.probe(path) is not None for r in all_readers()):
            raise UsageError(f"{jobs} is a single scene: fit it with `warpgs fit`, or give its parent folder")
        found = _named(sorted(p for p in path.iterdir() if p.is_dir() and not p.name.startswith(".")))
    else:
        found = _read(path) if path.suffix == ".jsonl" else _named(sorted(Path(p) for p in glob.glob(jobs)))
    if not found:
        raise UsageError(f"{jobs}: no scene found; give a folder of scenes, a glob in quotes, or a .jsonl file")
    taken: set[str] = set()
    for name, _, _ in found:
        long = len(os.fsencode(name)) > MOST_BYTES
        if long or not NAME.fullmatch(name) or name.endswith((".", " ")) or name in OWN_FILES:
            wrong = f"is not a valid name for a job and its folder, which may have {MOST_BYTES} bytes"
            raise DataError(f"{jobs}: {name[:100]!r} {wrong}; give another name in a .jsonl file")
        if name.casefold() in taken:
            raise UsageError(f"{jobs}: two jobs have the name {name!r}; give each line of a .jsonl file its own name")
        taken.add(name.casefold())
    return found


def _named(scenes: list[Path]) -> list[ListedJob]:
    """Name scenes by their folders; if two folders have the same name, by their paths below the common folder."""
    scenes = [Path(os.path.abspath(s)) for s in scenes]
    if len({s.name.casefold() for s in scenes}) == len(scenes):
        return [(s.name, s, ()) for s in scenes]
    above = os.path.commonpath(scenes)
    return [("-".join(s.relative_to(above).parts), s, ()) for s in scenes]


def _read(path: Path) -> list[ListedJob]:
    """Read a file of jobs: ``{"scene": FOLDER}`` per line, optionally with a ``name`` and flags of `warpgs fit`."""
    data = read_file(path, most=schema.MAX_BYTES, fix="give a file with one line of JSON per job, and split a large one")
    found: list[ListedJob] = []
    for number, line in enumerate(data.splitlines(), 1):
        if not line.strip():
            continue
        with explained(f"{path}, line {number}: not a job", 'write {"scene": FOLDER, "steps": 500}', schema.SchemaError):
            values = schema.parse(line)
            _LINE(values, "")
            scene = Path(os.path.abspath(path.parent / values.pop("scene")))
            found.append((values.pop("name", scene.name), scene, tuple(_flag(key, value) for key, value in values.items())))
    return found


_LINE = schema.fields({"scene": schema.text}, {"name": schema.text})


def _flag(key: str, value: Any) -> str:
    """Return a setting of a line as an argument of a command line."""
    name = key.replace("_", "-")
    own = re.fullmatch(r"[a-zA-Z][a-zA-Z0-9.-]{0,99}", name) and name not in FARM_FLAGS
    expect(own, f"{key[:40]!r} cannot be set for a single job")
    if isinstance(value, bool):
        group, dot, last = name.rpartition(".")
        return f"--{name}" if value else f"--{group}{dot}no-{last}"
    expect(isinstance(value, (str, int, float)), f"{key[:40]} must be text, a number, true or false")
    schema.text(str(value), key[:40])
    code = name in PLUGINS and ":" in str(value)
    expect(not code, f"{key} names user code; give it as --{name} on the command line of the farm")
    return f"--{name}={value}"


RECORD = "job.json"
LOG = "log.txt"
"""Name of the file with the output of a job."""
THUMBNAIL = "thumbnail.webp"
PLY = "point_cloud.ply"
CHECKED = (PLY, "metrics.json", CONFIG)
"""Files of a run with a checksum in the record."""
FORMAT = 1
MOST_FILES = 100_000
"""Largest number of files and folders of a scene to list. Changes of a larger scene are detected only when a fit reads it."""


@dataclass(frozen=True)
class JobRecord:
    """Outcome of a job."""

    name: str
    identity: str
    """Digest of the job, `FarmJob.identity`."""
    state: str
    """done or failed; in a table also waiting, running, or elsewhere (another farm works on it)."""
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


_SCHEMA = schema.fields(
    {name: schema.of_type(hint) for name, hint in get_type_hints(JobRecord).items()}
    | {"state": schema.one_of("done", "failed"), "files": schema.mapping(schema.text), "format": schema.one_of(FORMAT)}
    | dict.fromkeys(("psnr", "ssim"), schema.or_null(schema.real)),
    others=False,
)


def write_record(folder: Path, record: JobRecord) -> None:
    """Write the record of a job."""
    write_json(folder / RECORD, asdict(record))


def read_job_record(folder: Path) -> JobRecord | None:
    """Read the record of a job; None if it is missing or incomplete."""
    try:
        return JobRecord(**schema.read(folder / RECORD, folder, _SCHEMA))
    except (OSError, schema.SchemaError):
        return None


def source_stamp(scene: Path) -> str:
    """Return the SHA-256 of the names, sizes and times of a scene's files; empty if they cannot be listed or are too many."""
    paths = [scene] if scene.is_file() else []
    for count, (folder, _, names) in enumerate(os.walk(scene, followlinks=True)):
        paths += [Path(folder, name) for name in names]
        if max(count, len(paths)) > MOST_FILES:  # links may show a folder in many places
            return ""
    try:
        found = [(p, p.stat()) for p in paths]
    except OSError:  # the fit reports the error
        return ""
    above = scene.parent if scene.is_file() else scene
    rows = sorted((p.relative_to(above).as_posix(), s.st_size, s.st_mtime_ns) for p, s in found)
    return hashlib.sha256(json.dumps(rows).encode()).hexdigest() if rows else ""


def is_whole(folder: Path, record: JobRecord) -> bool:
    """Return whether the files of a finished run match the checksums of its record."""
    try:
        return set(record.files) == set(CHECKED) and all(input_digest(folder / n, folder) == d for n, d in record.files.items())
    except DataError:
        return False


def finished(job: FarmJob) -> JobRecord | None:
    """Return the record of a job that is finished and valid: same scene, settings and version, and intact files; else None."""
    record = read_job_record(job.folder)
    if record is None or record.state != "done" or record.identity != job.identity() or record.version != __version__:
        return None
    if not record.source or record.source != source_stamp(Path(job.request.scene.path)):
        return None
    return record if is_whole(job.request.out, record) else None
