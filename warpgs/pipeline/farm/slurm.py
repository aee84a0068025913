"""The engine for clusters that Slurm runs: a job of Slurm for each scene, by submitit. Extra `slurm`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from warpgs.errors import UsageError
from warpgs.pipeline.farm.engine import Event
from warpgs.pipeline.farm.job import FarmJob, job_text
from warpgs.pipeline.farm.work import run_job

QUEUED = 100
"""Jobs that are handed to Slurm at a time, where nothing else is asked for."""
ASK_EVERY = 1.0
"""Time between two looks at the jobs [s]."""


class SlurmEngine:
    """Hands each job to Slurm; its scripts and the output of its processes lie in a folder of the results."""

    name = "slurm"

    def __init__(
        self,
        folder: Path,
        device: str,
        slots: int | None,
        threads: int = 1,
        minutes: int = 240,
        partition: str | None = None,
        local: bool = False,
    ):
        """Look for Slurm.

        Args:
            folder: Folder for scripts and output, on a file system that the machines of the cluster share.
            device: cpu or cuda.
            slots: Jobs that are queued or running at a time; None for 100.
            threads: CPU threads of a job.
            minutes: Time after which Slurm ends a job [min].
            partition: Slurm's partition; None for its default.
            local: Run jobs as processes of this machine, without Slurm: to try it.

        Raises:
            UsageError: submitit is not installed, or there is no Slurm here.
        """
        try:
            import submitit
        except ImportError as e:
            raise UsageError("--engine slurm needs submitit: pip install 'warpgs[slurm]'") from e
        try:
            self._executor = submitit.AutoExecutor(folder=folder, cluster="local" if local else "slurm")
        except RuntimeError as e:
            raise UsageError(f"--engine slurm: {e}; call it where sbatch is, or try it with --slurm-local") from e
        self.slots, self._threads = slots or (1 if local else QUEUED), threads
        more = {} if local or partition is None else {"slurm_partition": partition}
        gpus = 1 if device == "cuda" else 0
        self._executor.update_parameters(timeout_min=minutes, cpus_per_task=threads, gpus_per_node=gpus, name="warpgs", **more)
        self._running: dict[str, Any] = {}

    def start(self, job: FarmJob) -> None:
        """Hand a job to Slurm."""
        self._running[job.name] = self._executor.submit(run_job, job_text(job), self._threads)

    def wait(self, seconds: float) -> list[Event]:
        """Return the jobs that have ended; asks once a second."""
        last = time.monotonic() + seconds
        while True:
            ended = [name for name, job in self._running.items() if job.done()]
            if ended or time.monotonic() >= last:
                return [self._event(name, self._running.pop(name)) for name in ended]
            time.sleep(min(ASK_EVERY, seconds))

    def _event(self, name: str, job: Any) -> Event:
        error = job.exception()
        if error is None:
            return Event(name, job.result())
        return Event(name, "crashed", str(error).strip().splitlines()[-1])

    def close(self) -> None:
        """End what runs or is queued."""
        for job in self._running.values():
            job.cancel()
