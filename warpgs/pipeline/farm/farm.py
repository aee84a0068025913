"""A farm: jobs, the engine of this machine, its progress, and the index page of the runs."""

import contextlib
import json
import os
import queue
import re
import textwrap
import threading
import time
from collections import Counter, defaultdict, deque
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from pathlib import Path

from warpgs.device import format_bytes
from warpgs.errors import FolderHeldError, ResourceError, UsageError, listed
from warpgs.files import remove_leftovers, write_csv, write_text, writing_into
from warpgs.locks import check_free, hold_folder
from warpgs.pipeline.farm.job import PLY, THUMBNAIL, Engine, Event, FarmJob, JobRecord, finished, read_job_record, write_record
from warpgs.pipeline.run.request import choose_device
from warpgs.process import PythonWorker, say
from warpgs.report.page import rendered
from warpgs.report.progress import Stages, duration

WORKER = "warpgs.pipeline.farm.worker"
SECONDS_TO_SAVE = 60.0
"""Time that a fit gets to save its state when the farm is stopped [s]."""


Slot = tuple[str, int, dict[str, str]]
"""A device, or a part of one, for one job at a time: cpu or cuda, its CPU threads, and the variables that select its GPU."""


def local_slots(device: str, slots: int | None, per_gpu: int) -> list[Slot]:
    """Return the slots of this machine."""
    import torch

    gpus = torch.cuda.device_count() if choose_device(device)[0].type == "cuda" else 0
    count = (gpus * per_gpu if gpus else 1) if slots is None else slots
    if gpus and count > gpus * per_gpu:
        raise UsageError(f"--slots {count}: {gpus} GPUs with --per-gpu {per_gpu} have {gpus * per_gpu}; give more --per-gpu")
    threads = max(1, torch.get_num_threads() // count)
    if not gpus:
        return [("cpu", threads, {})] * count
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = named.split(",")[:gpus] if named else [str(i) for i in range(gpus)]
    return [("cuda", threads, {"CUDA_VISIBLE_DEVICES": names[i % gpus]}) for i in range(count)]


class LocalEngine:
    """Runs each job in the process of a slot; the process runs job after job until a job fails or the process dies."""

    name = "local"

    def __init__(self, slots: list[Slot]):
        """Start a thread for each slot; processes start with the first jobs."""
        self.slots, self._closing, self._lock = len(slots), False, threading.Lock()
        self._jobs: queue.SimpleQueue[tuple[str, str] | None] = queue.SimpleQueue()
        self._news: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self._workers: dict[str, PythonWorker] = {}
        self._threads = [threading.Thread(target=self._serve, args=(slot,), daemon=True) for slot in slots]
        for thread in self._threads:
            thread.start()

    def start(self, job: FarmJob) -> None:
        """Start a job in an idle process, or in a new one."""
        self._jobs.put((job.name, job.text()))

    def wait(self, seconds: float) -> list[Event]:
        """Return the next event of all processes, if any."""
        try:
            return [self._news.get(timeout=seconds)]
        except queue.Empty:
            return []

    def _serve(self, slot: Slot) -> None:
        """Run jobs in the process of a slot, one after another."""
        (_, threads, environment), worker = slot, None
        lines: Iterator[str] = iter(())
        while (job := self._jobs.get()) is not None:
            (name, text), state, reason = job, "crashed", ""
            try:
                if worker is None:
                    worker = PythonWorker(WORKER, environment={"OMP_NUM_THREADS": str(threads), **environment})
                    lines = worker.lines()
            except OSError as e:
                self._news.put((name, state, str(e)))
                continue
            with self._lock:
                if self._closing:
                    break
                self._workers[name] = worker
                worker.send(json.dumps({"job": text, "threads": threads}))
            while state == "crashed" and (line := next(lines, None)) is not None:
                if "step" in (values := json.loads(line)):
                    self._news.put((name, "running", values["step"]))
                else:
                    state = values["state"]
            with self._lock:
                del self._workers[name]
                if self._closing:
                    return  # `close` ends the process
            if state in ("failed", "crashed"):  # after a failure, too, the process ends, and frees its memory
                code, errors = worker.end(SECONDS_TO_SAVE)
                how = f"was killed by signal {-code}" if code < 0 else f"ended with exit code {code}"
                reason = f"its process {how}{''.join(f': {line}' for line in errors.splitlines()[-1:])}"
                worker = None
            self._news.put((name, state, reason if state == "crashed" else ""))
        if worker is not None:
            worker.end(SECONDS_TO_SAVE)

    def close(self) -> None:
        """Ask all processes to save and stop, and kill those that do not."""
        with self._lock:
            self._closing, workers = True, list(self._workers.values())
        for _ in range(self.slots):
            self._jobs.put(None)
        with ThreadPoolExecutor(self.slots) as pool:
            for worker in workers:
                pool.submit(worker.end, SECONDS_TO_SAVE)
        for thread in self._threads:
            thread.join()


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
    """Run jobs until each is done or has failed; ``show`` gets their status after each change."""
    # A finished, valid job is skipped. If the process of a job dies or runs out of memory, the job is started once more
    # after the others, from its checkpoint. The folder of a running job is locked. A job whose folder another farm has
    # locked is checked again later, and its result is used.
    farm = _Farm(jobs, engine)
    show(farm.all)
    try:
        while farm.left:
            farm.start()
            events = engine.wait(poll) if farm.running else []
            if not farm.running and farm.waiting:
                time.sleep(poll)  # all jobs that are left are locked by other farms
            for event in events:
                farm.take(*event)
            show(farm.all)
    finally:
        for lock in farm.held.values():
            lock.close()
    return farm.all


class _Farm:
    """The jobs of a farm and the locks of their folders."""

    def __init__(self, jobs: list[FarmJob], engine: Engine):
        self.all = [JobStatus(job, before=read_job_record(job.folder)) for job in jobs]
        self.engine, self.by_name = engine, {s.job.name: s for s in self.all}
        self.held: dict[str, contextlib.ExitStack] = {}
        self.left, self.running = len(jobs), 0  # counted, since there may be a million
        for status in self.all:
            if (record := finished(status.job)) is not None:
                with contextlib.suppress(FolderHeldError):
                    check_free(status.job.folder)
                self._end(status, record)
        self.waiting = deque(s for s in self.all if not s.ended)

    def start(self) -> None:
        """Start as many jobs as the engine takes; those of another farm go to the end of the queue."""
        for _ in range(len(self.waiting)):
            if self.running >= self.engine.slots:
                return
            status = self.waiting.popleft()
            if not self._claim(status):
                self.waiting.append(status)
            elif not status.ended:
                status.state, status.began, status.attempts = "running", time.monotonic(), status.attempts + 1
                self.running += 1
                self.engine.start(status.job)

    def _claim(self, status: JobStatus) -> bool:
        """Lock the folder of a job; return False if another farm holds it; end the job if it was finished meanwhile."""
        job = status.job
        try:
            stack = contextlib.ExitStack()
            notes = stack.enter_context(hold_folder(job.folder))
        except FolderHeldError:
            status.state = "elsewhere"
            return False
        self.held[job.name] = stack
        status.notes += [n for n in notes if n not in status.notes]
        record = read_job_record(job.folder)
        if status.attempts == 0 and record is not None and record != status.before:
            same = record.identity == job.identity() and not record.again
            taken = finished(job) if record.state == "done" else record if same else None
            if taken is not None:
                self._end(status, taken)
        return True

    def take(self, name: str, state: str, detail: str | int) -> None:
        """Record an event of a job."""
        status = self.by_name[name]
        if state == "running":
            status.step = int(detail)
            return
        self.running -= 1
        status.seconds += time.monotonic() - status.began
        job, record = status.job, read_job_record(status.job.folder)
        if state == "held":  # a process that a farm left behind works on it
            status.attempts -= 1
            self._wait(status, "elsewhere")
        elif state != "crashed" and record is not None and not (record.state == "failed" and record.again):
            self._end(status, record)
        else:
            reason = detail or (record.message if record is not None else "the job left no record")
            status.notes.append(f"attempt {status.attempts}: {reason}")
            if status.attempts < ATTEMPTS:
                self._wait(status, "waiting")
                return
            message = f"{reason} ({status.attempts} attempts)"
            record = JobRecord(job.name, job.identity(), "failed", "failed", message, True, seconds=status.seconds)
            write_record(job.folder, record)
            self._end(status, record)

    def _wait(self, status: JobStatus, state: str) -> None:
        """Put a job at the end of the queue."""
        status.state = state
        self.held.pop(status.job.name).close()
        self.waiting.append(status)

    def _end(self, status: JobStatus, record: JobRecord) -> None:
        """End a job with its record."""
        status.state, status.record = record.state, record
        self.left -= 1
        if status.job.name in self.held:
            self.held.pop(status.job.name).close()


def seconds_left(statuses: list[JobStatus], slots: int) -> float | None:
    """Estimate the time until all jobs are done [s] from the mean time of jobs done by this farm; None before one is done."""
    if not (took := [s.seconds for s in statuses if s.state == "done" and s.seconds]):
        return None
    mean, now = sum(took) / len(took), time.monotonic()
    left = sum(max(0.0, mean - (now - s.began)) if s.state == "running" else mean for s in statuses if not s.ended)
    return left / max(1, min(slots, sum(not s.ended for s in statuses)))


STATES = ("waiting", "running", "elsewhere", "done", "failed")


def progress_line(statuses: list[JobStatus], slots: int, seconds: float) -> str:
    """Return the number of jobs that ended, the time left, the numbers by state, and the time that passed."""
    counts, left = Counter(s.state for s in statuses), seconds_left(statuses, slots)
    states = ", ".join(f"{counts[s]:,} {s}" for s in STATES if counts[s])
    ended = f"{counts['done'] + counts['failed']:,} of {len(statuses):,} jobs{f', left {duration(left)}' if left else ''}"
    return f"farm: {ended}, {states}, after {duration(seconds)}"  # a narrow terminal cuts the end


SHORT = 120
"""Largest number of letters on a card; the table of failures shows the whole message."""


def _facts(row: JobRecord) -> str:
    """Return what a line or a card tells of a job: scores and sizes, the message of a failure, or the state."""
    if row.state == "failed":
        return row.message
    facts = [
        "" if row.psnr is None else f"PSNR {row.psnr:.2f} dB", "" if row.ssim is None else f"SSIM {row.ssim:.3f}",
        f"{row.gaussians:,} Gaussians" if row.gaussians else "", format_bytes(row.ply_bytes) if row.ply_bytes else "",
        duration(row.seconds) if row.seconds else "", row.message,
    ]  # fmt: skip
    return ", ".join(filter(None, facts)) or row.state


def _failures(rows: list[JobRecord]) -> list[tuple[str, list[str]]]:
    """Return each message of failed jobs with the names of the jobs, the most frequent first."""
    by_message: dict[str, list[str]] = defaultdict(list)
    for row in rows:
        if row.state == "failed":  # messages that differ only in the job's name count as one
            by_message[re.sub(rf"(?<!\w){re.escape(row.name)}(?!\w)", "SCENE", row.message)].append(row.name)
    return sorted(by_message.items(), key=lambda item: -len(item[1]))


Card = tuple[JobRecord, str, str]
"""A job, and the paths of its image and its report, relative to the page; empty without one."""


def farm_page(title: str, cards: list[Card], seconds: float) -> str:
    """Return the page of a farm, with its jobs in the order given, ``seconds`` after it began."""
    rows = [row for row, _, _ in cards]
    states = Counter(r.state for r in rows)
    scores = [r.psnr for r in rows if r.psnr is not None]
    figures = [
        ("scenes", f"{len(rows):,}"), ("done", f"{states['done']:,}"), ("failed", f"{states['failed']:,}"),
        ("mean held-out PSNR", f"{sum(scores) / len(scores):.2f} dB" if scores else "-"),
        ("all PLY files", format_bytes(sum(r.ply_bytes for r in rows))), ("time", duration(seconds)),
    ]  # fmt: skip
    left = len(rows) - states["done"] - states["failed"]
    line = f"{left:,} jobs are not done yet; load the page again later." if left else "All jobs have ended."
    given = [(row, textwrap.shorten(_facts(row), SHORT, placeholder=" ..."), *paths) for row, *paths in cards]
    return rendered("farm.html", title=title, line=line, figures=figures, failures=_failures(rows), cards=given)


INDEX, TABLE = "index.html", "results.csv"
COLUMNS = (
    "name", "scene", "state", "how", "psnr", "ssim", "gaussians", "steps", "ply_bytes", "seconds", "ply_sha256", "message",
)  # fmt: skip
"""Columns of results.csv."""


def row_of(status: JobStatus) -> JobRecord:
    """Return the row of a job in tables: its record, or what is known so far, with the message to show."""
    r, note = status.record, status.notes[-1] if status.notes else ""
    if r is None:
        took = time.monotonic() - status.began if status.state == "running" else 0.0
        return JobRecord(status.job.name, "", status.state, message=note, seconds=took, steps=status.step)
    return replace(r, message=(r.message if r.state == "failed" else "" if status.attempts else "finished before") or note)


def write_index(folder: Path, statuses: list[JobStatus], seconds: float) -> None:
    """Write index.html and results.csv of a farm."""
    cards: list[Card] = []
    lines: list[tuple[object, ...]] = [COLUMNS]
    for status in statuses:
        r, job, scene, row = status.record, status.job, status.job.request.scene.path, row_of(status)
        files = [p if p.is_file() else None for p in (job.folder / THUMBNAIL, job.request.out / "report.html")]
        thumbnail, report = ("" if p is None else p.relative_to(folder).as_posix() for p in files)
        message = row.message.replace(f"{Path(scene).parent}{os.sep}", "")  # a page is sent
        cards.append((replace(row, message=message), thumbnail, report))
        if r is None:
            lines.append((job.name, scene, status.state, *[""] * (len(COLUMNS) - 3)))
        else:  # csv writes None as an empty field
            figures = r.psnr, r.ssim, r.gaussians, r.steps, r.ply_bytes, round(r.seconds, 3)
            lines.append((r.name, scene, r.state, r.how, *figures, r.files.get(PLY, ""), r.message))
    write_text(folder / INDEX, farm_page(folder.resolve().name, cards, seconds))
    write_csv(folder / TABLE, lines)


SHOW_INTERVAL = 0.2
"""Shortest time between two lines of progress [s]."""
INDEX_INTERVAL = 30.0
"""Time between two updates of the index while jobs run [s]."""


def make_engine(
    device: str, engine: str = "local", *, slots: int | None = None, per_gpu: int = 1, threads: int = 1, minutes: int = 240,
    partition: str | None = None, slurm_folder: Path | None = None,
) -> Engine:  # fmt: skip
    """Make an engine by its name, with the options of `warpgs farm`."""
    if engine == "local":
        return LocalEngine(local_slots(device, slots, per_gpu))
    if engine == "ray":
        from warpgs.pipeline.farm.ray import RayEngine

        return RayEngine(choose_device(device)[0].type, slots, per_gpu, threads)
    from warpgs.pipeline.farm.slurm import SlurmEngine

    kind = choose_device(device)[0].type if device == "auto" else device
    return SlurmEngine(kind, slots, threads, minutes, partition, slurm_folder)


def run_and_show(jobs: list[FarmJob], engine: Engine, results: Path, *, live: bool | None = None) -> list[JobStatus]:
    """Run a farm, show its progress, and write its index."""
    began = time.monotonic()
    shown, written, told = began - SHOW_INTERVAL, began - INDEX_INTERVAL, set[str]()
    count = f"{len(jobs)} job{'' if len(jobs) == 1 else 's'}"
    say(f"{count}, engine {engine.name}, {engine.slots} at a time; results: {results / INDEX}, {TABLE}")
    try:
        with writing_into(results), Stages(live=live) as stage:
            remove_leftovers(results)  # of a farm that was killed while it wrote its index

            def show(statuses: list[JobStatus], *, last: bool = False) -> None:
                nonlocal shown, written
                now = time.monotonic()
                if now - shown < SHOW_INTERVAL and not last:
                    return
                for status in statuses:
                    if status.ended and status.job.name not in told:
                        told.add(status.job.name)
                        say(f"{status.job.name}  {status.state}  {_facts(row_of(status))}")
                (say if last else stage)(progress_line(statuses, engine.slots, now - began))
                shown = now
                if now - written >= INDEX_INTERVAL or last:
                    write_index(results, statuses, now - began)
                    written = now

            statuses = run_farm(jobs, engine, show)
            show(statuses, last=True)
            return statuses
    except KeyboardInterrupt:
        say("repeat the command to continue: finished jobs are kept, and interrupted jobs continue")
        raise
    finally:
        engine.close()


def check_failures(statuses: list[JobStatus]) -> None:
    """Check that no job failed."""
    if failed := [s for s in statuses if s.state == "failed"]:
        first = failed[0].record
        names = listed([s.job.name for s in failed], 5)
        fix = f"First message: {first.message.rstrip('.') if first else 'unknown'}. Repeat the command to try them again"
        raise ResourceError(f"{len(failed)} of {len(statuses)} jobs failed: {names}; {INDEX} has their messages. {fix}")
