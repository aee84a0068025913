"""Functions that are recorded: when, how often, and what they give where they are not."""

import warnings

import pytest
import torch

from warpgs.runtime.allocator import Arena
from warpgs.runtime.cuda_graph import FREE, PAID, VARIANTS, GraphedFunction, GraphPool

CPU = torch.device("cpu")


class Full(GraphPool):
    """Memory is never enough to record in, as turns out at the end."""

    def capture(self, work):
        work()
        raise torch.OutOfMemoryError


class Noted(GraphPool):
    """Graphs that only count, at addresses that the test chooses."""

    def __init__(self):
        super().__init__(CPU)
        self.captures = 0

    def capture(self, work):
        self.captures += 1
        return self, None

    def replay(self):
        pass


def doubled(allocator, x):
    out, half = allocator.output(x.shape, x.dtype, CPU), allocator.saved(x.shape, x.dtype, CPU)
    torch.add(x, x, out=out)
    torch.mul(x, 0.5, out=half)
    return (half,)


@pytest.fixture
def places(monkeypatch) -> list[int]:
    """Numbers that stand for the addresses of the calls to come; the last stays."""
    to_come = [0]
    monkeypatch.setattr(Arena, "addresses", lambda self: (to_come.pop(0) if len(to_come) > 1 else to_come[0],))
    return to_come


def test_kernels_are_recorded_once_for_each_set_of_addresses(places):
    """A loop that alternates between two; and where an input moved."""
    own, x = Noted(), torch.ones(4)
    work = GraphedFunction(doubled, own)
    places[:] = [1, 2] * 10
    for _ in range(20):
        work(x)
    assert own.captures == 2 and work.replays == 20 == own.replays
    work(torch.ones(4))
    work(x)
    assert own.captures == 3


def test_addresses_that_always_change_are_soon_let_be(places):
    """And a loop that has replayed long enough may move now and then, and keeps the graphs of the last moves."""
    own, x = Noted(), torch.ones(4)
    work = GraphedFunction(doubled, own)
    places[:] = list(range(1000))
    for _ in range(999):
        work(x)
    assert own.captures == FREE + 1
    own = Noted()
    work = GraphedFunction(doubled, own)
    places[:] = [k // (2 * PAID) for k in range(2000)]
    for _ in range(1999):
        work(x)
    assert own.captures == 2000 // (2 * PAID) + 1 and work.replays == 1999
    places[:] = [2000 // (2 * PAID) - k for k in range(VARIANTS)] + [0]
    for _ in range(VARIANTS):
        work(x)
    assert own.captures == 2000 // (2 * PAID) + 1


def test_what_cannot_be_recorded_for_want_of_memory_is_done_all_the_same():
    """The same values, and what is kept is found in the block of its own call."""
    work = GraphedFunction(doubled, Full(CPU))
    calls = [work(torch.full((4,), float(k))) for k in range(2 * FREE)]
    for k, ((out,), block) in enumerate(calls):
        assert torch.equal(out, torch.full((4,), 2.0 * k)) and torch.equal(work.kept(block)[0], torch.full((4,), 0.5 * k))
    assert work.replays == 0 and work.recorded == FREE + 1


def test_a_driver_that_cannot_record_is_told_once_and_work_goes_on():
    """Until somebody asks to begin anew."""

    class Refusing(GraphPool):
        def capture(self, work):
            raise RuntimeError("operation not permitted")

    own = Refusing(CPU)
    work = GraphedFunction(doubled, own)
    with pytest.warns(UserWarning, match="not recorded from here on.*operation not permitted"):
        (out,), block = work(torch.ones(4))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        work(torch.zeros(4))
    assert own.failed and work.recorded == 1 and float(out[0]) == 2 and float(work.kept(block)[0][0]) == 0.5
    own.release()
    assert not own.failed
