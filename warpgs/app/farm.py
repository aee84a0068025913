"""`warpgs farm`: fit many scenes. Parses, calls, prints; no logic."""

import dataclasses
from dataclasses import dataclass
from pathlib import Path

from warpgs.app.fit import request_of
from warpgs.app.flags import parse_flags
from warpgs.errors import UsageError
from warpgs.pipeline.farm.job import FARM_FLAGS, ListedJob

OWN = ("engine", "slots", "per-gpu", "threads", "minutes", "partition", "slurm-folder", "out", "help", "help-all")
"""Flags of the farm itself; all others are those of `warpgs fit`."""
SWITCHES = ("help", "help-all")
"""Flags of the farm that take no value."""


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    import tyro

    from warpgs.pipeline.farm.farm import EngineRequest, check_failures, make_engine, run_and_show

    own, shared = _divided(arguments)

    @dataclass(frozen=True, kw_only=True)
    class Farm:
        jobs: tyro.conf.Positional[str]
        """Folder of scenes, a glob in quotes, or a .jsonl file: {"scene": FOLDER, "steps": 500} per line, with any flags of
        `warpgs fit`. Place this argument before switches of `warpgs fit`, such as --strict."""
        out: Path
        """Folder of the results. Repeat the command to continue; start it on several machines to share the work."""
        engine: str = "local"
        """local (processes of this machine), ray or slurm."""
        slots: int | None = None
        """Number of concurrent jobs. Default: --per-gpu times the number of GPUs; on a CPU, 1; on a cluster, its capacity."""
        per_gpu: int = 1
        """Jobs that share a GPU."""
        threads: int = 1
        """CPU threads of a job with ray or slurm; local jobs share all cores."""
        minutes: int = 240
        """Time after which slurm ends a job [min]."""
        partition: str | None = None
        """Slurm's partition."""
        slurm_folder: Path | None = None
        """Folder for slurm's job files, private and visible to all nodes. Default: ~/.cache/warpgs/slurm."""

    more = (
        "Every job takes the flags of `warpgs fit`, such as --preset, --split, --steps and --device, but not --resume, --view, "
        "--view-port and --time-budget."
    )
    a = parse_flags(Farm, own, "warpgs farm", f"{about}\n\n{more}")
    from warpgs.pipeline.farm.job import list_jobs

    jobs = _jobs(list_jobs(a.jobs), shared, a.out)
    names = [f.name for f in dataclasses.fields(EngineRequest)]
    engine = make_engine(EngineRequest(**{n: getattr(a, n) for n in names}), jobs[0].request.device)
    check_failures(run_and_show(jobs, engine, a.out))
    return 0


def _divided(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Divide the arguments of a command line into those of the farm and those of every fit."""
    own: list[str] = []
    shared: list[str] = []
    target = own
    for word in arguments:
        flag, given, _ = word.removeprefix("--").partition("=")
        name = flag.replace("_", "-")
        if not word.startswith("--"):
            target.append(word)  # the value of the flag before it, or the jobs
            target = own
            continue
        if name in FARM_FLAGS and name not in (*OWN, "device", "allow-outside"):
            raise UsageError(f"--{name} is not supported by farm; leave it out")
        group = own if name in OWN else shared
        group.append(word)
        target = own if given or name in SWITCHES else group
    return own, shared


def _jobs(listed: list[ListedJob], shared: list[str], out: Path) -> list:
    """Return the jobs, each with settings from the shared arguments and from its own arguments."""
    from warpgs.pipeline.farm.job import FarmJob

    requests: dict = {}
    jobs = []
    for job in listed:
        if job.flags not in requests:
            try:
                requests[job.flags] = request_of(["SCENE", "--out", "RUN", *shared, *job.flags], "")
            except UsageError as e:
                if not job.flags:
                    raise
                raise UsageError(f"job {job.name}: {e}") from e
        request, folder = requests[job.flags], out / job.name
        scene = dataclasses.replace(request.scene, path=str(job.scene))
        jobs.append(FarmJob(job.name, dataclasses.replace(request, scene=scene, out=folder / "run"), folder, out))
    return jobs
