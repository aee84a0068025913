"""Progress of a fit, on the terminal and as a log of events."""

import contextlib
import io
import itertools
import json
import math
import os
import re
import sys
import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO

from warpgs import schema
from warpgs.files import appending, plain, read_file, writable, write_bytes
from warpgs.process import Say, careful, printable, say, silent

STAGE_INTERVAL, STAGE_LINES = 5.0, 20
"""Least seconds between two plain lines on one stage, and most lines on a stage that counts."""
SMOOTHING = 0.05
"""Weight of the newest value in the running means that are shown."""
FORGETTING = 0.98
"""Weight of a step's time in the time left, relative to that of the next step."""
NOISE = 0.25
"""Fraction by which the time left may rise without being shown, since the load of a machine varies."""
COUNTED = re.compile(r"(?P<done>[\d,]+) of (?P<total>[\d,]+)")
"""Part of a line with the progress of a stage."""


def duration(seconds: float) -> str:
    """Return a time span in words: 8 s, 2 min 05 s, 1 h 10 min."""
    seconds = int(round(seconds))
    minutes, hours = seconds // 60, seconds // 3600
    if hours:
        return f"{hours} h {minutes % 60:02d} min"
    return f"{minutes} min {seconds % 60:02d} s" if minutes else f"{seconds} s"


def is_live() -> bool:
    """Return whether stdout is a terminal in which a line can be overwritten."""
    stdout = getattr(sys.stdout, "rich_proxied_file", sys.stdout)  # while a line is shown, rich wraps stdout
    return stdout is not None and stdout.isatty() and os.environ.get("TERM") != "dumb"


class _StatusLine:
    """The line at the bottom of the terminal: spinner, stage, bar, progress, time. A process has one."""

    def __init__(self) -> None:
        """Begin without a line."""
        self.lock, self.display, self.task, self.stage = threading.RLock(), None, None, ""

    def show(self, line: str) -> None:
        """Show a line, such as ``finding depth: view 7 of 24``; the text before the colon names the stage."""
        stage, _, detail = printable(line).rpartition(": ")
        stage, detail = (stage, detail) if stage else (detail, "")
        counted = COUNTED.search(detail)
        done, total = (float(n.replace(",", "")) for n in counted.groups()) if counted else (0.0, None)
        if total is not None:
            done = min(done, 0.999 * total)  # rich stops the line of a finished task, and this stage may go on
        with self.lock:
            if self.display is None:
                self.display = self._started()
            if self.task is None or stage != self.stage:
                if self.task is not None:
                    self.display.remove_task(self.task)
                self.task, self.stage = self.display.add_task(stage, total=total, completed=done, detail=detail), stage
                self.display.refresh()  # now, because the next work may block the drawing thread
            else:
                self.display.update(self.task, total=total, completed=done, detail=detail)

    def clear(self) -> None:
        """Remove the line."""
        with self.lock:
            display, self.display, self.task, self.stage = self.display, None, None, ""
            if display is not None:
                display.stop()

    def _started(self):
        """Return rich's display of one task, which draws itself eight times a second until it is stopped."""
        from rich.console import Console
        from rich.progress import BarColumn, Progress as Display, SpinnerColumn, TextColumn, TimeElapsedColumn
        from rich.table import Column

        console, own = Console(file=careful(sys.stdout)), sys.stderr is not None and sys.stderr.isatty()
        columns = (
            SpinnerColumn("dots" if (console.encoding or "").startswith("utf") else "line"),
            TextColumn("{task.description}", markup=False), BarColumn(24),
            TextColumn("{task.fields[detail]}", markup=False, table_column=Column(ratio=1, no_wrap=True)), TimeElapsedColumn(),
        )  # fmt: skip
        # a redirected stderr disturbs no line
        display = Display(*columns, console=console, transient=True, refresh_per_second=8, redirect_stderr=own, expand=True)
        display.start()
        return display


_STATUS = _StatusLine()


class Stages(contextlib.AbstractContextManager["Stages"]):
    """Lines about the current work, such as ``finding depth: view 7 of 24``.

    The text before the last colon names a stage; numbers after it, such as ``7 of 24``, make a bar. In a terminal one line
    with the bar and the stage's time is rewritten in place. It goes at `clear` or at the end of a ``with`` block. Elsewhere the
    first line of a stage is shown at once, and then one every few seconds, at most about `STAGE_LINES` in all.
    """

    def __init__(self, show: Say = say, *, live: bool | None = None):
        """Print plain lines with ``show``; with ``live`` None, write in place if ``show`` is the default, in a terminal."""
        self.show, self.printed = show, {}
        self.live = (show is say and is_live()) if live is None else live

    def __exit__(self, *error) -> None:
        """Remove the line."""
        self.clear()

    def __call__(self, line: str) -> None:
        """Show a line; a plain line is skipped if its stage had one a moment ago."""
        stage, now, counted = line.rpartition(":")[0] or line, time.perf_counter(), COUNTED.search(line)
        done, total = (int(n.replace(",", "")) for n in counted.groups()) if counted else (0, 0)
        state, (last, before) = STAGE_LINES * done // total if total else line, self.printed.get(stage, (-STAGE_INTERVAL, None))
        if self.live:
            _STATUS.show(line)
        elif state != before and now - last >= STAGE_INTERVAL:
            self.printed[stage] = now, state
            self.show(line)

    def clear(self) -> None:
        """Remove the line until the next message."""
        if self.live:
            _STATUS.clear()


def waiting() -> Stages:
    """Return stages that are shown only in a terminal, for waits that a log need not mention."""
    return Stages(silent, live=is_live())


class Progress(contextlib.AbstractContextManager["Progress"]):
    """Context manager that shows step, loss, PSNR, number of Gaussians, time per step and time left, as `Stages` does.

    Times exclude steps that compile kernels; no time is shown before the first step without compilation.
    """

    def __init__(self, total: int, done: int = 0, *, planned: Sequence[float] | None = None, live: bool | None = None):
        """Prepare for ``total`` steps, of which ``done`` are done; ``live`` None writes in place only in a terminal.

        ``planned`` is the expected time of each step, in any unit; None: all are equal.
        """
        self.total, self.done, self.step = total, done, done
        self.planned = [0.0, *itertools.accumulate([1.0] * total if planned is None else planned)]
        """Expected time up to the end of each step, from 0."""
        self.took = self.expected = 0.0
        """Sums of measured and planned times of the last steps, with falling weights."""
        self.left: float | None = None
        """Time left [s]."""
        self.stages, self.count = Stages(live=live), 0
        self.loss = self.psnr = self.seconds = None

    def __exit__(self, *error) -> None:
        """Print the last state."""
        self.stages.clear()
        if error[0] is None and self.step > self.done:
            say(self.line())

    def update(self, *, step: int, loss: float, psnr: float, count: int, seconds: float | None = None) -> None:
        """Show the numbers of one finished step; ``seconds`` is its time, None if later steps will take another time."""
        seconds = None if self.loss is None else seconds  # the first step waits for memory and caches
        self.step, self.count = step, count
        self.loss, self.psnr = _mean(self.loss, loss), _mean(self.psnr, psnr)
        if seconds is not None:
            self.seconds = _mean(self.seconds, seconds)
            self.took = FORGETTING * self.took + seconds
            self.expected = FORGETTING * self.expected + self.planned[step] - self.planned[step - 1]
            left = self.took / self.expected * (self.planned[self.total] - self.planned[step])
            if self.left is None or not self.left < left < (1 + NOISE) * self.left:
                self.left = left
        if step < self.total:
            self.stages(self.line())

    def line(self) -> str:
        """Return the state of the fit as one line."""
        left = "-" if self.left is None else duration(self.left)
        each = "-" if self.seconds is None else f"{1000 * self.seconds:.0f} ms"
        values = f"PSNR {self.psnr:.2f} dB, {self.count:,} Gaussians, loss {self.loss:.4f}, {each} per step"
        return f"fitting: {self.step:,} of {self.total:,} steps, left {left}, {values}"


def _mean(old: float | None, new: float) -> float:
    """Return the running mean after a value."""
    return new if old is None else (1 - SMOOTHING) * old + SMOOTHING * new


MAX_BYTES = 2**30
"""Largest log that is read [bytes]: a million steps take a third of it."""

_SERIES = schema.mapping(schema.or_null(schema.real))
_STEP = schema.fields({"step": schema.whole(0)})


class EventLog:
    """A log to which events are appended; a resumed fit first drops the events after its checkpoint.

    The log is the only file of a run that is not replaced as a whole: lines are appended. After a kill only the last line can
    be incomplete; readers skip this line, and a resumed fit drops it.
    """

    _file: BinaryIO | None = None

    def __init__(self, path: Path, step: int = 0):
        """Open the log of a fit that has done ``step`` steps, and drop the events of later steps; 0 empties the log."""
        self.path = Path(path)
        self.rewind(step)

    def rewind(self, step: int) -> None:
        """Drop the events of all steps after ``step``; 0 empties the log."""
        if self._file is not None:
            self.close()
        with writable(self.path):
            kept = [e for e in read_events(self.path) if e["step"] <= step] if step and self.path.is_file() else []
            # The old log stays until the shortened one is on the disk.
            write_bytes(self.path, *(_line(e) for e in kept))
            self._file = appending(self.path)

    def write(self, *, step: int, **values: object) -> None:
        """Append the event of one step; NaN and infinity become null."""
        with writable(self.path):
            self._file.write(_line({"step": step, **values}))

    def flush(self) -> None:
        """Flush the log and sync it to the disk, so that it never lags behind a checkpoint."""
        with writable(self.path):
            self._file.flush()
            os.fsync(self._file.fileno())

    def close(self) -> None:
        """Flush and close the log, which takes no further events."""
        with writable(self.path):
            self._file.close()


def read_events(path: Path) -> list[dict]:
    """Return all events of a log in file order; null is NaN, and an invalid line, as a killed run may leave, is skipped."""
    events = []
    for line in io.BytesIO(read_file(path, path.parent, MAX_BYTES, "restore it, or fit again")):
        try:
            event = schema.parse(line)
            _SERIES(event, "")
            _STEP(event, "")
        except schema.SchemaError:
            continue
        events.append({k: math.nan if v is None else v for k, v in event.items()})
    return events


def _line(event: dict) -> bytes:
    """Return an event as a line; numbers that are not finite become null, because JSON cannot hold them."""
    return (json.dumps(plain(event)) + "\n").encode()
