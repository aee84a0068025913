"""The table of a farm, on the terminal and as a page."""

from __future__ import annotations

import re
import sys
import textwrap
import time
from collections import Counter, defaultdict
from typing import Any

from warpgs.device import format_bytes
from warpgs.pipeline.farm.job import JobRecord
from warpgs.process import careful, printable, say
from warpgs.report.page import rendered
from warpgs.report.progress import PLAIN_INTERVAL, duration, is_live, waiting

STATES = ("waiting", "running", "elsewhere", "done", "failed")
STYLES = {"running": "bold", "elsewhere": "dim", "done": "green", "failed": "bold red"}
LAST = 6
"""Number of rows for the jobs that ended last."""
MOST_RUNNING = 12
"""Largest number of rows for running jobs."""


def row_values(row: JobRecord) -> tuple[str, ...]:
    """Return the cells of a row: name, state, steps, time, PSNR, Gaussians, message."""
    return (
        row.name, row.state, f"{row.steps:,}" if row.steps else "", duration(row.seconds) if row.seconds else "",
        "" if row.psnr is None else f"{row.psnr:.2f} dB", f"{row.gaussians:,}" if row.gaussians else "", row.message,
    )  # fmt: skip


class FarmTable:
    """Context manager that shows the numbers of jobs by state, the running jobs, the last finished jobs, and the time left."""

    def __init__(self, *, live: bool | None = None):
        """Prepare; ``live`` None shows the table only in a terminal."""
        self.live = is_live() if live is None else live
        self.began = self.printed = time.monotonic()
        self.rows: list[JobRecord] = []
        self.left: float | None = None
        self.ended: dict[str, JobRecord] = {}
        self.display: Any = None

    def __enter__(self) -> FarmTable:
        """Start the display."""
        if self.live:
            from rich.console import Console
            from rich.live import Live

            waiting().clear()
            self.display = Live(self.panel(), console=Console(file=careful(sys.stdout)), refresh_per_second=4)
            self.display.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        """Show the last state and stop."""
        if self.display is not None:
            self.display.update(self.panel())
            self.display.__exit__(*error)
        elif error[0] is not None:
            say(self.summary())

    def update(self, rows: list[JobRecord], left: float | None) -> None:
        """Show the jobs, and the time left [s] where it is known."""
        ended = [r for r in rows if r.state in ("done", "failed") and r.name not in self.ended]
        self.ended |= {r.name: r for r in ended}
        self.rows, self.left = rows, left
        if self.display is not None:
            self.display.update(self.panel())
            return
        for row in ended:
            say("  ".join(filter(None, row_values(row))))
        if ended or time.monotonic() - self.printed >= PLAIN_INTERVAL:
            self.printed = time.monotonic()
            say(self.summary())

    def summary(self) -> str:
        """Return the numbers of jobs by state, the time that passed, and the time left."""
        counts = Counter(r.state for r in self.rows)
        states = "  ".join(f"{counts[s]:,} {s}" for s in STATES if counts[s] or s != "elsewhere")
        left = "" if self.left is None or not self.left else f"  left {duration(self.left)}"
        return f"{states}  after {duration(time.monotonic() - self.began)}{left}"

    def panel(self) -> Any:
        """Return the table."""
        from rich.console import Group
        from rich.progress_bar import ProgressBar
        from rich.table import Table
        from rich.text import Text

        table = Table(box=None, padding=(0, 2, 0, 0), header_style="dim")
        for name in ("scene", "state", "step", "time", "PSNR", "Gaussians"):
            table.add_column(name, justify="left" if name in ("scene", "state") else "right", no_wrap=True)
        last, running = [*self.ended.values()][: -LAST - 1 : -1], [r for r in self.rows if r.state == "running"]
        for row in [*running[:MOST_RUNNING], *last]:
            table.add_row(*(Text(printable(c)) for c in row_values(row)[:-1]), style=STYLES.get(row.state, ""))
        bar = Table.grid()  # alone, the bar does not end its line
        bar.add_row(ProgressBar(total=max(1, len(self.rows)), completed=len(self.ended), width=78))
        more = len(running) - MOST_RUNNING
        rest = [Text(f"and {more} more running", style="dim")] if more > 0 else []
        messages = [
            Text(printable(f"{r.name}: {r.message}"), style="dim", no_wrap=True, overflow="ellipsis") for r in last if r.message
        ]
        return Group(bar, Text(self.summary(), style="bold"), table, *rest, *messages)


SHORT = 120
"""Largest number of letters of a message on a card; the table of failures shows the whole message."""


def _facts(row: JobRecord) -> str:
    """Return a card's text: scores and sizes, the message of a failure, or the state."""
    _, _, _, seconds, psnr, gaussians, message = row_values(row)
    failed = row.state == "failed"
    facts = [
        psnr and f"PSNR {psnr}", "" if row.ssim is None else f"SSIM {row.ssim:.3f}", gaussians and f"{gaussians} Gaussians",
        format_bytes(row.ply_bytes) if row.ply_bytes else "", "" if failed else seconds,
        textwrap.shorten(message, SHORT, placeholder=" ...") if failed else "",
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
    given = [(row, _facts(row), *paths) for row, *paths in cards]
    return rendered("farm.html", title=title, line=line, figures=figures, failures=_failures(rows), cards=given)
