"""The index of a farm and its live table: every job, whatever it is called."""

import io

from rich.console import Console

from warpgs.report.farm import FarmTable, JobCard, JobRow, farm_page

ROWS = [
    JobRow("a", "done", 500, 61.0, 25.5, 1200), JobRow("b\x1b[31m", "running", 40, 3.0), JobRow("c", "waiting"),
    JobRow("d", "failed", message="d: no images <b>"), JobRow("e", "failed", message="e: no images <b>"),
]  # fmt: skip


def test_failures_are_counted_by_message():
    """The name of the scene in it makes no other message; nothing of a name is markup."""
    page = farm_page("a & b", [JobCard(r, thumbnail="x y/t.jpg" if r.name == "a" else "") for r in ROWS], 90)
    assert "<td>SCENE: no images &lt;b&gt;</td><td>2</td><td>d, e</td>" in page and "<h1>a &amp; b</h1>" in page
    assert 'src="x%20y/t.jpg"' in page and "2 jobs are not done yet" in page and "25.50 dB" in page


def test_the_table_shows_running_jobs_the_last_ones_and_the_time_left():
    table = FarmTable(live=True)
    table.display = type("Live", (), {"update": lambda self, panel: None})()
    table.update(ROWS, 75.0)
    console = Console(file=io.StringIO(), width=100)
    console.print(table.panel())
    text = console.file.getvalue()
    assert "1 waiting  1 running  1 done  2 failed" in text and "left 1 min 15 s" in text
    assert "25.50 dB" in text and "\x1b" not in text and "\\x1b[31m" in text


def test_without_a_terminal_each_job_is_a_line_once(capsys):
    with FarmTable(live=False) as table:
        table.update(ROWS, None)
        table.update(ROWS, None)
    lines = capsys.readouterr().out.splitlines()
    assert [line.split("  ")[0] for line in lines[:3]] == ["a", "d", "e"] and len(lines) == 4
