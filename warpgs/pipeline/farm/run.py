"""The farm of the command line: jobs, an engine, a display, and an index of the results."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

from warpgs.errors import ResourceError, UsageError
from warpgs.files import remove_leftovers, writing_into
from warpgs.pipeline.farm.engine import Engine
from warpgs.pipeline.farm.farm import JobStatus, run_farm, seconds_left
from warpgs.pipeline.farm.index import INDEX, TABLE, row_of, write_index
from warpgs.pipeline.farm.job import FarmJob
from warpgs.pipeline.farm.local import LocalEngine, local_slots
from warpgs.pipeline.runs.request import choose_device
from warpgs.report.farm_table import FarmTable
from warpgs.runtime.terminal import say

ENGINES = ("local", "ray", "slurm")
SHOW_INTERVAL = 0.2
"""Shortest time between two updates of the table [s]."""
INDEX_INTERVAL = 30.0
"""Time between two updates of the index while jobs run [s]."""


@dataclass(frozen=True)
class EngineRequest:
    """An engine and its number of concurrent jobs."""

    engine: str = "local"
    """local (processes of this machine), ray or slurm."""
    slots: int | None = None
    """Number of concurrent jobs; None: ``per_gpu`` for each GPU, one on a CPU, as many as fit into Ray's cluster, or 100 with
    Slurm."""
    per_gpu: int = 1
    """Jobs that share a GPU."""
    threads: int = 1
    """CPU threads of a job of ray or slurm."""
    minutes: int = 240
    """Time after which slurm ends a job [min]."""
    partition: str | None = None
    """Slurm's partition."""
    slurm_folder: Path | None = None
    """Private folder for Slurm's job files; None for one in the user's cache."""


def make_engine(request: EngineRequest, device: str) -> Engine:
    """Make the engine that is requested.

    Raises:
        ResourceError: The device is missing, the cluster cannot be reached, or Slurm's private folder cannot be written.
        UsageError: The engine is unknown or not installed, has fewer slots than requested, or other users can write to
            ``slurm_folder``.
    """
    r = request
    if r.engine not in ENGINES:
        raise UsageError(f"--engine {r.engine!r} is not one of {', '.join(ENGINES)}")
    if r.engine == "local":
        return LocalEngine(local_slots(device, r.slots, r.per_gpu))
    if min(1 if r.slots is None else r.slots, r.per_gpu, r.threads, r.minutes) < 1:
        raise UsageError("--slots, --per-gpu, --threads and --minutes must be at least 1")
    if r.engine == "ray":
        from warpgs.pipeline.farm.ray import RayEngine

        return RayEngine(choose_device(device)[0].type, r.slots, r.per_gpu, r.threads)
    from warpgs.pipeline.farm.slurm import SlurmEngine

    kind = choose_device(device)[0].type if device == "auto" else device
    return SlurmEngine(kind, r.slots, r.threads, r.minutes, r.partition, r.slurm_folder)


def run_and_show(jobs: list[FarmJob], engine: Engine, results: Path, *, live: bool | None = None) -> list[JobStatus]:
    """Run a farm, show its progress, and write its index.

    Args:
        jobs: The jobs, with folders below ``results``.
        engine: Engine that runs the jobs; it is closed at the end.
        results: Folder of the results.
        live: As in `FarmTable`.

    Returns:
        The status of each job.

    Raises:
        ResourceError: The folder cannot be written, or no job could be started.
    """
    began = time.monotonic()
    shown = written = began - INDEX_INTERVAL
    count = f"{len(jobs)} job{'' if len(jobs) == 1 else 's'}"
    say(f"{count}, engine {engine.name}, {engine.slots} at a time; results: {results / INDEX}, {TABLE}")
    try:
        with writing_into(results), FarmTable(live=live) as table:
            remove_leftovers(results)  # of a farm that was killed while it wrote its index

            def show(statuses: list[JobStatus]) -> None:
                nonlocal shown, written
                if time.monotonic() - shown < SHOW_INTERVAL:
                    return
                table.update([row_of(s) for s in statuses], seconds_left(statuses, engine.slots))
                shown = time.monotonic()
                if shown - written >= INDEX_INTERVAL:
                    write_index(results, statuses, shown - began)
                    written = shown

            statuses = run_farm(jobs, engine, show)
            table.update([row_of(s) for s in statuses], None)
            write_index(results, statuses, time.monotonic() - began)
            return statuses
    except KeyboardInterrupt:
        say("repeat the command to continue: finished jobs are kept, and interrupted jobs continue")
        raise
    finally:
        engine.close()


def check_failures(statuses: list[JobStatus]) -> None:
    """Check that no job failed.

    Raises:
        ResourceError: A job failed; the message names up to five failed jobs.
    """
    failed = [s for s in statuses if s.state == "failed"]
    if failed:
        first = failed[0].record
        names = ", ".join(s.job.name for s in failed[:5]) + ("" if len(failed) <= 5 else f" and {len(failed) - 5} more")
        raise ResourceError(
            f"{len(failed)} of {len(statuses)} jobs failed: {names}; {INDEX} has their messages. First message: "
            f"{first.message.rstrip('.') if first else 'unknown'}. Repeat the command to try them again"
        )
