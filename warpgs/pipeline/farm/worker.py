"""The process of a device slot: reads jobs as lines from stdin, one after another, and answers with lines of JSON.

The process ends when stdin ends or a job fails, since a failed job may leave memory allocated. A line is ``{"kernels":
"cpu"}``, to compile kernels before the first job, or ``{"job": TEXT, "threads": N}``. An answer holds ``step``, or ``state``
at the end of a job. If stdin ends during a job, the job saves its state and stops.
"""

from __future__ import annotations

import _thread
import json
import os
import queue
import signal
import sys
import threading
import time
from collections.abc import Callable

STEP_INTERVAL = 0.5
"""Time between two lines about steps [s]."""


def _answers() -> Callable[..., None]:
    """Return a function that writes answers to stdout; from now on, all other output goes to stderr."""
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)

    def answer(**values: object) -> None:
        out.write(json.dumps(values) + "\n")
        out.flush()

    return answer


def _read(lines: queue.SimpleQueue[str | None], working: threading.Event) -> None:
    """Pass on the lines of stdin; at the end of stdin, interrupt the current job."""
    for line in sys.stdin:
        lines.put(line)
    lines.put(None)
    if working.is_set():
        _thread.interrupt_main(signal.SIGINT)


def _work(values: dict[str, object], answer: Callable[..., None]) -> str:
    """Carry out the request of a line; return the state."""
    if "kernels" in values:
        import torch

        from warpgs.pipeline.run.precompile import precompile_kernels

        for _ in precompile_kernels([torch.device("cpu")] if values["kernels"] == "cpu" else None):
            pass
        return "done"
    from warpgs.pipeline.farm.work import run_job
    from warpgs.pipeline.train.schedule import StepReport

    told = 0.0

    def on_step(report: StepReport) -> None:
        nonlocal told
        if time.monotonic() - told >= STEP_INTERVAL:
            told = time.monotonic()
            answer(step=report.step)

    return run_job(str(values["job"]), int(str(values["threads"])), on_step)


def main() -> int:
    """Run jobs until stdin ends or a job fails; return the exit code."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the farm was started to ignore it
    answer, lines, working = _answers(), queue.SimpleQueue[str | None](), threading.Event()
    threading.Thread(target=_read, args=(lines, working), daemon=True).start()
    while (line := lines.get()) is not None:
        working.set()
        try:
            state = _work(json.loads(line), answer)
        except KeyboardInterrupt:
            return 130
        finally:
            working.clear()
        answer(state=state)
        if state == "failed":
            return 0
    return 0


if __name__ == "__main__":
    sys.exit(main())
