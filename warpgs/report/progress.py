"""Progress display of a fit: lines on its set-up; then a live panel in a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable

from warpgs.runtime.terminal import say

PLAIN_INTERVAL = 10.0
"""Seconds between two plain lines."""
STAGE_INTERVAL = 5.0
"""Seconds between two lines on one stage of the set-up."""
SMOOTHING = 0.05
"""Weight of the newest value in the running means shown."""


def duration(seconds: float) -> str:
    """Return a time span in words: 8 s, 2 min 05 s, 1 h 10 min."""
    seconds = int(round(seconds))
    if seconds < 60:
        return f"{seconds} s"
    if seconds < 3600:
        return f"{seconds // 60} min {seconds % 60:02d} s"
    return f"{seconds // 3600} h {seconds % 3600 // 60:02d} min"


class Stages:
    """Lines on what is done before the first step, such as ``finding depth: view 7 of 24``.

    What stands before the colon names a stage. The first line of a stage is shown at once, and then one every few seconds.
    """

    def __init__(self, show: Callable[[str], object] = say):
        """Show lines by ``show``."""
        self.show, self.printed = show, {}

    def __call__(self, line: str) -> None:
        """Show a line, unless its stage had one a moment ago."""
        stage, now = line.rpartition(":")[0] or line, time.perf_counter()
        if now - self.printed.get(stage, -STAGE_INTERVAL) >= STAGE_INTERVAL:
            self.printed[stage] = now
            self.show(line)


class Progress:
    """Context manager that shows step, loss, PSNR, number of Gaussians, time per step and time left."""

    def __init__(self, total: int, done: int = 0, *, live: bool | None = None):
        """Prepare for ``total`` steps of which ``done`` are done; ``live`` None shows the panel where stdout is a terminal."""
        self.total, self.first, self.step = total, done, done
        self.live = sys.stdout.isatty() if live is None else live
        self.loss = self.psnr = None
        self.count, self.began, self.printed = 0, time.perf_counter(), 0.0
        self.display = None

    def __enter__(self) -> Progress:
        """Start the display."""
        if self.live:
            from rich.live import Live

            self.display = Live(self._panel(), refresh_per_second=8)
            self.display.__enter__()
        return self

    def __exit__(self, *error) -> None:
        """Show the last state and stop."""
        if self.display is not None:
            self.display.update(self._panel())
            self.display.__exit__(*error)
        elif error[0] is None and self.step > self.first:
            say(self._line())

    def update(self, *, step: int, loss: float, psnr: float, count: int) -> None:
        """Show the numbers of one finished step."""
        self.step, self.count = step, count
        keep = 1 - SMOOTHING
        self.loss = loss if self.loss is None else keep * self.loss + SMOOTHING * loss
        self.psnr = psnr if self.psnr is None else keep * self.psnr + SMOOTHING * psnr
        now = time.perf_counter()
        if self.display is not None:
            self.display.update(self._panel())
        elif now - self.printed >= PLAIN_INTERVAL:
            self.printed = now
            say(self._line())

    def _times(self) -> tuple[float, float]:
        seconds = (time.perf_counter() - self.began) / max(1, self.step - self.first)
        return seconds, seconds * (self.total - self.step)

    def _values(self) -> list[tuple[str, str]]:
        seconds, left = self._times()
        return [
            ("step", f"{self.step:,} of {self.total:,}"),
            ("loss", "-" if self.loss is None else f"{self.loss:.4f}"),
            ("train PSNR", "-" if self.psnr is None else f"{self.psnr:.2f} dB"),
            ("Gaussians", f"{self.count:,}"),
            ("per step", f"{1000 * seconds:.0f} ms" if self.step > self.first else "-"),
            ("left", duration(left) if self.step > self.first else "-"),
        ]

    def _line(self) -> str:
        return "  ".join(f"{name} {value}" for name, value in self._values())

    def _panel(self):
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table

        table = Table.grid(padding=(0, 3))
        names, values = zip(*self._values())
        table.add_row(*names, style="dim")
        table.add_row(*values, style="bold")
        # Alone, the bar does not end its line, and the names would follow on it; a grid row does.
        bar = Table.grid()
        bar.add_row(ProgressBar(total=self.total, completed=self.step, width=78))
        return Group(bar, table)
