"""Steps of several views, sums over slots in one order for any number of processes, and recorded steps."""

import dataclasses
import threading
from collections.abc import Callable

import numpy as np
import pytest
import torch

from tests.example_terms import DepthCorrelation
from tests.pipeline.test_paper import CONFIG as METHOD
from tests.pipeline.train.fits import advanced, continued, same_bits
from tests.scenes import photos, priors, seeds
from warpgs.errors import NotFiniteError, UsageError
from warpgs.kernels.update import Setting, scheduled_lrs
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train import batch as train_slots, step
from warpgs.pipeline.train.batch import BatchSteps, SlotSums, Tree, check_ranks, own_slots
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import OptimizerConfig, PhaseConfig
from warpgs.pipeline.train.settings import FitConfig, settings_by_views
from warpgs.pipeline.train.step import MAX_STEPS, StepBuffers, instance_capacity, steps_at_once
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.ranks import ALONE, Ranks
from warpgs.scene import View

# Sums over slots: one order for any number of processes.

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
    random = torch.Generator().manual_seed(0)
    slots = [[torch.randn(s, generator=random) for s in ((7, 3), (501, 4), (5,))] for _ in range(6)]
    alone, sums = summed(slots, ALONE, means=2), summed(slots, ALONE)
    assert all(torch.equal(a, b * (1 / 6 if k < 2 else 1)) for k, (a, b) in enumerate(zip(alone, sums, strict=True)))
    monkeypatch.setattr("warpgs.pipeline.train.batch.DIVIDED_BYTES", 501 * 16)
    for count in (2, 3):
        for found in by_threads(lambda ranks: summed(slots, ranks, means=2), count):
            assert all(torch.equal(a, b) for a, b in zip(alone, found, strict=True))


@pytest.mark.parametrize(("batch", "ranks"), [(5, 5), (7, 4), (12, 2), (32, 3)])
def test_every_process_plans_the_same_memory_and_every_slot_is_in_one(batch, ranks):
    """Also where processes sum different subtrees: with a memory limit, different plans would end in different models."""
    trees = [Tree(batch, Thread(r, ranks, [], threading.Barrier(1))) for r in range(ranks)]
    assert len({tree.buffers for tree in trees}) == 1
    assert [s for r in range(ranks) for s in own_slots(batch, ranks, r)] == list(range(batch))
    assert [s for nodes in trees[0].nodes for first, end in nodes for s in range(first, end)] == list(range(batch))


def test_a_process_without_a_view_is_refused():
    with pytest.raises(UsageError, match="give a multiple"):
        check_ranks(3, Thread(0, 4, [], threading.Barrier(1)))


# Steps of several views.

CPU = torch.device("cpu")
PLAIN = FitConfig(steps=20, init=InitConfig(source="points"), density=DensityConfig(start=100))


def test_a_batch_of_one_view_is_a_step_of_one_view():
    """Through dropout, sampling events, layers and protection: the same bits by way of the sums."""
    views = photos(3)
    one, batch = (Trainer(views, seeds(61), METHOD, CPU, priors=priors(views)) for _ in range(2))
    t = batch.taker
    batch.taker = BatchSteps(t.table, t.views, t.strategy, t.cameras, t.options, t.dropout_seed, tree=Tree(1, ALONE))
    advanced(one, 24), advanced(batch, 24)
    assert len(one.strategy.events) > 1 and same_bits(one, batch)


def test_views_of_a_step_share_its_gradient_and_add_to_statistics():
    """The same view four times: its gradient once, at a rate that is twice as high, and its statistics four times."""
    one, four = (Trainer(photos(1), seeds(), dataclasses.replace(PLAIN, batch=b), CPU) for b in (1, 4))
    before = one.gaussians.means.clone()
    said = [fit.advance()[0] for fit in (one, four)]
    assert said[0].loss == pytest.approx(said[1].loss, rel=1e-6) and said[0].psnr == pytest.approx(said[1].psnr, rel=1e-6)
    ways = [fit.gaussians.means - before for fit in (one, four)]
    assert ways[0].abs().max() > 0 and torch.allclose(2 * ways[0], ways[1], rtol=1e-3, atol=1e-7)
    for name in ("grad_sum", "seen_count"):
        assert torch.equal(4 * one.table.columns[name], four.table.columns[name])
    for name, moment in one.table.exp_avg.items():
        assert torch.allclose(moment / (1 - 0.9), four.table.exp_avg[name] / (1 - 0.9**4), rtol=1e-5)
    # with corrections for decay rates to the power of four
    fit = Trainer(photos(2), seeds(), dataclasses.replace(PLAIN, batch=4), CPU)
    row, lrs = fit._lr_row(3), fit.lrs(3)
    assert row[:3] == scheduled_lrs(2 * lrs["means"], 3, (0.9**4, 0.999**4))
    assert (fit.settings(3)[Setting.NUMBER], fit.settings(3)[Setting.MEANS_LR]) == (3, 2 * lrs["means"])
    assert [fit.settings(3, slot)[Setting.NUMBER] for slot in range(4)] == [9, 10, 11, 12]
    assert [fit.settings(3, slot)[Setting.STEP] for slot in range(4)] == [3] * 4


def test_a_fit_with_batches_continues_with_the_same_bits(tmp_path):
    """From a state between two epochs, and through changes of the set."""
    config = dataclasses.replace(
        PLAIN, steps=12, batch=5, dropout=0.3, density=DensityConfig(start=2, every=3, gradient=1e-5, reset_every=6)
    )

    def begun() -> Trainer:
        return Trainer(photos(3), seeds(61), config, CPU)

    whole, again = advanced(begun()), continued(begun, 7, tmp_path)
    assert same_bits(whole, again) and len(whole.table) > 61


def in_series(fit: Trainer) -> Trainer:
    """Have a fit take several steps before it reads their results, as on CUDA, but without graphs."""
    fit.layout.graphs = 1
    fit.taker.buffers = StepBuffers(CPU, fit.taker.buffers.lr_rows.shape[1], MAX_STEPS)
    fit.taker.clear()
    return fit


def test_several_steps_at_once_are_those_one_by_one():
    """With dropout and growth: a series ends before a change of the set, and has the bits of single steps."""
    density = DensityConfig(start=2, every=7, gradient=1e-5, reset_every=14)
    config = dataclasses.replace(PLAIN, batch=5, dropout=0.3, density=density)
    one, many = (Trainer(photos(3), seeds(61), config, CPU) for _ in range(2))
    series = []
    while many.step < 20:
        series.append(in_series(many).advance(100))
    losses = [r.loss for reports in series for r in reports]
    assert [steps_at_once(batch) for batch in (1, 8, 500)] == [100, 25, 1]
    assert max(map(len, series)) == 7 and len(many.table) > 61 and same_bits(advanced(one, 20), many)
    again = Trainer(photos(3), seeds(61), config, CPU)
    assert np.isfinite(losses).all() and losses == [again.advance()[0].loss for _ in range(20)]


def test_a_loss_that_is_no_number_names_its_view_and_ends_a_series():
    views = photos(3)
    bad = View("bad", views[1].camera, np.full_like(views[1].image, np.nan))
    fit = Trainer([views[0], bad, views[2]], seeds(), dataclasses.replace(PLAIN, batch=3), CPU)
    before = {n: t.clone() for n, t in fit.state()[0].items() if n != "generator"}
    with pytest.raises(NotFiniteError, match="became nan at step 1") as found:
        fit.advance()
    order = list(reversed(fit.order))
    assert found.value.view == 1 and order[found.value.slot] == 1 and sorted(order) == [0, 1, 2] and fit.step == 0
    assert all(torch.equal(before[n], t) for n, t in fit.state()[0].items() if n in before)
    # in step 3 of 10: two steps are taken, and the views of the others come again
    views = photos(9)
    views[4] = View("bad", views[4].camera, np.full_like(views[4].image, np.nan))
    config = dataclasses.replace(PLAIN, batch=2, steps=10)
    one, many = (Trainer(views, seeds(), config, CPU) for _ in range(2))
    for fit in (one, in_series(many)):
        fit.order = [8, 7, 6, 4, 5, 3, 2, 1, 0]
    with pytest.raises(NotFiniteError, match="became nan at step 3") as found:
        many.advance(100)
    assert found.value.view == 4 and found.value.slot == 1 and many.step == 2
    assert many.order[-5:] == [8, 7, 6, 4, 5] and same_bits(advanced(one, 2), many, ("generator",))


def test_a_view_beyond_the_capacity_ends_a_series_which_is_taken_up_again(monkeypatch):
    """It stops steps in the middle of a series, as a graph with too little capacity does: their bits do not change."""
    config = dataclasses.replace(PLAIN, batch=3, dropout=0.3, steps=12)
    one, many = (Trainer(photos(3), seeds(61), config, CPU) for _ in range(2))
    honest, calls = BatchSteps.view_gradients, []

    def overflowing(taker, views, buffers, *rest):
        calls.append(1)
        found = honest(taker, views, buffers, *rest)
        if len(calls) in (8, 30):
            buffers.stop.fill_(1)
        return found

    monkeypatch.setattr(BatchSteps, "view_gradients", overflowing)
    steps = [r.step for _ in range(12) if many.step < 12 for r in in_series(many).advance(100)]
    monkeypatch.undo()
    assert steps == list(range(1, 13)) and len(calls) > 36 and same_bits(advanced(one, 12), many, ("generator",))


def test_ranks_go_on_without_graphs_together():
    views = [*photos(2), *photos(2, 24, 20)]
    config = dataclasses.replace(PLAIN, batch=2, steps=6)

    def fitted(ranks: Ranks) -> Trainer:
        fit = in_series(Trainer(views, seeds(61), config, CPU, ranks=ranks))
        fit.order = [2, 0, 3, 1]
        capacities = [instance_capacity(fit.gaussians, s, 0, fit.context.render_options()) for s in fit.stacks.values()]
        fit.context.max_instances = sum(capacities) // 2
        return advanced(fit, 6)

    alone = Trainer(views, seeds(61), config, CPU)
    alone.order = [2, 0, 3, 1]
    fits = by_threads(fitted, 2)
    assert all("without CUDA graphs" in fit.messages[0] for fit in fits) and all(same_bits(advanced(alone, 6), f) for f in fits)


def test_ranks_that_divide_the_coefficients_have_the_bits_of_one(monkeypatch):
    """Each updates its own rows, and a few are left over. The set of Gaussians grows, and the last steps are averaged."""
    monkeypatch.setattr("warpgs.pipeline.train.batch.DIVIDED_BYTES", 4000)
    density = DensityConfig(start=2, every=4, gradient=1e-5, reset_every=8)
    optimizer = OptimizerConfig(average_last=0.5)
    config = dataclasses.replace(PLAIN, steps=10, batch=5, dropout=0.3, sh_degree=2, density=density, optimizer=optimizer)
    alone = advanced(Trainer(photos(3), seeds(61), config, CPU), 10)
    for count in (2, 3):
        fits = by_threads(lambda ranks: advanced(Trainer(photos(3), seeds(61), config, CPU, ranks=ranks), 10), count)
        assert 0 < fits[0].taker.sums.divided < len(alone.table) and all(same_bits(alone, fit) for fit in fits)


@pytest.mark.parametrize("stopped", [None, 5])
def test_ranks_that_divide_the_coefficients_take_several_steps_at_once(monkeypatch, stopped):
    """Moments are exchanged once for a series, and also where a view stops the series before its end."""
    monkeypatch.setattr("warpgs.pipeline.train.batch.DIVIDED_BYTES", 4000)
    views = photos(9)
    if stopped is not None:
        views[4] = View("bad", views[4].camera, np.full_like(views[4].image, np.nan))
    config = dataclasses.replace(PLAIN, steps=10, batch=2, dropout=0.3, sh_degree=2)
    order = [8, 7, 6, 5, 3, 2, 1, 0, 4]  # step 5 has the bad view
    order.reverse()

    def fitted(ranks: Ranks) -> Trainer:
        fit = in_series(Trainer(views, seeds(61), config, CPU, ranks=ranks))
        fit.order = list(order)
        if stopped is None:
            series = fit.advance(100)
            assert len(series) > 1 and advanced(fit, 10)
        else:
            with pytest.raises(NotFiniteError, match=f"became nan at step {stopped}"):
                fit.advance(100)
        return fit

    alone = Trainer(views, seeds(61), config, CPU)
    alone.order = list(order)
    advanced(alone, 10 if stopped is None else stopped - 1)
    fits = by_threads(fitted, 2)
    assert all(0 < fit.taker.sums.divided for fit in fits)
    assert all(same_bits(alone, fit, () if stopped is None else ("generator",)) for fit in fits)


def test_a_batch_costs_memory_and_on_a_cpu_steps():
    """The plan counts the sums; a time on a CPU is one of renders; and elsewhere steps are those of one view."""
    views = [View(v.name, dataclasses.replace(v.camera, width=3000, height=2000), v.image) for v in photos(4)]
    config = PRESETS["default"]
    for device, fewer in (("cpu", 8), ("cuda", 1)):
        one, eight = (settings_by_views(dataclasses.replace(config, batch=b), views, device)[0].steps for b in (1, 8))
        assert 0 < one // fewer <= eight <= one // fewer + 1  # a part of a step on a CPU does not depend on the batch
    views = photos(4)
    one, eight = (Trainer(views, seeds(), dataclasses.replace(PLAIN, batch=b), CPU).layout for b in (1, 8))
    assert eight.held(1000) - one.held(1000) == 3 * (one.table.row_bytes + 8) * 1000


# Recorded steps on CUDA: the same bits as step by step, whatever happens on the way.

BUSY = FitConfig(
    steps=60, sh_every=15, init=InitConfig(source="points"),
    density=DensityConfig(start=8, every=9, gradient=1e-5, reset_every=25), optimizer=OptimizerConfig(opacities_decay=0.002),
)  # fmt: skip


def fitted(views: list[View], recorded: bool, config: FitConfig = BUSY) -> tuple[Trainer, list]:
    config = dataclasses.replace(config, cuda_graph=recorded)
    fit = Trainer(views, seeds(61), config, torch.device("cuda", 0), priors=priors(views))
    reports = []
    while fit.step < config.steps:
        reports += fit.advance(100)
    return fit, reports


def four() -> list[View]:
    return photos(4)


def sizes() -> list[View]:
    views = photos(2) + photos(2, 24, 20)
    views = [View(f"{i}", v.camera, v.image) for i, v in enumerate(views)]
    mask = np.ones(views[0].image.shape[:2], bool)
    mask[:, :8] = False
    return [View("masked", views[0].camera, views[0].image, mask), *views[1:]]


def cut_out() -> list[View]:
    """Views that know an opacity, which grows from left to right."""
    views = photos(4)
    alpha = np.linspace(0, 1, views[0].image.shape[1], dtype=np.float32)
    return [dataclasses.replace(v, alpha=np.broadcast_to(alpha, v.image.shape[:2]).copy()) for v in views]


THREE = dataclasses.replace(BUSY, batch=3, dropout=0.2, steps=40)
DEPTH = dataclasses.replace(BUSY, loss_terms=(DepthCorrelation(0.3, 0.7),), half_resolution=0.3)
HALF = dataclasses.replace(BUSY, half_resolution=0.5, antialiased=True)
EVENTS = dataclasses.replace(METHOD, steps=20, phases=PhaseConfig(600, 400))


@pytest.mark.cuda
@pytest.mark.parametrize(
    ("make", "config"),
    [
        *((make, config) for make in (four, sizes, cut_out) for config in (BUSY, THREE)), (four, DEPTH), (sizes, DEPTH),
        (four, HALF), (four, EVENTS),
    ],
)  # fmt: skip
def test_recorded_steps_equal_single_steps(make, config):
    """Through densification, resets, changes of degree and size, dropout, events, protection, and a term that ends."""
    single, said = fitted(make(), recorded=False, config=config)
    recorded, reports = fitted(make(), recorded=True, config=config)
    a, b = single.state()[0], recorded.state()[0]
    assert len(single.gaussians) != 61 and recorded.layout.graphs > 0
    assert config is not EVENTS or (single.strategy.events == recorded.strategy.events and len(single.strategy.events) > 2)
    assert all(torch.equal(a[k], b[k]) for k in a)
    assert [(r.step, r.count) for r in said] == [(r.step, r.count) for r in reports]
    assert np.allclose([r.loss for r in said], [r.loss for r in reports], rtol=1e-6)
    if config is DEPTH:
        without, _ = fitted(make(), recorded=True, config=dataclasses.replace(config, loss_terms=()))
        assert not torch.equal(recorded.gaussians.means[:10], without.gaussians.means[:10])


@pytest.mark.cuda
def test_recordings_do_not_pile_up(monkeypatch):
    """Memory of recordings that are no longer used goes back: a long fit holds no more than a short one of its size."""
    torch.cuda.empty_cache()
    monkeypatch.setattr(step, "DEAD_BYTES", 2**22)
    fit, _ = fitted(photos(4), recorded=True)
    held = []
    for _ in range(40):
        fit.taker.clear()
        fit.step -= 1
        fit.advance(1)
        held.append(torch.cuda.memory_reserved())
    assert max(held[20:]) <= max(held[:10]) + 2**22


@pytest.mark.cuda
@pytest.mark.parametrize("batch", [1, 3])
def test_too_little_capacity_is_found_and_fixed(monkeypatch, batch):
    """Steps that would overflow change nothing; they are captured anew and taken, and the result is the same."""
    config = dataclasses.replace(BUSY, batch=batch)
    reference, _ = fitted(photos(4), recorded=False, config=config)
    honest, tries = step.instance_capacity, []

    def scarce(*args):
        tries.append(honest(*args))
        return 16 if len(tries) % 2 else tries[-1]

    monkeypatch.setattr(step, "instance_capacity", scarce)
    fit, reports = fitted(photos(4), recorded=True, config=config)
    assert len(tries) >= 4
    a, b = reference.state()[0], fit.state()[0]
    assert all(torch.equal(a[k], b[k]) for k in a) and [r.step for r in reports] == list(range(1, 61))


@pytest.mark.cuda
def test_loss_that_is_no_number_stops_before_it_harms():
    views = photos(4)
    bad = [*views[:3], View("bad", views[3].camera, np.full_like(views[3].image, np.nan))]
    config = dataclasses.replace(BUSY, density=DensityConfig(start=1000))
    fit = Trainer(bad, seeds(), config, torch.device("cuda", 0))
    with pytest.raises(NotFiniteError, match="became nan"):
        fit.advance(100)
    assert fit.step < 4 and all(bool(torch.isfinite(t).all()) for t in fit.gaussians.tensors().values())
