"""The default engine: a process for each slot of this machine's devices."""

from __future__ import annotations

import json
import os
import queue
import threading
from dataclasses import dataclass, field

from warpgs.errors import ResourceError, UsageError
from warpgs.pipeline.farm.engine import Event
from warpgs.pipeline.farm.job import FarmJob, job_text
from warpgs.pipeline.runs.request import choose_device
from warpgs.runtime.subprocesses import PythonWorker

WORKER = "warpgs.pipeline.farm.worker"
SECONDS_TO_SAVE = 60.0
"""Time that a fit gets to save its state when the farm is stopped [s]."""
MAX_SLOTS = 256


@dataclass(frozen=True)
class Slot:
    """A device, or a part of one, for one job at a time."""

    device: str
    """cpu or cuda, as the job sees it."""
    threads: int
    """CPU threads."""
    environment: dict[str, str] = field(default_factory=dict)
    """Environment variables of the slot's process, which select its GPU."""


def local_slots(device: str, slots: int | None, per_gpu: int) -> list[Slot]:
    """Return the slots of this machine.

    Args:
        device: auto, cpu or cuda.
        slots: Number of slots; None: ``per_gpu`` for each GPU, or one on a CPU.
        per_gpu: Slots of each GPU.

    Raises:
        ResourceError: CUDA was requested and is missing.
        UsageError: More slots are requested than are possible, or than the GPUs have.
    """
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
        return [Slot("cpu", threads)] * count
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    names = named.split(",")[:gpus] if named else [str(i) for i in range(gpus)]
    return [Slot("cuda", threads, {"CUDA_VISIBLE_DEVICES": names[i % gpus]}) for i in range(count)]


class _Process:
    """A worker process of a slot, and the job it works on."""

    def __init__(self, slot: Slot, news: queue.SimpleQueue[tuple[_Process, str | None]]):
        """Start the process; its lines go to ``news``, then None when it ends."""
        threads = {"OMP_NUM_THREADS": str(slot.threads)}
        self.slot, self.job = slot, ""
        self.worker = PythonWorker(WORKER, environment={**threads, **slot.environment})
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
        slot = self._free[-1]
        alone = self.slots == 1 or slot.device == "cpu"  # that process can serve its slot afterwards
        process = _Process(self._free.pop() if alone else Slot(slot.device, slot.threads), self._news)
        try:
            self._compile(process, slot.device)
        except BaseException:
            process.worker.end(0)
            raise
        if alone:
            self._idle.append(process)
        else:
            process.worker.end(SECONDS_TO_SAVE)

    def _compile(self, process: _Process, device: str) -> None:
        """Compile kernels of all devices that a process sees.

        Raises:
            ResourceError: The process ends early.
        """
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
        """Start a job in an idle process, or in a new one; before the first job, kernels are compiled.

        Raises:
            ResourceError: The kernels cannot be compiled.
        """
        if not self._compiled:
            self._prepare()
        process = self._idle.pop() if self._idle else _Process(self._free.pop(), self._news)
        process.job = job.name
        self._busy[job.name] = process
        process.worker.send(json.dumps({"job": job_text(job), "threads": process.slot.threads}))

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
