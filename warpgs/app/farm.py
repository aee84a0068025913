"""`warpgs farm`: fit many scenes. Parses, calls, prints; no logic."""

import dataclasses
from pathlib import Path
from typing import Annotated, Literal

from warpgs.app.fit import request_of, tell_preset
from warpgs.app.flags import call
from warpgs.errors import UsageError
from warpgs.pipeline.farm.job import FARM_FLAGS, FarmJob, ListedJob, list_jobs
from warpgs.schema import Within

OWN = ("engine", "slots", "per-gpu", "threads", "minutes", "partition", "slurm-folder", "out", "help", "help-all")
"""Flags of the farm itself; all others are those of `warpgs fit`."""
SWITCHES = ("help", "help-all")
"""Flags of the farm that take no value."""
MORE = "Every job takes the flags of `warpgs fit`, but not --resume, --view, --view-port and --time-budget."


def run(arguments: list[str], about: str) -> int:
    """Run the command; ``about`` describes it in its help."""
    from tyro.conf import Positional

    from warpgs.pipeline.farm.farm import check_failures, make_engine, run_and_show

    own, shared = _divided(arguments)

    def farm(
        jobs: Positional[str], *, out: Path, engine: Literal["local", "ray", "slurm"] = "local",
        slots: Annotated[int | None, Within(1)] = None, per_gpu: Annotated[int, Within(1)] = 1,
        threads: Annotated[int, Within(1)] = 1, minutes: Annotated[int, Within(1)] = 240, partition: str | None = None,
        slurm_folder: Path | None = None,
    ) -> None:  # fmt: skip
        """Fit many scenes.

        Args:
            jobs: Folder of scenes, a glob in quotes, or a .jsonl file: {"scene": FOLDER, "steps": 500} per line, with any flags
                of `warpgs fit`. Place this argument before switches of `warpgs fit`, such as --strict.
            out: Folder of the results. Repeat the command to continue; start it on several machines to share the work.
            engine: local (processes of this machine), ray or slurm.
            slots: Number of concurrent jobs. Default: --per-gpu times the number of GPUs; on a CPU, 1; on a cluster, its
                capacity.
            per_gpu: Jobs that share a GPU.
            threads: CPU threads of a job with ray or slurm; local jobs share all cores.
            minutes: Time after which slurm ends a job [min].
            partition: Slurm's partition.
            slurm_folder: Folder for slurm's job files, private and visible to all nodes. Default: ~/.cache/warpgs/slurm.
        """
        requested = jobs_of(list_jobs(jobs), shared, out)
        tell_preset(shared, requested[0].request.config)
        place = make_engine(
            requested[0].request.device, engine, slots=slots, per_gpu=per_gpu, threads=threads, minutes=minutes,
            partition=partition, slurm_folder=slurm_folder,
        )  # fmt: skip
        check_failures(run_and_show(requested, place, out))

    call(farm, own, "warpgs farm", f"{about}\n\n{MORE}")
    return 0


def _divided(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Divide the arguments of a command line into those of the farm and those of every fit."""
    own, shared = list[str](), list[str]()
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


def jobs_of(listed: list[ListedJob], shared: list[str], out: Path) -> list[FarmJob]:
    """Return the jobs, each with settings from the shared arguments and from its own arguments."""
    requests: dict = {}
    jobs = []
    for name, scene, flags in listed:
        if flags not in requests:
            try:
                requests[flags] = request_of(["SCENE", "--out", "RUN", *shared, *flags], "")
            except UsageError as e:
                if not flags:
                    raise
                raise UsageError(f"job {name}: {e}") from e
        request, folder = requests[flags], out / name
        read = dataclasses.replace(request.scene, path=str(scene))
        jobs.append(FarmJob(name, dataclasses.replace(request, scene=read, out=folder / "run"), folder, out))
    return jobs
