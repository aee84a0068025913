"""The process of a Slurm job: runs the job that one file describes, and writes the job's state into another file.

``python -P -m warpgs.pipeline.farm.batch JOB ANSWER THREADS``
"""

from __future__ import annotations

import sys
from pathlib import Path

from warpgs.errors import WarpgsError
from warpgs.files import write_text
from warpgs.pipeline.farm.work import run_job
from warpgs.runtime.stop_signals import interrupting_signals
from warpgs.runtime.terminal import say


def main(job: str, answer: str, threads: str) -> int:
    """Run a job; return the exit code."""
    try:
        with interrupting_signals():
            state = run_job(Path(job).read_text("utf-8"), int(threads))
            write_text(Path(answer), state)
    except KeyboardInterrupt:
        return 130
    except WarpgsError as e:
        say(e, error=True)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))
