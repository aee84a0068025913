import pytest

from warpgs.report import progress as module
from warpgs.report.progress import Progress, Stages, duration


@pytest.fixture
def clock(monkeypatch):
    """Return a clock to set by hand: clock[0] is the time [s]."""
    now = [1000.0]
    monkeypatch.setattr(module.time, "perf_counter", lambda: now[0])
    return now


def test_plain_lines_come_about_every_ten_seconds(capsys, clock):
    with Progress(100, live=False) as progress:
        for step in range(1, 101):
            clock[0] += 0.5
            progress.update(step=step, loss=0.25, psnr=20.5, count=12345)
    lines = capsys.readouterr().out.splitlines()
    assert 5 <= len(lines) <= 7
    assert all("\x1b" not in line for line in lines)
    last = lines[-1]
    for word in ("step 100 of 100", "loss 0.2500", "train PSNR 20.50 dB", "Gaussians 12,345", "per step 500 ms", "left 0 s"):
        assert word in last


def test_time_left_is_that_of_the_steps_to_come(capsys, clock):
    with Progress(1000, done=400, live=False) as progress:
        clock[0] += 20
        progress.update(step=410, loss=0.1, psnr=30.0, count=5)
        line = capsys.readouterr().out
    assert "step 410 of 1,000" in line and "per step 2000 ms" in line and "left 19 min 40 s" in line


def test_nothing_done_prints_nothing(capsys):
    with Progress(10, live=False):
        pass
    assert capsys.readouterr().out == ""


def test_an_error_passes_through_unmasked(capsys):
    with pytest.raises(KeyboardInterrupt), Progress(10, live=False):
        raise KeyboardInterrupt


def test_pytest_has_no_terminal_so_lines_are_plain():
    assert Progress(10).live is False


def test_live_view_shows_all_values_and_ends_cleanly(capsys):
    with Progress(10, live=True) as progress:
        for step in range(1, 11):
            progress.update(step=step, loss=0.125, psnr=33.0, count=4321)
    out = capsys.readouterr().out
    for word in ("10 of 10", "0.1250", "33.00 dB", "4,321", "left"):
        assert word in out


@pytest.mark.parametrize(
    "seconds, text",
    [(0, "0 s"), (59.4, "59 s"), (59.6, "1 min 00 s"), (125, "2 min 05 s"), (3599.7, "1 h 00 min"), (4260, "1 h 11 min")],
)
def test_durations(seconds, text):
    assert duration(seconds) == text


def test_stages_of_the_set_up_are_shown_at_once_and_then_every_few_seconds(clock):
    """A stage's first line, and one every five seconds; another stage does not wait."""
    lines = []
    stages = Stages(lines.append)
    for view in range(20):
        stages(f"finding depth: view {view} of 20")
        clock[0] += 1
    stages("compiling kernels")
    stages("compiling kernels")
    assert lines == [*(f"finding depth: view {v} of 20" for v in (0, 5, 10, 15)), "compiling kernels"]
