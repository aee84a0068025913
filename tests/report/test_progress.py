import io
import itertools

import pytest

from warpgs.process import counted, say
from warpgs.report import progress as module
from warpgs.report.progress import Progress, Stages, duration, waiting


class Terminal(io.StringIO):
    encoding = "utf-8"

    def isatty(self) -> bool:
        return True


@pytest.fixture
def terminal(monkeypatch):
    """Return a function that puts a terminal, whose text can be read, in the place of stdout; no line is left on it."""

    def put() -> Terminal:
        monkeypatch.setattr("sys.stdout", Terminal())
        monkeypatch.setenv("TERM", "xterm")
        return module.sys.stdout

    yield put
    module._STATUS.clear()


@pytest.fixture
def clock(monkeypatch):
    """Return a clock to set by hand: clock[0] is the time [s]."""
    now = [1000.0]
    monkeypatch.setattr(module.time, "perf_counter", lambda: now[0])
    return now


def test_lines_have_all_values_and_the_last_one_stays(capsys, clock, terminal):
    """Plain lines come with every twentieth of the steps; nothing done prints nothing, and an error passes through."""
    with Progress(100, live=False) as progress:
        for step in range(1, 101):
            clock[0] += 2
            progress.update(step=step, loss=0.25, psnr=20.5, count=12345, seconds=2)
    lines = capsys.readouterr().out.splitlines()
    assert 15 <= len(lines) <= 22
    assert lines[-1] == "fitting: 100 of 100 steps, left 0 s, PSNR 20.50 dB, 12,345 Gaussians, loss 0.2500, 2000 ms per step"
    out = terminal()
    with Progress(10) as progress:
        for step in range(1, 11):
            progress.update(step=step, loss=0.125, psnr=33.0, count=4321, seconds=0.1)
    for word in ("fitting", "1 of 10 steps", "10 of 10", "loss 0.1250", "33.00 dB", "4,321", "left"):
        assert word in out.getvalue()
    module.sys.stdout = io.StringIO()
    with pytest.raises(KeyboardInterrupt), Progress(10) as progress:
        assert progress.stages.live is False
        raise KeyboardInterrupt
    with Progress(10, live=False):
        pass
    assert capsys.readouterr().out == ""


def test_time_left_is_that_of_the_steps_to_come(clock):
    """Steps that took longer than others will, as those that compile do, say nothing of it: there is no time left yet."""
    with Progress(1000, done=400, live=False) as progress:
        progress.update(step=401, loss=0.1, psnr=30.0, count=5)
        assert "401 of 1,000 steps, left -," in progress.line() and progress.line().endswith(" - per step")
        progress.update(step=410, loss=0.1, psnr=30.0, count=5, seconds=2.0)
        assert "410 of 1,000 steps, left 19 min 40 s" in progress.line() and "2000 ms per step" in progress.line()
    # less than a quarter slower is noise; more is told, since a time that stands still is wrong
    left = {}
    with Progress(1000, live=False) as progress:
        for step in range(1, 301):
            seconds = 1.0 if step <= 100 else 1.15 if step <= 200 else 3.0
            progress.update(step=step, loss=0.1, psnr=30.0, count=5, seconds=seconds)
            left[step] = shown_left(progress.line())
    noisy = [left[s] for s in sorted(left) if 1 < s <= 200]
    assert noisy == sorted(noisy, reverse=True)
    assert max(left[s] for s in left if 200 < s <= 300) > 1800


def shown_left(line: str) -> float:
    words = line.rpartition("left ")[2].partition(",")[0].split()
    return sum(float(n) * {"s": 1, "min": 60, "h": 3600}[unit] for n, unit in zip(words[::2], words[1::2]))


@pytest.mark.parametrize("speed", [0.5, 2.0])
def test_time_left_counts_the_growth_to_come_and_does_not_rise(clock, speed):
    """A fit whose steps become three times as slow, on a machine of another speed, with noise and with slow events."""
    planned = [0.1 + 0.2 * min(1.0, max(0.0, (k - 100) / 150)) + 3.0 * (k in (100, 140, 180)) for k in range(600)]
    noise = [(50.0 if k == 0 else (1.0, 1.3, 0.8, 0.9)[k % 4]) * speed for k in range(600)]
    took = [p * n for p, n in zip(planned, noise, strict=True)]
    lines = []
    with Progress(600, planned=planned, live=False) as progress:
        for step, seconds in enumerate(took, 1):
            clock[0] += seconds
            progress.update(step=step, loss=0.1, psnr=30.0, count=5, seconds=seconds)
            lines.append(progress.line())
    left = [(step, shown_left(line)) for step, line in enumerate(lines, 1) if step % 40 == 0]
    assert "left -," in lines[0]  # the first step waits for memory and caches
    assert all(later <= earlier for (_, earlier), (_, later) in itertools.pairwise(left))
    for step, seconds in left[:-1]:
        assert abs(seconds / sum(took[step:]) - 1) < 0.25 or abs(seconds - sum(took[step:])) < 5
    assert len(left) > 7 and left[-1] == (600, 0)


def test_durations_and_stages_of_the_set_up(clock):
    for seconds, text in {
        59.4: "59 s",
        59.6: "1 min 00 s",
        125: "2 min 05 s",
        3599.7: "1 h 00 min",
        4260: "1 h 11 min",
    }.items():
        assert duration(seconds) == text
    # a stage's first line, and one every five seconds; another stage does not wait
    lines = []
    stages = Stages(lines.append)
    for view in range(20):
        stages(f"finding depth: view {view} of 20")
        clock[0] += 1
    for _ in range(3):  # a line is shown once, however often it is said
        stages("compiling kernels")
        clock[0] += 60
    assert lines == [*(f"finding depth: view {v} of 20" for v in (0, 5, 10, 15)), "compiling kernels"]
    lines.clear()
    for frame in range(300):  # ten minutes
        stages(f"rendering: {frame} of 300 frames")
        clock[0] += 2
    assert lines == [f"rendering: {frame} of 300 frames" for frame in range(0, 300, 15)]


def test_in_a_terminal_a_stage_has_one_line_with_a_bar(terminal):
    """Stage and count stand on it; what is said meanwhile stands above; at the end it is gone, and the cursor is there."""
    out = terminal()
    with Stages() as stages:
        for view in counted(range(3), stages, "scoring", "views"):
            assert view in range(3)
        say("a note")
        stages("scoring: 3 of 3 views")
        assert not module._STATUS.display.finished  # spinner and time go on until another stage begins
        assert Stages().live  # what stands before stdout now is still a terminal
        stages("reading fern: image 12")
    text = out.getvalue()
    assert "scoring" in text and "0 of 3 views" in text and "a note\n" in text and "image 12" in text
    assert text.count("scoring\n") == 0 and text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")
    assert module._STATUS.display is None
    # while steps are taken, what is told beside them, such as a wait for kernels, has the line until the next step
    out, stages = terminal(), Stages()
    stages("setting up")
    with Progress(10, live=True) as progress:
        stages("compiling kernels")
        assert module._STATUS.stage == "compiling kernels" and "compiling kernels" in out.getvalue()
        progress.update(step=1, loss=0.1, psnr=20.0, count=5)
        assert module._STATUS.stage == "fitting"
    assert module._STATUS.display is None and out.getvalue().endswith("- per step\n")


def test_a_wait_is_told_to_terminals_alone(monkeypatch, terminal):
    """Not to files and pipes, nor to a terminal that cannot go back."""
    out = terminal()
    waiting()("starting")
    assert "starting" in out.getvalue()
    for change in (lambda: monkeypatch.setenv("TERM", "dumb"), lambda: monkeypatch.setattr("sys.stdout", io.StringIO())):
        module._STATUS.clear()
        change()
        waiting()("starting again")
        assert module._STATUS.display is None and "starting again" not in out.getvalue()
