"""Sampling in a fit: pixels and the Gaussians behind them, phases, layers, protection, capacity."""

import dataclasses
import itertools
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from tests.pipeline.train.fits import advanced
from tests.scenes import photos, ring, seeds
from warpgs import geometry
from warpgs.kernels.update import Setting
from warpgs.pipeline.model.start import InitConfig, initial_points
from warpgs.pipeline.model.table import DensityUpdate
from warpgs.pipeline.paper.strategy import Paper
from warpgs.pipeline.run.fit import planned_times
from warpgs.pipeline.train.schedule import PhaseConfig, plan_phases
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies import sampling
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.sampling import (
    COARSE,
    FINE,
    NOT_SAMPLED,
    MethodConfig,
    SamplerConfig,
    fine_gaussians,
    sample_pixels,
    valid_pixels,
)
from warpgs.pipeline.train.trainer import Trainer
from warpgs.scene import C0, Camera

CPU = torch.device("cpu")
METHOD = MethodConfig(hier=True, sampler=SamplerConfig(fraction=0.01))
CONFIG = FitConfig(
    steps=40, sh_every=10, dropout=0.2, init=InitConfig(source="points"), sh_degree=1,
    density=DensityConfig(start=2, every=8, gradient=1e-5), phases=PhaseConfig(160, 240), strategy="sampling", method=METHOD,
)  # fmt: skip


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    """Three Gaussians are hardly opaque, and fits of 40 steps have no time for long protection."""
    monkeypatch.setattr(sampling, "MIN_ALPHA", 0.05)
    monkeypatch.setattr(sampling, "PROTECTED_STEPS", 10)


def fitted(config: FitConfig = CONFIG, steps: int | None = None) -> Trainer:
    return advanced(Trainer(photos(3), seeds(), config, CPU), steps)


def test_a_continued_fit_expects_the_same_gaussians_and_only_the_rest_of_the_time():
    """Not three times those it has by then."""
    job: Any = SimpleNamespace(device=CPU, config=CONFIG, train=photos(3))
    begun, later = fitted(steps=0), fitted(steps=0)
    later.load(*fitted(steps=30).state())
    (times, (before,)), (same, (after,)) = (planned_times(job, fit) for fit in (begun, later))
    assert len(later.table) > 2 * len(begun.table) and times == same
    assert before.startswith("40 steps take") and after.startswith("10 steps take")
    assert before.partition("; ")[2] == after.partition("; ")[2]
    assert planned_times(job, advanced(later))[1] == []


def test_the_user_is_told_when_photographs_of_full_size_lower_the_psnr():
    """Only while they are still half their size."""
    config = dataclasses.replace(CONFIG, half_resolution=0.5)
    job: Any = SimpleNamespace(device=CPU, config=config, train=photos(3))
    notes = [planned_times(job, fitted(config, steps=n))[1][0] for n in (0, 20)]
    assert ["PSNR falls after step 20, where photographs have full size" in n for n in notes] == [True, False]


def grown(fit: Trainer, keep: int | list[int], parents: list[int], **more) -> DensityUpdate:
    """A change that keeps some rows and appends copies of the first row, grown from these parents."""
    rows = torch.tensor(range(keep) if isinstance(keep, int) else keep)
    added = {n: t[:1].expand(len(parents), *t.shape[1:]) for n, t in fit.gaussians.tensors().items()}
    return DensityUpdate(rows, added, torch.tensor(parents), **more)


def event_of(fit: Trainer, views, step: int, fraction: float = 0.01, max_fraction: float = 0.5):
    return fit.strategy.sample(step, dict(enumerate(views)), fraction, max_fraction)


def drawn_numbers(score: torch.Tensor, generator: torch.Generator) -> torch.Tensor:
    return torch.rand(score.shape, dtype=torch.float64, generator=generator)


def drawn_counts(score: torch.Tensor, gate: torch.Tensor, count: int, repeats: int) -> np.ndarray:
    generator, counts = torch.Generator().manual_seed(0), np.zeros(score.shape, int)
    for _ in range(repeats):
        at = sample_pixels(score, gate, count, drawn_numbers(score, generator)).numpy()
        assert len(np.unique(at, axis=0)) == len(at) == count
        counts[at[:, 0], at[:, 1]] += 1
    return counts


def test_pixels_are_drawn_by_their_score_without_replacement():
    """One pixel a draw: chi-square against S / sum S within the gate, never outside it."""
    score = torch.arange(1.0, 25).reshape(4, 6)
    gate = torch.ones(4, 6, dtype=torch.bool)
    gate[2] = False
    counts = drawn_counts(score, gate, 1, 4000)
    expected = (score * gate).numpy() / float((score * gate).sum())
    assert not counts[2].any()
    assert chisquare(counts[gate], 4000 * expected[gate]).pvalue > 1e-4
    # of two of three with weights 1, 1, 2, the heavy one is missing in one draw of six
    score = torch.tensor([[1.0, 1.0, 2.0]])
    counts = drawn_counts(score, torch.ones(1, 3, dtype=torch.bool), 2, 3000)[0]
    # P(missing heavy) = 2 * (1/4) (1/3) = 1/6
    assert chisquare([counts[2], 3000 - counts[2]], [2500, 500]).pvalue > 1e-4
    # asked for five, two have a score: two come back
    score = torch.zeros(3, 4)
    score[1, 2], score[0, 3] = 0.5, 1e-6
    at = sample_pixels(score, torch.ones(3, 4, dtype=torch.bool), 5, drawn_numbers(score, torch.Generator()))
    assert at.tolist() == [[0, 3], [1, 2]]


def test_a_class_of_others_may_draw_numbers_itself():
    """Its numbers and those of the sampled pixels come in one order, view by view, however long each takes."""

    class Drawing(sampling.Sampling):
        def importance(self, number, view, rendered):
            return {"own": drawn_numbers(rendered.depth, self.context.generator).float()}

    fit = fitted(steps=1)
    views, generator = fit.views[:2], fit.generator.clone_state()
    strategy = Drawing(fit.context)
    sampled = strategy.sample(1, dict(enumerate(views)), 0.01, 0.5)[-1]
    for view, own in zip(views, sampled, strict=True):
        score = drawn_numbers(view.image[..., 0], generator).float()
        at = sample_pixels(score, own.gate, len(own.at), drawn_numbers(score, generator))
        assert torch.equal(own.scores["own"], score) and torch.equal(own.at, at)


@pytest.mark.parametrize("most", [2, 3])
def test_numbers_drawn_ahead_are_those_that_an_event_would_draw(most, monkeypatch):
    """Also with fewer views than there are; not if anything was drawn since."""
    monkeypatch.setattr(sampling, "MAX_VIEWS", most)
    fit = fitted(steps=1)
    state, event = fit.generator.get_state(), fit.phases.events[0]

    def sampled(**patch):
        with monkeypatch.context() as m:
            for name, value in patch.items():
                m.setattr(sampling, name, value)
            return [s.at for s in event_of(fit, fit.views, event)[-1]], fit.generator.get_state()

    plain = sampled()
    fit.generator.set_state(state)
    fit.strategy.before_steps(event)
    fit.strategy._ahead.result()
    ahead = sampled(drawn=None)
    assert torch.equal(torch.cat(ahead[0]), torch.cat(plain[0])) and torch.equal(ahead[1], plain[1])
    fit.generator.set_state(state)
    fit.strategy.before_steps(event - 1)
    fit.strategy.before_steps(event)
    torch.rand(1, generator=fit.generator)
    after = sampled()
    fit.generator.set_state(state)
    torch.rand(1, generator=fit.generator)
    assert torch.equal(after[0][0], sampled()[0][0]) and not torch.equal(after[0][0], plain[0][0])


def test_without_adaptive_placement_the_highest_are_taken():
    """Deterministic top n within the gate."""
    score = torch.rand(8, 9, generator=torch.Generator().manual_seed(3))
    gate = score < 0.9
    at = sample_pixels(score, gate, 5, None)
    lowest = score[at[:, 0], at[:, 1]].min()
    assert int((score[gate] >= lowest).sum()) == 5


def test_fine_gaussians_stand_behind_valid_pixels(monkeypatch):
    """Thin, infinite, masked and border pixels are out; centre, colour, opacity, and a width of one pixel at their depth."""
    monkeypatch.undo()
    alpha, depth, mask = torch.ones(10, 12), torch.ones(10, 12), torch.ones(10, 12)
    alpha[4, 4], depth[4, 5], depth[4, 6], mask[4, 7] = 0.4, torch.inf, 0, 0
    valid = valid_pixels(alpha, depth, mask)
    assert valid.sum() == 6 * 8 - 4 and not bool(valid[4, 4:8].any()) and not bool(valid[:2].any())
    camera = ring(5)[3]
    tensors = Camera(
        *(torch.as_tensor(t, dtype=torch.float32) for t in (camera.viewmat, camera.K)), camera.width, camera.height
    )
    image = torch.rand(camera.height, camera.width, 3, generator=torch.Generator().manual_seed(0))
    depth = torch.full((camera.height, camera.width), 2.5)
    at = torch.tensor([[3, 7], [20, 30]])
    rows = fine_gaussians(tensors, image, depth, at, 1.0, 4)
    pixels, z = geometry.project_points(camera, rows["means"].double().numpy())
    assert np.allclose(pixels, [[7.5, 3.5], [30.5, 20.5]], atol=1e-5) and np.allclose(z, 2.5)
    assert torch.allclose(rows["sh"][:, 0] * C0 + 0.5, image[at[:, 0], at[:, 1]]) and not bool(rows["sh"][:, 1:].any())
    assert torch.allclose(rows["logit_opacities"].sigmoid(), torch.tensor(0.1))
    assert torch.allclose(rows["log_scales"].exp(), torch.tensor(2.5 / camera.K[0, 0], dtype=torch.float32))


@pytest.mark.parametrize("length, count", [(5000, 21), (25_000, 102)])
def test_number_of_sampling_events(length, count):
    phases = plan_phases(PhaseConfig(2000, 3000), length + 5000)
    assert (phases.refine, phases.stable_start, len(phases.events)) == (2000, length + 2000, count)
    assert phases.events[0] == 2000 and phases.events[-1] < phases.stable_start
    gaps = [b - a for a, b in itertools.pairwise(phases.events)]
    assert gaps[0] == 100 and gaps == sorted(gaps) and 400 < gaps[-1] <= 500


def test_short_fit_has_all_phases():
    phases = plan_phases(PhaseConfig(2000, 3000), 300)
    assert (phases.refine, phases.stable_start) == (60, 210) and phases.events[0] == 60 and len(phases.events) == 21
    assert plan_phases(PhaseConfig(), 100).stable_start == 100
    few = plan_phases(PhaseConfig(2000, 3000, least=20), 300).events
    assert few[:2] == (60, 80) and 4 <= len(few) <= 6 and few[-1] < 210
    assert plan_phases(PhaseConfig(2000, 3000, least=20), 3000) == plan_phases(PhaseConfig(2000, 3000), 3000)


def test_protected_gaussian_survives_its_protection_and_no_step_longer(monkeypatch):
    """An opacity pushed down every step stays at the least for T_protect steps after the event; not in a step not taken."""
    monkeypatch.setattr(sampling, "PROTECTED_STEPS", 5)
    fit = fitted(steps=0)
    fit.table.apply(grown(fit, 2, [-1], columns={"level": FINE, "created_step": 7}))
    logits, going = fit.table.params["logit_opacities"].detach(), torch.ones(1, dtype=torch.bool)
    for step in range(8, 16):
        logits[:] = -10.0
        settings = torch.tensor(Setting.row(dropout=0.0, number=step, step=step, means_lr=0.0, shift=(0.0, 0.0, 0.0)))
        fit.strategy.after_step(fit.strategy.phase(step), settings, ~going)
        assert logits.tolist() == [-10.0] * 3
        fit.strategy.after_step(fit.strategy.phase(step), settings, going)
        held = float(logits[2]) == pytest.approx(geometry.logit(sampling.PROTECTED_OPACITY))
        assert held == (step <= 12) and bool(fit.strategy.is_protected(step)[2]) == (step <= 12)
        assert logits[:2].tolist() == [-10.0, -10.0]


def test_coarse_layer_is_stable_and_fine_layer_grows_until_phase_three(monkeypatch):
    """Coarse Gaussians are not added to; each step moves them a tenth as far; fine ones come and multiply."""
    fit = fitted(steps=8)
    before = fit.gaussians.means.clone()
    coarse = int((~fit.strategy.fine).sum())
    (event,) = fit.strategy.events
    assert event["step"] == 8 and event["added"] == int(fit.strategy.fine.sum()) > 0
    fit.advance()
    moved = (fit.gaussians.means - before).abs().amax(1)
    lr = fit.lrs(9)["means"]
    assert float(moved[~fit.strategy.fine].max()) < 0.11 * 3 * lr < float(moved[fit.strategy.fine].max())
    advanced(fit)
    assert int((~fit.strategy.fine).sum()) <= coarse and int(fit.strategy.fine.sum()) > event["added"]
    assert [e["step"] for e in fit.strategy.events] == list(fit.phases.events)
    fit = fitted(steps=29)
    before = fit.table.columns["created_step"].clone()
    monkeypatch.setattr(fit.strategy, "prunes_unseen", False)
    assert fit.phases.stable_start == 28 and torch.equal(advanced(fit).table.columns["created_step"], before)


def test_gaussians_that_no_view_shows_are_removed(monkeypatch):
    """Faint and hidden ones go, young fine ones only at the end, or if they change no level; but the paper removes none."""
    monkeypatch.setattr(sampling, "PRUNE_VIEWS", 1)
    fit = fitted(steps=0)
    fit.table.apply(grown(fit, 3, [-1, -1], columns={"level": FINE, "created_step": 7}))
    fit.table.apply(grown(fit, 5, [0]))
    opacities = fit.table.params["logit_opacities"].detach()
    opacities[[0, 3, 4, 5]] = torch.tensor([-10.0, geometry.logit(3 / 255), -10.0, 3.0])
    fit.table.params["means"].detach()[5] = 100.0  # behind all cameras
    for step in (12, 32, 36):
        fit.table.columns["created_step"][3:5] = step - 1
        (change,) = fit.strategy.prune(step)
        assert change.keep.tolist() == [1, 2, 3] and len(change.parents) == 0  # 3 is young
    for step, created in ((37, 36), (36, 36 - sampling.PROTECTED_STEPS - 1)):  # at the last removal, or too old
        fit.table.columns["created_step"][3:5] = created
        (change,) = fit.strategy.prune(step)
        assert change.keep.tolist() == [1, 2]
    fit.table.params["logit_opacities"].detach()[:] = -10.0
    assert not [*fit.strategy.prune(30)]  # a model of nothing is no help
    assert [s for s in range(41) if fit.strategy.prunes(s)] == [12, 16, 20, 24, 28, 32, 37]
    assert not any(Paper(fit.context).prunes(s) for s in range(41))
    monkeypatch.setattr(sampling, "PRUNE_VIEWS", 14)  # two removals have time among 40 steps of three views
    assert [s for s in range(41) if fit.strategy.prunes(s)] == [28, 37]
    resets = dataclasses.replace(CONFIG, density=dataclasses.replace(CONFIG.density, reset_every=3))
    assert not any(fitted(resets, 0).strategy.prunes(s) for s in range(41))  # after a reset nothing is seen
    long = plan_phases(PhaseConfig(coarse=2000, stable=3000), 30_000)
    assert max(sampling.removals(long, 87)) == 28_500  # not among the steps that are averaged
    monkeypatch.setattr(sampling, "PRUNE_LEAST", 14)
    assert not any(fit.strategy.prunes(s) for s in range(41))


def test_children_are_as_old_as_their_parent_and_a_full_layer_frees_its_least():
    """Rows that grew from another take its layer and age; sampled rows have their own; of gradients nothing is known."""
    fit = fitted(steps=0)
    for name in ("grad_sum", "seen_count"):
        fit.table.columns[name] += 1
    fit.table.apply(grown(fit, 2, [-1, -1], columns={"level": FINE, "created_step": 3}))
    fit.table.apply(grown(fit, [1, 2], [3, 0]))
    columns = fit.table.columns
    assert columns["level"].tolist() == [COARSE, FINE, FINE, COARSE]
    assert columns["created_step"].tolist() == [NOT_SAMPLED, 3, 3, NOT_SAMPLED] and NOT_SAMPLED < -(10**8)
    assert columns["grad_sum"].tolist() == columns["seen_count"].tolist() == [1, 0, 0, 0]
    # without unprotected ones an event adds fewer
    fit = fitted(steps=8)
    cap = len(fit.strategy.events) and int(fit.strategy.fine.sum())
    most = cap / int((~fit.strategy.fine).sum())
    change, evicted, _ = event_of(fit, fit.views, 9, max_fraction=most)
    assert evicted == 0 and len(change.parents) == 0
    change, evicted, _ = event_of(fit, fit.views, 500, max_fraction=most)
    assert evicted == len(change.parents) == cap
    assert bool((~fit.strategy.fine)[change.keep].all())


@pytest.mark.parametrize("gated", [True, False])
def test_fine_gaussians_stand_at_confirmed_depths(gated):
    """Where other views confirm a depth it is used; elsewhere nothing is sampled, or the rendered depth without a gate."""
    fit = fitted(steps=8)
    fit.strategy.gated = gated
    view, consistent = fit.views[0], torch.zeros(32, 40)
    consistent[:, :20] = 1.25
    change, _, sampled = event_of(fit, [dataclasses.replace(view, consistent=consistent)], 9, 0.2, 50)
    columns = sampled[0].at[:, 1]
    points = change.added["means"]
    z = points @ view.camera.viewmat[2, :3] + view.camera.viewmat[2, 3]
    assert len(z) == len(columns) > 50
    assert torch.allclose(z[columns < 20], torch.tensor(1.25), atol=1e-4)
    assert bool((columns >= 20).any()) != gated and not torch.allclose(z[columns >= 20].mean(), torch.tensor(1.25), atol=0.05)
    # a render that nothing reads is not made, and the samples stay the same
    assert torch.equal(sampled[0].rendered, view.image) == gated
    again = fitted(steps=8)
    again.strategy.gated, again.strategy.on_event = gated, lambda step, views: None
    same, _, shown = event_of(again, [dataclasses.replace(again.views[0], consistent=consistent)], 9, 0.2, 50)
    assert torch.equal(shown[0].at, sampled[0].at) and not torch.equal(shown[0].rendered, view.image)
    assert all(torch.equal(same.added[n], rows) for n, rows in change.added.items())


def test_few_views_have_dropout_and_a_sweep():
    """Full dropout up to three training views, then in proportion; it grows over the fit from 0."""
    plain = dataclasses.replace(CONFIG, strategy="clone_split", method=MethodConfig())
    few, many = (Trainer(photos(n), seeds(), plain, CPU) for n in (3, 6))
    assert few.dropout == pytest.approx(0.2) and many.dropout == pytest.approx(0.1)
    assert few.settings(1)[Setting.DROPOUT] == 0 and few.settings(40)[Setting.DROPOUT] == pytest.approx(0.2)
    # beyond `sweep_up_to` views the start comes from points or at random
    views = photos(3, 64, 48)
    for most, word in ((3, "sweep"), (2, "random")):
        start = initial_points(views, None, InitConfig(sweep_up_to=most, random_count=200), np.random.default_rng(0))
        assert word in start.how and (start.depths is not None) == (most == 3)
