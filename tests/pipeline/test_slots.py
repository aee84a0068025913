"""Sums over slots: one order for any number of processes."""

import threading
from collections.abc import Callable

import pytest
import torch

from warpgs.errors import UsageError
from warpgs.pipeline.train import batch as train_slots
from warpgs.pipeline.train.batch import SlotSums, Tree, check_ranks, check_renders, own_slots
from warpgs.ranks import ALONE, Ranks

SHAPES = [(7, 3), (7,), (5,)]


class Thread(Ranks):
    """One of several threads that exchange as processes do."""

    def __init__(self, rank: int, count: int, desk: list, barrier: threading.Barrier):
        self.rank, self.count, self.desk, self.barrier = rank, count, desk, barrier

    def _put(self, value):
        self.desk[self.rank] = value
        self.barrier.wait(30)
        found = list(self.desk)
        self.barrier.wait(30)
        return found

    def to_each(self, sent):
        return torch.stack([other[self.rank].clone() for other in self._put(sent)])

    def gather(self, own, found):
        found.copy_(torch.cat(self._put(own)))


def summed(slots: list[list[torch.Tensor]], ranks: Ranks, means: int = 0) -> list[torch.Tensor]:
    """The sums of the tensors of slots, as one process gets them."""
    sums = SlotSums(Tree(len(slots), ranks), [tuple(t.shape) for t in slots[0]], torch.device("cpu"), means=means, large=1)

    def add(slot, parts, adds):
        for part, value in zip(parts, slots[slot], strict=True):
            part.add_(value) if adds else part.copy_(value)

    parts = sums.add_up(add)
    assert bool(sums.divided) == (ranks.count > 1 and 4 * parts[1].numel() >= train_slots.DIVIDED_BYTES)
    if sums.divided:
        assert sums.divided + 16 * ranks.count > len(parts[1])
        sums.sum_own_rows()
        sums.share(parts[1])
    return [part.clone() for part in parts]


def by_threads(work: Callable[[Ranks], object], count: int) -> list:
    """What each of several processes gets from its work."""
    desk, barrier, found = [None] * count, threading.Barrier(count), [None] * count

    def run(rank: int) -> None:
        found[rank] = work(Thread(rank, count, desk, barrier))

    threads = [threading.Thread(target=run, args=(rank,)) for rank in range(count)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    return found


@pytest.mark.parametrize("batch", [2, 3, 5, 8, 13])
def test_any_number_of_processes_gets_the_same_bits(batch):
    """Also where slots are not spread evenly; and they are the sums, but for float32's rounding."""
    random = torch.Generator().manual_seed(batch)
    slots = [[torch.randn(s, generator=random) * 10.0 ** (k % 5) for s in SHAPES] for k in range(batch)]
    alone = summed(slots, ALONE)
    for part, *values in zip(alone, *slots, strict=True):
        exact = torch.stack(values).double()
        assert ((part - exact.sum(0)).abs() <= 2**-23 * batch.bit_length() * exact.abs().sum(0)).all()
    for count in range(2, min(batch, 6) + 1):
        for found in by_threads(lambda ranks: summed(slots, ranks), count):
            assert all(torch.equal(a, b) for a, b in zip(alone, found, strict=True))


def test_rows_of_a_large_tensor_are_divided_and_means_are_sums_over_slots(monkeypatch):
    """Each process has the sums of its own rows; a tensor that becomes a mean is divided by the slots, and no other."""
    random = torch.Generator().manual_seed(0)
    slots = [[torch.randn(s, generator=random) for s in ((7, 3), (501, 4), (5,))] for _ in range(6)]
    alone, sums = summed(slots, ALONE, means=2), summed(slots, ALONE)
    assert all(torch.equal(a, b * (1 / 6 if k < 2 else 1)) for k, (a, b) in enumerate(zip(alone, sums, strict=True)))
    monkeypatch.setattr("warpgs.pipeline.train.batch.DIVIDED_BYTES", 501 * 16)
    for count in (2, 3):
        for found in by_threads(lambda ranks: summed(slots, ranks, means=2), count):
            assert all(torch.equal(a, b) for a, b in zip(alone, found, strict=True))


@pytest.mark.parametrize(("batch", "ranks"), [(8, 1), (8, 3), (7, 4), (5, 5)])
def test_every_slot_is_in_one_process_and_one_node(batch, ranks):
    """The slots of the processes, and those of the nodes that they sum, are all slots from the first to the last."""
    assert [s for r in range(ranks) for s in own_slots(batch, ranks, r)] == list(range(batch))
    tree = Tree(batch, Thread(ranks - 1, ranks, [], threading.Barrier(1)))
    assert [s for nodes in tree.nodes for first, end in nodes for s in range(first, end)] == list(range(batch))


@pytest.mark.parametrize(("batch", "ranks"), [(12, 2), (24, 4), (32, 3)])
def test_every_process_plans_the_same_memory(batch, ranks):
    """Also where processes sum different subtrees: with a memory limit, different plans would end in different models."""
    trees = [Tree(batch, Thread(r, ranks, [], threading.Barrier(1))) for r in range(ranks)]
    assert len({tree.buffers for tree in trees}) == 1


def test_a_process_without_a_view_is_refused():
    """And so are fits whose renders cannot be numbered."""
    with pytest.raises(UsageError, match="give --batch 4 or a multiple"):
        check_ranks(3, Thread(0, 4, [], threading.Barrier(1)))
    with pytest.raises(UsageError, match="renders; lower --steps or --batch"):
        check_renders(1000, 20_000)
