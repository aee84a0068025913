"""Steps of several views."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.pipeline.test_paper import CONFIG as METHOD
from tests.pipeline.test_slots import by_threads
from tests.scenes import photos, priors, seeds
from warpgs.errors import NotFiniteError
from warpgs.kernels.update import Setting, scheduled_lrs
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train import batch
from warpgs.pipeline.train.batch import BatchSteps, Tree
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import OptimizerConfig
from warpgs.pipeline.train.settings import FitConfig, settings_by_views
from warpgs.pipeline.train.step import MAX_STEPS, StepBuffers, instance_capacity, steps_at_once
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.ranks import ALONE, Ranks
from warpgs.scene import View

CPU = torch.device("cpu")
PLAIN = FitConfig(steps=20, init=InitConfig(source="points"), density=DensityConfig(start=100))


def advanced(fit: Trainer, until: int) -> Trainer:
    while fit.step < until:
        fit.advance(100)
    return fit


def same_bits(a: Trainer, b: Trainer, but: tuple[str, ...] = ()) -> bool:
    mine, theirs = a.state()[0], b.state()[0]
    return all(torch.equal(mine[n], theirs[n]) for n in mine if n not in but)


def test_a_batch_of_one_view_is_a_step_of_one_view():
    """Through dropout, sampling events, layers and protection: the same bits by way of the sums."""
    views = photos(3)
    one, batch = (Trainer(views, seeds(61), METHOD, CPU, priors=priors(views)) for _ in range(2))
    batch.taker.batched = BatchSteps(batch.learned, batch.buffers, batch.context.render_options(), Tree(1, ALONE))
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


def test_rates_follow_the_square_root_of_the_batch():
    """Learning rates times 2 for four views, with corrections for decay rates to the power of four."""
    fit = Trainer(photos(2), seeds(), dataclasses.replace(PLAIN, batch=4), CPU)
    row, lrs = fit._lr_row(3), fit.lrs(3)
    assert row[:3] == scheduled_lrs(2 * lrs["means"], 3, (0.9**4, 0.999**4))
    assert (fit.settings(3)[Setting.NUMBER], fit.settings(3)[Setting.MEANS_LR]) == (3, 2 * lrs["means"])
    assert [fit.settings(3, slot)[Setting.NUMBER] for slot in range(4)] == [9, 10, 11, 12]
    assert [fit.settings(3, slot)[Setting.STEP] for slot in range(4)] == [3] * 4


def test_a_fit_with_batches_continues_with_the_same_bits():
    """From a state between two epochs, and through changes of the set."""
    config = dataclasses.replace(
        PLAIN, steps=12, batch=5, dropout=0.3, density=DensityConfig(start=2, every=3, gradient=1e-5, reset_every=6)
    )
    whole, first, second = (Trainer(photos(3), seeds(61), config, CPU) for _ in range(3))
    second.load(*advanced(first, 7).state())
    assert same_bits(advanced(whole, 12), advanced(second, 12)) and len(whole.table) > 61


def test_a_loss_that_is_no_number_names_its_view_and_harms_nothing():
    """A NaN in one photograph of three: the Gaussians are those before the step, and its views come again."""
    views = photos(3)
    bad = View("bad", views[1].camera, np.full_like(views[1].image, np.nan))
    fit = Trainer([views[0], bad, views[2]], seeds(), dataclasses.replace(PLAIN, batch=3), CPU)
    before = {n: t.clone() for n, t in fit.state()[0].items() if n != "generator"}
    with pytest.raises(NotFiniteError, match="became nan at step 1") as found:
        fit.advance()
    order = list(reversed(fit.order))
    assert found.value.view == 1 and order[found.value.slot] == 1 and sorted(order) == [0, 1, 2] and fit.step == 0
    assert all(torch.equal(before[n], t) for n, t in fit.state()[0].items() if n in before)


def in_series(fit: Trainer) -> Trainer:
    """Have a fit take several steps before it reads their results, as on CUDA, but without graphs."""
    fit.layout = dataclasses.replace(fit.layout, graphs=1)
    fit.buffers = StepBuffers(CPU, fit.buffers.lr_rows.shape[1], MAX_STEPS)
    fit.taker.batched = BatchSteps(fit.learned, fit.buffers, fit.context.render_options(), fit.taker.batched.tree)
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


def test_a_loss_that_is_no_number_ends_a_series_before_its_step():
    """The photograph without numbers is in step 3 of 10: two steps are taken, and the views of the others come again."""
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
    honest, calls = batch.view_gradients, []

    def overflowing(learned, views, buffers, *rest):
        calls.append(1)
        found = honest(learned, views, buffers, *rest)
        if len(calls) in (8, 30):
            buffers.stop.fill_(1)
        return found

    monkeypatch.setattr(batch, "view_gradients", overflowing)
    steps = [r.step for _ in range(12) if many.step < 12 for r in in_series(many).advance(100)]
    monkeypatch.undo()
    assert steps == list(range(1, 13)) and len(calls) > 36 and same_bits(advanced(one, 12), many, ("generator",))


def test_ranks_go_on_without_graphs_together():
    """Large views are in the slots of one of two ranks alone: both take the same steps where these exceed the limit."""
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
        assert 0 < fits[0].taker.batched.sums.divided < len(alone.table) and all(same_bits(alone, fit) for fit in fits)


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
    assert all(0 < fit.taker.batched.sums.divided for fit in fits)
    assert all(same_bits(alone, fit, () if stopped is None else ("generator",)) for fit in fits)


def test_a_batch_costs_memory_and_on_a_cpu_steps():
    """The plan counts the sums; a time on a CPU is one of renders; and elsewhere steps are those of one view."""
    views = [View(v.name, dataclasses.replace(v.camera, width=3000, height=2000), v.image) for v in photos(4)]
    config = PRESETS["default"]
    for device, fewer in (("cpu", 8), ("cuda", 1)):
        one, eight = (settings_by_views(dataclasses.replace(config, batch=b), views, device)[0].steps for b in (1, 8))
        assert eight == one // fewer > 0
    views = photos(4)
    one, eight = (Trainer(views, seeds(), dataclasses.replace(PLAIN, batch=b), CPU).layout for b in (1, 8))
    assert eight.held(1000) - one.held(1000) == 3 * (one.table.row_bytes + 8) * 1000
