"""What the fuzzer bounds is bounded: time of the processor, memory beyond the result; and it knows what gets past a check."""

import numpy as np
import pytest

from tests.faults import bounds, fuzz
from tests.faults.bounds import size_of
from tests.faults.fuzz import JUDGED, Tally, Worker, shallow, shares
from tests.faults.targets import Target, all_targets
from warpgs.errors import DataError

LARGE = 100 * 2**20


def read(folder, path):
    """Read a file whose first letter says what to do."""
    data = path.read_bytes() if path.is_file() else b""
    if not data.startswith(b"ok"):
        raise DataError(f"{path}: does not begin as these files do; write it again")
    if data == b"ok allocate":
        np.ones(LARGE, np.uint8)
    if data == b"ok return":
        return np.ones(LARGE, np.uint8)
    while data == b"ok loop":
        pass
    return data


def worker(folder, data: bytes) -> Worker:
    """Return a worker that reads one input, without the limits that only a process of its own can have."""

    def prepare(root):
        (root / "a").write_bytes(b"ok")
        return [root / "a"]

    made = Worker(Target("planted", prepare, read, (read,)), 0, folder, measured=True)
    made.put = lambda index: ((folder / "a").write_bytes(data), (folder / "a", data, False))[1]
    return made


@pytest.mark.skipif(bounds.sys.platform != "linux", reason="memory is measured on Linux alone")
@pytest.mark.parametrize("data, kinds", [(b"ok allocate", ["memory"]), (b"ok return", []), (b"ok", [])])
def test_memory_beyond_the_result_is_noticed(data, kinds, tmp_path):
    made = worker(tmp_path, data)
    made.run(0)
    assert list(made.tally.kinds) == kinds


@pytest.mark.skipif(not hasattr(bounds.signal, "setitimer"), reason="Windows has no timers")
def test_an_endless_loop_is_a_hang(tmp_path, monkeypatch):
    """By the processor's time, so that the load of the machine is nothing to it."""
    monkeypatch.setattr(bounds, "LIMIT", 0.05)
    before = [bounds.signal.getsignal(s) for s in (bounds.signal.SIGPROF, bounds.signal.SIGALRM)]
    bounds.catch_timers()
    try:
        made = worker(tmp_path, b"ok loop")
        made.run(0)
    finally:
        for s, handler in zip((bounds.signal.SIGPROF, bounds.signal.SIGALRM), before):
            bounds.signal.signal(s, handler)
    assert list(made.tally.kinds) == ["hang"]


def test_slow_code_that_swallows_the_exception_is_a_hang(tmp_path, monkeypatch):
    monkeypatch.setattr(fuzz, "LIMIT", -1)
    made = worker(tmp_path, b"ok")
    made.run(0)
    assert list(made.tally.kinds) == ["hang"]


@pytest.mark.parametrize("data, past", [(b"", 0), (b"xx", 0), (b"ok", 1), (b"ok more", 1)])
def test_the_first_check_is_told_from_later_ones(data, past, tmp_path):
    made = worker(tmp_path, data)
    made.run(0)
    assert made.tally.past == past and not made.tally.failures


def test_too_few_past_the_first_check_fail():
    assert shallow(Tally("a", inputs=100, past=9)) and not shallow(Tally("a", inputs=100, past=10))
    assert not shallow(Tally("a", inputs=JUDGED - 1)) and shallow(Tally("a", inputs=JUDGED))


def test_sizes_of_results():
    array = np.zeros(1000, np.float32)
    assert 4000 <= size_of({"a": array, "b": (array, b"x" * 100)}) < 5000  # the same array counts once


def test_every_reader_gets_inputs():
    counts = shares(list(all_targets()), 200_000)
    assert sum(counts.values()) >= 200_000 and min(counts.values()) >= JUDGED
