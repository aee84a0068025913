"""Readers of foreign files understand them or refuse them with a sentence, whatever was done to the files."""

import os

import pytest

from tests.faults.fuzz import Worker, fuzz, missed, shallow, shares, table
from tests.faults.targets import all_targets, parser_lines
from warpgs.pipeline.metrics import lpips

INPUTS = int(os.environ.get("FUZZ", "2000"))
FEW, ENOUGH = 10_000, 50_000
"""Numbers of inputs from which on the share past the first check is judged, and the lines reached."""
SEED = int(os.environ.get("FUZZ_SEED", "29100"))
NAMES = sorted(all_targets())


@pytest.mark.parametrize("name", NAMES)
def test_a_few_damaged_files(name, tmp_path, monkeypatch):
    monkeypatch.setattr(lpips, "NETS", dict(lpips.NETS))  # the reader of weights is given a small network
    worker = Worker(all_targets()[name], seed=1, folder=tmp_path)
    count = max(1, round(12 * all_targets()[name].share))
    for index in range(count):
        worker.run(index)
    assert not worker.tally.failures
    assert worker.tally.accepted + worker.tally.refused == worker.tally.inputs == count


@pytest.mark.fault
@pytest.mark.parametrize("name", NAMES)
def test_many_damaged_files(name, capfd):
    tally = fuzz(name, shares(NAMES, INPUTS)[name], seed=SEED)
    with capfd.disabled():
        print(f"\n{table([tally])}")
    assert not tally.failures
    assert INPUTS < FEW or not shallow(tally)
    if INPUTS >= ENOUGH:
        assert len(tally.lines) >= all_targets()[name].lines * sum(map(len, parser_lines(all_targets()[name]).values())), (
            missed(tally)
        )


@pytest.mark.parametrize("name", ["png", "model file", "run record"])
def test_the_same_seed_gives_the_same_inputs(name, tmp_path):
    written = []
    for folder in (tmp_path / "a", tmp_path / "b"):
        folder.mkdir()
        worker = Worker(all_targets()[name], seed=3, folder=folder)
        written.append([worker.put(i)[1] for i in range(9)])
    assert written[0] == written[1] and len(set(written[0])) > 5


class Planted:
    """A reader with a defect of each kind, by the first byte of its file."""

    @staticmethod
    def read(folder, path):
        kind = path.read_bytes()[:1] if path.is_file() else b"-"
        if kind == b"r":
            raise KeyError("raw")
        return kind


@pytest.mark.parametrize(
    "data,kind", [(b"raw", "raw"), (b"nonsense", "nonsense"), (b"unexplained", "nonsense"), (b"fine", None)]
)
def test_defects_are_noticed(data, kind, tmp_path):
    """What the fuzzer calls a defect is one: each kind is planted once."""
    from tests.faults.targets import Target

    def prepare(folder):
        (folder / "a").write_bytes(b"fine")
        return [folder / "a"]

    target = Target(
        "planted", prepare, Planted.read, (Planted,), nonsense=lambda found: "nonsense" if found == b"n" else "",
        unexplained=lambda before, after, good, found: "unexplained" if found == b"u" else "",
    )  # fmt: skip
    worker = Worker(target, 0, tmp_path)
    worker.put = lambda index: ((tmp_path / "a").write_bytes(data), (tmp_path / "a", data, True))[1]
    worker.run(0)
    assert list(worker.tally.kinds) == ([kind] if kind else [])
