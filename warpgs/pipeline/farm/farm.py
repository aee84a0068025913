"""The farm: gives jobs to an engine, retries crashed jobs, skips finished ones, and shares work with other farms."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from warpgs.errors import FolderHeldError
from warpgs.pipeline.farm.engine import Engine, Event
from warpgs.pipeline.farm.job import FarmJob
from warpgs.pipeline.farm.record import JobRecord, finished, read_record, write_record
from warpgs.runtime.folder_lock import hold_folder

ATTEMPTS = 2
"""Largest number of starts of a job; the second start follows a crash or a lack of memory."""
POLL = 2.0
"""Time between checks of a job that another farm works on [s]."""


@dataclass
class JobStatus:
    """Status of a job."""

    job: FarmJob
    state: str = "waiting"
    """waiting, running, elsewhere (another farm works on it), done or failed."""
    step: int = 0
    """Steps done; 0 if unknown."""
    attempts: int = 0
    """Number of starts by this farm."""
    seconds: float = 0.0
    """Total time of its starts by this farm [s]; 0 if this farm did not start it."""
    began: float = 0.0
    """Time of its last start (`time.monotonic`)."""
    record: JobRecord | None = None
    """Record once it is done or failed."""
    before: JobRecord | None = None
    """Record from before this farm."""
    notes: list[str] = field(default_factory=list)
    """Failed attempts, and notes on locks."""

    @property
    def ended(self) -> bool:
        """True if the job is done or has failed."""
        return self.state in ("done", "failed")


def run_farm(
    jobs: list[FarmJob], engine: Engine, show: Callable[[list[JobStatus]], object] = lambda _: None, *, poll: float = POLL
) -> list[JobStatus]:
    """Run jobs until each is done or has failed.

    A finished, valid job is skipped. If the process of a job dies or runs out of memory, the job is started once more after the
    others, from its checkpoint. The folder of a running job is locked. A job whose folder another farm has locked is checked
    again later, and its result is used.

    Args:
        jobs: The jobs.
        engine: Engine that runs the jobs; it is not closed.
        show: Called with the status of all jobs whenever one changed, and every ``poll`` seconds.
        poll: Time between checks of a job that another farm works on [s].

    Returns:
        The status of each job.

    Raises:
        ResourceError: A record or a lock cannot be written.
    """
    return _Farm(jobs, engine, show, poll).run()


class _Farm:
    """The jobs of a farm and the locks of their folders."""

    def __init__(self, jobs: list[FarmJob], engine: Engine, show: Callable[[list[JobStatus]], object], poll: float):
        self.all = [JobStatus(job, before=read_record(job.folder)) for job in jobs]
        self.engine, self.show, self.poll = engine, show, poll
        self.by_name = {s.job.name: s for s in self.all}
        self.held: dict[str, contextlib.ExitStack] = {}
        self.left, self.running = len(jobs), 0  # counted, since there may be a million

    def run(self) -> list[JobStatus]:
        """Run all jobs."""
        for status in self.all:
            record = finished(status.job)
            if record is not None:
                self._end(status, record)
        self.show(self.all)
        waiting = deque(s for s in self.all if not s.ended)
        try:
            while self.left:
                self._start(waiting)
                for event in self.engine.wait(self.poll) if self.running else self._pause(waiting):
                    self._take(event, waiting)
                self.show(self.all)
        finally:
            for lock in self.held.values():
                lock.close()
        return self.all

    def _pause(self, waiting: deque[JobStatus]) -> Iterator[Event]:
        """Wait a while if all jobs that are left are locked by other farms."""
        if waiting:
            time.sleep(self.poll)
        return iter(())

    def _start(self, waiting: deque[JobStatus]) -> None:
        """Start as many jobs as the engine takes; those of another farm go to the end of the queue."""
        for _ in range(len(waiting)):
            if self.running >= self.engine.slots:
                return
            status = waiting.popleft()
            if not self._claim(status):
                waiting.append(status)
            elif not status.ended:
                status.state, status.began, status.attempts = "running", time.monotonic(), status.attempts + 1
                self.running += 1
                self.engine.start(status.job)

    def _claim(self, status: JobStatus) -> bool:
        """Lock the folder of a job; return False if another farm holds it; end the job if it was finished meanwhile."""
        if status.job.name not in self.held:
            with contextlib.ExitStack() as stack:
                try:
                    notes = stack.enter_context(hold_folder(status.job.folder))
                except FolderHeldError:
                    status.state = "elsewhere"
                    return False
                self.held[status.job.name] = stack.pop_all()
                status.notes += [n for n in notes if n not in status.notes]
        record = read_record(status.job.folder)
        if status.attempts == 0 and record is not None and record != status.before:
            same = record.identity == status.job.identity()
            taken = finished(status.job) if record.state == "done" else record if same and not record.again else None
            if taken is not None:
                self._end(status, taken)
        return True

    def _take(self, event: Event, waiting: deque[JobStatus]) -> None:
        """Record an event of a job."""
        status = self.by_name[event.name]
        if event.state == "running":
            status.step = event.step
            return
        self.running -= 1
        status.seconds += time.monotonic() - status.began
        record = read_record(status.job.folder)
        if event.state == "held":  # a process that a farm left behind works on it
            self._release(status)
            status.state, status.attempts = "elsewhere", status.attempts - 1
            waiting.append(status)
        elif event.state == "crashed" or record is None or (record.state == "failed" and record.again):
            reason = event.message or (record.message if record is not None else "the job left no record")
            status.notes.append(f"attempt {status.attempts}: {reason}")
            if status.attempts < ATTEMPTS:
                status.state = "waiting"
                self._release(status)
                waiting.append(status)
            else:
                self._fail(status, reason)
        else:
            self._end(status, record)

    def _fail(self, status: JobStatus, reason: str) -> None:
        """End a job that failed each time."""
        message = f"{reason} ({status.attempts} attempts)"
        record = JobRecord(status.job.name, status.job.identity(), "failed", "failed", message, True, seconds=status.seconds)
        write_record(status.job.folder, record)
        self._end(status, record)

    def _end(self, status: JobStatus, record: JobRecord) -> None:
        """End a job with its record."""
        status.state, status.record = record.state, record
        self.left -= 1
        self._release(status)

    def _release(self, status: JobStatus) -> None:
        """Release the lock of the folder of a job."""
        lock = self.held.pop(status.job.name, None)
        if lock is not None:
            lock.close()


def seconds_left(statuses: list[JobStatus], slots: int) -> float | None:
    """Estimate the time until all jobs are done [s] from the mean time of jobs done by this farm; None before one is done."""
    took = [s.seconds for s in statuses if s.state == "done" and s.seconds]
    if not took:
        return None
    mean, now = sum(took) / len(took), time.monotonic()
    left = sum(max(0.0, mean - (now - s.began)) if s.state == "running" else mean for s in statuses if not s.ended)
    count = sum(not s.ended for s in statuses)
    return left / max(1, min(slots, count))
