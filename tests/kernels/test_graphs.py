"""Functions that are captured: when, how often, and their results where they are not."""

import warnings

import pytest
import torch

from warpgs.kernels.graphs import FREE_CAPTURES, Arena, CapturedGraph, GraphedFunction, GraphMemory, GraphPool
from warpgs.kernels.update import Setting, opacity_dropout

CPU = torch.device("cpu")


class Full(GraphPool):
    """A pool whose captures run out of memory at the end."""

    def capture(self, work):
        work()
        raise torch.OutOfMemoryError


class Noted(GraphPool):
    """A pool that counts captures, and whose graphs do nothing."""

    def __init__(self):
        super().__init__(CPU)
        self.captures = 0

    def capture(self, work):
        self.captures += 1
        return self

    def replay(self):
        pass


def doubled(allocator, x):
    out, half = allocator.output(x.shape, x.dtype, CPU), allocator.saved(x.shape, x.dtype, CPU)
    torch.add(x, x, out=out)
    torch.mul(x, 0.5, out=half)
    return (half,)


@pytest.fixture
def places(monkeypatch) -> list[int]:
    """Fake addresses of the calls to come; the last one stays."""
    to_come = [0]
    monkeypatch.setattr(Arena, "addresses", lambda self: (to_come.pop(0) if len(to_come) > 1 else to_come[0],))
    return to_come


def test_kernels_are_captured_once_for_each_set_of_addresses(places):
    """Two sets in turn are captured twice; addresses that always change are soon captured no more."""
    for addresses, count, captures in (([1, 2] * 10, 20, 2), (list(range(1000)), 999, FREE_CAPTURES + 1)):
        own, x = Noted(), torch.ones(4)
        work = GraphedFunction(doubled, own)
        places[:] = addresses
        for _ in range(count):
            work(x)
        assert own.captures == captures and work.replays == own.replays
    assert 0 < own.replays < 999


def test_without_memory_or_after_a_failed_capture_the_function_still_runs():
    work = GraphedFunction(doubled, Full(CPU))
    calls = [work(torch.full((4,), float(k))) for k in range(2 * FREE_CAPTURES)]
    for k, ((out,), block) in enumerate(calls):
        assert torch.equal(out, torch.full((4,), 2.0 * k)) and torch.equal(work.saved(block)[0], torch.full((4,), 0.5 * k))
    assert work.replays == 0 and work.captures == FREE_CAPTURES + 1

    class Refusing(GraphPool):
        def capture(self, work):
            raise RuntimeError("operation not permitted")

    own = Refusing(CPU)
    work = GraphedFunction(doubled, own)
    with pytest.warns(UserWarning, match="no longer captured as CUDA graphs.*operation not permitted"):
        (out,), block = work(torch.ones(4))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        work(torch.zeros(4))
    assert own.failed and work.captures == 1 and float(out[0]) == 2 and float(work.saved(block)[0][0]) == 0.5
    own.release()
    assert not own.failed


@pytest.mark.cuda
def test_a_captured_graph_replays_torch_and_warp():
    """Kernels of both read new inputs at each replay, the result stays alive, and a second graph shares the memory."""
    cuda = torch.device("cuda", 0)
    settings, stream = torch.tensor([0.5, 1.0, 0.0, 0.0, 0.0, 0.0, 0.0], device=cuda), torch.cuda.Stream()

    def work():
        return 2 * opacity_dropout(1000, settings, 7)

    work()
    stream.wait_stream(torch.cuda.current_stream())
    graph = CapturedGraph(work, stream)
    second = CapturedGraph(work, stream, graph.pool())
    torch.cuda.current_stream().wait_stream(stream)
    for step in (1.0, 2.0, 3.0):
        settings[Setting.NUMBER] = step
        for each in (graph, second):
            each.replay()
            assert torch.equal(each.result, work())


@pytest.mark.cuda
def test_memory_of_gone_graphs_is_given_back_beyond_a_limit():
    """Below the limit nothing happens; above it torch holds less."""
    cuda = torch.device("cuda", 0)
    torch.cuda.empty_cache()
    account = GraphMemory(cuda)
    large = torch.empty(2**31, dtype=torch.uint8, device=cuda)
    del large
    before = torch.cuda.memory_reserved(cuda)
    account.give_back(2**33)
    assert torch.cuda.memory_reserved(cuda) == before > account.reserved
    account.give_back(0)
    assert torch.cuda.memory_reserved(cuda) < before and account.reserved == torch.cuda.memory_reserved(cuda)
