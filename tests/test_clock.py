"""The clock: its sections leave no gap and share no second, by an injected time."""

import math
import threading

import pytest

from warpgs import clock
from warpgs.clock import Clock, largest, section, timed, times_line


class Time:
    now = 100.0

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def time() -> Time:
    return Time()


def test_sections_sum_to_the_total(time):
    """A nested section stops its parent, the same name adds up, and what is in no section is the rest."""
    watch = Clock(before=2.5, now=time)
    with watch("reading"):
        time.now += 1
        with watch("kernels"):
            time.now += 4
        time.now += 2
    time.now += 0.25
    with watch("kernels"):
        time.now += 8
    found = watch.seconds()
    assert found == {"import": 2.5, "reading": 3, "kernels": 12, "other": 0.25, "total": 17.75}
    assert [*found] == ["import", "reading", "kernels", "other", "total"]
    time.now += 1
    assert watch.seconds() == found | {"other": 1.25, "total": 18.75}  # it runs on
    # a failed section has its time; an open one counts up to now
    watch = Clock(now=time)
    with pytest.raises(ValueError, match="wrong"), watch("scoring"):
        time.now += 3
        raise ValueError("wrong")
    with watch("report"):
        time.now += 1
        assert watch.seconds() == {"scoring": 3, "report": 1, "other": 0, "total": 4}


def test_each_thread_has_its_own_clock(time):
    """Sections without a clock, and those of other threads, count nowhere; a second `timed` is that of the first."""
    with section("nobody asks"):
        time.now += 1
    with timed(Clock(now=time)) as watch:
        with section("steps (phase 1)"):
            time.now += 2

        def beside() -> None:
            with section("warmup"):
                time.now += 0
            with timed() as other:
                assert other is not watch

        thread = threading.Thread(target=beside)
        thread.start()
        thread.join()
        with timed() as inner:
            assert inner is watch
        assert watch.seconds() == {"steps (phase 1)": 2, "other": 0, "total": 2}
    with timed() as later:
        assert later is not watch


def test_the_largest_parts_are_named_once():
    found = {"import": 4.0, "steps (phase 1)": 3.0, "steps (phase 2)": 3.4, "report": 2.0, "other": 0.1, "total": 12.5}
    assert largest(found) == "steps 6 s, import 4 s, report 2 s"
    parts = "import 4.00 s, steps (phase 1) 3.00 s, steps (phase 2) 3.40 s, report 2.00 s, other 0.10 s"
    assert times_line(found).endswith(f"12.50 s: {parts}")
    # the age of this process is at least that of the first line, and unknown without /proc
    assert not clock._age() <= 0


@pytest.mark.parametrize(("age", "counted"), [(0.75, 0.75), (5.25, 0.5), (math.nan, 0.5)])
def test_the_time_before_the_first_line_counts(monkeypatch, age, counted):
    """The process's own start counts, unless it is unknown or a shell had this process before it."""
    monkeypatch.setattr(clock, "FIRST_LINE", 9.5)
    monkeypatch.setattr(clock, "_age", lambda: age)
    assert clock.since_start(now=lambda: 10.0) == counted
