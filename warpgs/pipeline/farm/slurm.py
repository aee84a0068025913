"""Farms on Slurm: a Slurm job for each scene, by sbatch, squeue and scancel; each runs this module."""

import contextlib
import itertools
import os
import shlex
import shutil
import sys
import time
from pathlib import Path

from warpgs.errors import ResourceError, UsageError, WarpgsError
from warpgs.files import write_text
from warpgs.locks import private_shared_folder
from warpgs.pipeline.farm.job import Event, FarmJob
from warpgs.pipeline.farm.work import run_job
from warpgs.process import interrupting_signals, run_program, say

# A job is sent to its node as JSON, and its state comes back as one word, both in a private folder. All other results
# are in the job's record.

QUEUED = 100
"""Default number of jobs that Slurm has at a time."""
ASK_EVERY = 1.0
"""Time between two checks for answers of jobs [s]."""
QUEUE_EVERY = 15.0
"""Time between two calls of squeue, which lists all jobs [s]."""
MISSED = 3
"""A job is taken as ended if this many calls of squeue in a row do not list it: a network file system may show the job's answer
late."""
NAME = "warpgs"
SUFFIXES = (".json", ".answer", ".log")
"""Suffixes of the files of a job in the private folder: its description, its answer, its output."""
SECONDS_TO_SAVE = 120
"""Time before the end of a job's time limit at which Slurm interrupts the job, so that the fit saves its state [s]."""
PATIENCE = 60.0
"""Time limit of a command of Slurm [s]."""


class SlurmEngine:
    """Hands each job to Slurm."""

    name = "slurm"

    def __init__(self, device: str, slots: int | None, threads: int, minutes: int, partition: str | None, folder: Path | None):
        """Look for Slurm, and make a private folder."""
        if missing := [p for p in ("sbatch", "squeue", "scancel") if shutil.which(p) is None]:
            raise UsageError(f"--engine slurm needs Slurm's {', '.join(missing)}: run warpgs on a machine of the cluster")
        self.slots, self._threads = slots or QUEUED, threads
        self._options = [
            f"--job-name={NAME}", f"--time={minutes}", "--ntasks=1", f"--cpus-per-task={threads}", "--open-mode=append",
            f"--signal=B:INT@{SECONDS_TO_SAVE}",
        ]  # fmt: skip
        self._options += ["--gpus-per-node=1"] if device == "cuda" else []
        self._options += [] if partition is None else [f"--partition={partition}"]
        self._stack = contextlib.ExitStack()
        self._folder = self._stack.enter_context(private_shared_folder(folder))
        self._numbers = itertools.count()
        self._running: dict[str, tuple[str, Path]] = {}
        """Slurm's identifier, and the path of the files in the private folder without their suffix, by job."""
        self._missed: dict[str, int] = {}
        """Number of calls of squeue in a row that did not list a job."""
        self._asked, self._told = float("-inf"), False

    def start(self, job: FarmJob) -> None:
        """Hand a job to Slurm."""
        base = self._folder / str(next(self._numbers))
        text, answer, log = (base.with_suffix(s) for s in SUFFIXES)
        write_text(text, job.text())
        command = [sys.executable, "-P", "-m", "warpgs.pipeline.farm.slurm", str(text), str(answer), str(self._threads)]
        script = f"#!/bin/sh\nexec {shlex.join(command)}\n"
        code, output, errors = _call("sbatch", "--parsable", *self._options, f"--output={log}", script=script)
        slurm_id = output.strip().partition(";")[0]
        if code or not slurm_id.isdecimal():
            raise ResourceError(f"sbatch rejected job {job.name}: {_last_line(errors + output)}")
        self._running[job.name], self._missed[job.name] = (slurm_id, base), 0

    def wait(self, seconds: float) -> list[Event]:
        """Return the jobs that have ended; answer files are checked once a second, and squeue is called four times a minute."""
        last = time.monotonic() + seconds
        while not (ended := self._ended()) and time.monotonic() < last:
            time.sleep(min(ASK_EVERY, seconds))
        return ended

    def _ended(self) -> list[Event]:
        """Return the jobs with an answer, and those that Slurm no longer has."""
        if time.monotonic() - self._asked >= QUEUE_EVERY:
            self._asked = time.monotonic()
            code, output, errors = _call("squeue", "--noheader", "--me", f"--name={NAME}", "--format=%A")
            if code and not self._told:  # Slurm is busy or away: nothing is known, and answers still count
                say(f"squeue failed; trying again: {_last_line(errors)}", error=True)
                self._told = True
            for name, (slurm_id, _) in self._running.items() if not code else ():
                self._missed[name] = 0 if slurm_id in output.split() else self._missed[name] + 1
        self._folder.chmod(0o700)  # makes network file systems show files that are new
        there = set(os.listdir(self._folder))
        events: list[Event] = []
        for name, (slurm_id, base) in self._running.items():
            if f"{base.name}.answer" in there:
                events.append((name, base.with_suffix(".answer").read_text("utf-8"), ""))
                for suffix in SUFFIXES:
                    base.with_suffix(suffix).unlink(missing_ok=True)
            elif self._missed[name] >= MISSED:
                log = base.with_suffix(".log")  # missing if the job never began
                reason = _last_line(log.read_text("utf-8", "replace") if log.is_file() else "") or "no output"
                events.append((name, "crashed", f"Slurm's job {slurm_id} ended without an answer: {reason}"))
        for name, _, _ in events:
            del self._running[name]
        return events

    def close(self) -> None:
        """Stop running jobs, drop queued ones, and remove the private folder; running fits save their state."""
        if self._running:
            code, _, errors = _call("scancel", *(slurm_id for slurm_id, _ in self._running.values()))
            if code:
                say(f"scancel failed, jobs may still run: {_last_line(errors)}", error=True)
        self._running.clear()
        self._stack.close()


def _call(program: str, *options: str, script: str = "") -> tuple[int, str, str]:
    """Call a command of Slurm. Variables such as SBATCH_ACCOUNT apply, but those of squeue do not: they could hide jobs."""
    return run_program(program, *options, stdin=script, timeout=PATIENCE, hidden=("SQUEUE_",))


def _last_line(text: str) -> str:
    """Return the last line that is not empty, or an empty text."""
    return next((line.strip() for line in reversed(text.splitlines()) if line.strip()), "")


# The process of a Slurm job: runs the job that one file describes, and writes the job's state into another file.
#
# ``python -P -m warpgs.pipeline.farm.slurm JOB ANSWER THREADS``


def main(job: str, answer: str, threads: str) -> int:
    """Run a job; return the exit code."""
    try:
        with interrupting_signals():
            write_text(Path(answer), run_job(Path(job).read_text("utf-8"), int(threads)))
    except KeyboardInterrupt:
        return 130
    except WarpgsError as e:
        say(e, error=True)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
