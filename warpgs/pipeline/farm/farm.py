"""A farm: jobs, the engine of this machine, and the index page of their runs."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

from warpgs.errors import FolderHeldError, ResourceError, UsageError
from warpgs.files import remove_leftovers, write_text, writing_into
from warpgs.locks import hold_folder
from warpgs.pipeline.farm.job import (
    PLY,
    THUMBNAIL,
    Engine,
    Event,
    FarmJob,
    JobRecord,
    finished,
    job_text,
    read_job_record,
    write_record,
)
from warpgs.pipeline.run.request import choose_device
from warpgs.process import PythonWorker, say
from warpgs.report.farm import FarmTable, JobCard, JobRow, write_farm_page

WORKER = "warpgs.pipeline.farm.worker"
SECONDS_TO_SAVE = 60.0
"""Time that a fit gets to save its state when the farm is stopped [s]."""
MAX_SLOTS = 256


Slot = tuple[str, int, dict[str, str]]
"""A device, or a part of one, for one job at a time: cpu or cuda, its CPU threads, and the variables that select its GPU."""


def local_slots(device: str, slots: int | None, per_gpu: int) -> list[Slot]:
    """Return the slots of this machine."""
    import torch

    kind = choose_device(device)[0].type
    gpus = torch.cuda.device_count() if kind == "cuda" else 0
    count = (gpus * per_gpu if gpus else 1) if slots is None else slots
    if not 1 <= count <= MAX_SLOTS or not 1 <= per_gpu <= MAX_SLOTS:
        raise UsageError(f"--slots and --per-gpu must be numbers from 1 to {MAX_SLOTS}, not {slots} and {per_gpu}")
    if gpus and count > gpus * per_gpu:
        raise UsageError(
            f"--slots {count}: {gpus} GPUs with --per-gpu {per_gpu} have {gpus * per_gpu} slots; give a larger --per-gpu"
        )
    threads = max(1, torch.get_num_threads() // count)
    if not gpus:
        return [("cpu", threads, {})] * count
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = named.split(",")[:gpus] if named else [str(i) for i in range(gpus)]
    return [("cuda", threads, {"CUDA_VISIBLE_DEVICES": names[i % gpus]}) for i in range(count)]


class _Process:
    """A worker process of a slot, and the job it works on."""

    def __init__(self, slot: Slot, news: queue.SimpleQueue[tuple[_Process, str | None]]):
        """Start the process; its lines go to ``news``, then None when it ends."""
        self.slot, self.job = slot, ""
        self.worker = PythonWorker(WORKER, environment={"OMP_NUM_THREADS": str(slot[1]), **slot[2]})
        threading.Thread(target=self._listen, args=(news,), daemon=True).start()

    def _listen(self, news: queue.SimpleQueue[tuple[_Process, str | None]]) -> None:
        for line in self.worker.lines():
            news.put((self, line))
        news.put((self, None))


class LocalEngine:
    """Runs each job in the process of a slot; the process runs job after job until a job fails or the process dies."""

    name = "local"

    def __init__(self, slots: list[Slot]):
        """Prepare the slots; processes start with the first job."""
        self.slots = len(slots)
        self._free = list(reversed(slots))
        self._idle: list[_Process] = []
        self._busy: dict[str, _Process] = {}
        self._news: queue.SimpleQueue[tuple[_Process, str | None]] = queue.SimpleQueue()
        self._compiled = False

    def _prepare(self) -> None:
        """Compile kernels once for all processes, in a process that sees all devices."""
        self._compiled = True
        device, threads, _ = self._free[-1]
        alone = self.slots == 1 or device == "cpu"  # that process can serve its slot afterwards
        process = _Process(self._free.pop() if alone else (device, threads, {}), self._news)
        try:
            self._compile(process, device)
        except BaseException:
            process.worker.end(0)
            raise
        if alone:
            self._idle.append(process)
        else:
            process.worker.end(SECONDS_TO_SAVE)

    def _compile(self, process: _Process, device: str) -> None:
        """Compile kernels of all devices that a process sees."""
        process.worker.send(json.dumps({"kernels": device}))
        _, line = self._news.get()
        if line is None or json.loads(line).get("state") != "done":
            code, errors = process.worker.end(0)
            last = (errors.splitlines() or ["no message"])[-1]
            raise ResourceError(
                f"kernels could not be compiled: the process ended with exit code {code} ({last}); run `warpgs doctor` to "
                "check this machine"
            )

    def workers(self) -> dict[str, int]:
        """Return the numbers of the processes at work, by job."""
        return {name: process.worker.number for name, process in self._busy.items()}

    def start(self, job: FarmJob) -> None:
        """Start a job in an idle process, or in a new one; before the first job, kernels are compiled."""
        if not self._compiled:
            self._prepare()
        process = self._idle.pop() if self._idle else _Process(self._free.pop(), self._news)
        process.job = job.name
        self._busy[job.name] = process
        process.worker.send(json.dumps({"job": job_text(job), "threads": process.slot[1]}))

    def wait(self, seconds: float) -> list[Event]:
        """Return the new events of all processes."""
        try:
            process, line = self._news.get(timeout=seconds)
        except queue.Empty:
            return []
        if line is None:
            return self._ended(process)
        values = json.loads(line)
        if "state" not in values:
            return [Event(process.job, "running", step=values["step"])]
        name, state = process.job, values["state"]
        del self._busy[name]
        process.job = ""
        if state == "failed":  # the process ends and frees its memory
            process.worker.end(SECONDS_TO_SAVE)
            self._free.append(process.slot)
        else:
            self._idle.append(process)
        return [Event(name, state)]

    def _ended(self, process: _Process) -> list[Event]:
        """Record that a process has ended."""
        code, errors = process.worker.end(SECONDS_TO_SAVE)
        if not process.job:
            if process in self._idle:
                self._idle.remove(process)
                self._free.append(process.slot)
            return []
        del self._busy[process.job]
        self._free.append(process.slot)
        how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
        last = "".join(f": {line}" for line in errors.splitlines()[-1:])
        return [Event(process.job, "crashed", f"its process {how}{last}")]

    def close(self) -> None:
        """Ask all processes to save and stop, and kill those that do not."""
        processes = [*self._busy.values(), *self._idle]
        threads = [threading.Thread(target=p.worker.end, args=(SECONDS_TO_SAVE,)) for p in processes]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        self._busy, self._idle = {}, []


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
    """Run jobs until each is done or has failed."""
    # A finished, valid job is skipped. If the process of a job dies or runs out of memory, the job is started once more
    # after the others, from its checkpoint. The folder of a running job is locked. A job whose folder another farm has
    # locked is checked again later, and its result is used.
    return _Farm(jobs, engine, show, poll).run()


class _Farm:
    """The jobs of a farm and the locks of their folders."""

    def __init__(self, jobs: list[FarmJob], engine: Engine, show: Callable[[list[JobStatus]], object], poll: float):
        self.all = [JobStatus(job, before=read_job_record(job.folder)) for job in jobs]
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
        record = read_job_record(status.job.folder)
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
        record = read_job_record(status.job.folder)
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


INDEX, TABLE = "index.html", "results.csv"
COLUMNS = (
    "name", "scene", "state", "how", "psnr", "ssim", "gaussians", "steps", "ply_bytes", "seconds", "ply_sha256", "message",
)  # fmt: skip
"""Columns of results.csv."""


def row_of(status: JobStatus) -> JobRow:
    """Return the row of a job in tables."""
    record = status.record
    if record is None:
        took = time.monotonic() - status.began if status.state == "running" else 0.0
        return JobRow(status.job.name, status.state, status.step, took, message=status.notes[-1] if status.notes else "")
    message = record.message if record.state == "failed" else "" if status.attempts else "finished before"
    return JobRow(
        record.name, status.state, record.steps, record.seconds, record.psnr, record.gaussians,
        message or (status.notes[-1] if status.notes else ""),
    )  # fmt: skip


def write_index(folder: Path, statuses: list[JobStatus], seconds: float) -> None:
    """Write index.html and results.csv of a farm."""
    cards = []
    for status in statuses:
        record, job = status.record, status.job
        row = row_of(status)
        shown = replace(
            row, message=row.message.replace(f"{Path(job.request.scene.path).parent}{os.sep}", "")
        )  # a page is sent
        thumbnail, report = job.folder / THUMBNAIL, job.request.out / "report.html"
        cards.append(JobCard(
            shown, record.ssim if record else None, record.ply_bytes if record else 0,
            thumbnail.relative_to(folder).as_posix() if thumbnail.is_file() else "",
            report.relative_to(folder).as_posix() if report.is_file() else "",
        ))  # fmt: skip
    write_farm_page(folder / INDEX, folder.resolve().name, cards, seconds)
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(COLUMNS)
    for status in statuses:
        r, scene = status.record, status.job.request.scene.path
        if r is None:
            writer.writerow([status.job.name, scene, status.state, *[""] * (len(COLUMNS) - 3)])
            continue
        sizes = ["" if v is None else v for v in (r.psnr, r.ssim, r.gaussians, r.steps, r.ply_bytes, round(r.seconds, 3))]
        writer.writerow([r.name, scene, r.state, r.how, *sizes, r.files.get(PLY, ""), r.message])
    write_text(folder / TABLE, text.getvalue())


ENGINES = ("local", "ray", "slurm")
SHOW_INTERVAL = 0.2
"""Shortest time between two updates of the table [s]."""
INDEX_INTERVAL = 30.0
"""Time between two updates of the index while jobs run [s]."""


def make_engine(
    device: str, engine: str = "local", *, slots: int | None = None, per_gpu: int = 1, threads: int = 1, minutes: int = 240,
    partition: str | None = None, slurm_folder: Path | None = None,
) -> Engine:  # fmt: skip
    """Make an engine by its name, with the options of `warpgs farm`."""
    if engine not in ENGINES:
        raise UsageError(f"--engine {engine!r} is not one of {', '.join(ENGINES)}")
    if engine == "local":
        return LocalEngine(local_slots(device, slots, per_gpu))
    if min(1 if slots is None else slots, per_gpu, threads, minutes) < 1:
        raise UsageError("--slots, --per-gpu, --threads and --minutes must be at least 1")
    if engine == "ray":
        from warpgs.pipeline.farm.ray import RayEngine

        return RayEngine(choose_device(device)[0].type, slots, per_gpu, threads)
    from warpgs.pipeline.farm.slurm import SlurmEngine

    kind = choose_device(device)[0].type if device == "auto" else device
    return SlurmEngine(kind, slots, threads, minutes, partition, slurm_folder)


def run_and_show(jobs: list[FarmJob], engine: Engine, results: Path, *, live: bool | None = None) -> list[JobStatus]:
    """Run a farm, show its progress, and write its index."""
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
    """Check that no job failed."""
    failed = [s for s in statuses if s.state == "failed"]
    if failed:
        first = failed[0].record
        names = ", ".join(s.job.name for s in failed[:5]) + ("" if len(failed) <= 5 else f" and {len(failed) - 5} more")
        raise ResourceError(
            f"{len(failed)} of {len(statuses)} jobs failed: {names}; {INDEX} has their messages. First message: "
            f"{first.message.rstrip('.') if first else 'unknown'}. Repeat the command to try them again"
        )
