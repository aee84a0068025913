"""The process of a device slot: reads jobs as lines from stdin, one after another, and answers with lines of JSON.

The process ends when stdin ends or a job fails, since a failed job may leave memory allocated. A line is ``{"job": TEXT,
"threads": N}``. An answer holds ``step``, or ``state`` at the end of a job. If stdin ends during a job, the job saves its state
and stops.
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

STEP_INTERVAL = 0.5
"""Time between two lines about steps [s]."""


def main() -> int:
    """Run jobs until stdin ends or a job fails; return the exit code."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # also where the farm was started to ignore it
    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # all other output goes to stderr
    lines, working, told = queue.SimpleQueue[str | None](), threading.Event(), 0.0

    def answer(**values: object) -> None:
        out.write(json.dumps(values) + "\n")
        out.flush()

    def read() -> None:
        for line in sys.stdin:
            lines.put(line)
        lines.put(None)
        if working.is_set():
            _thread.interrupt_main(signal.SIGINT)

    def on_step(report: StepReport) -> None:
        nonlocal told
        if time.monotonic() - told >= STEP_INTERVAL:
            told = time.monotonic()
            answer(step=report.step)

    threading.Thread(target=read, daemon=True).start()
    from warpgs.pipeline.farm.work import StepReport, run_job

    while (line := lines.get()) is not None:
        values = json.loads(line)
        working.set()
        try:
            state = run_job(values["job"], values["threads"], on_step)
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
