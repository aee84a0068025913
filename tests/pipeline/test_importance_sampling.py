"""The method's parts in a fit: phases, layers, protection, capacity, and every combination of switches."""

import dataclasses
import itertools

import numpy as np
import pytest
import torch

from tests.scenes import photos, priors, seeds, three_gaussians
from warpgs.errors import UsageError
from warpgs.kernels.update import Setting
from warpgs.pipeline.model.start import InitConfig, initial_points
from warpgs.pipeline.model.table import DensityUpdate
from warpgs.pipeline.run.folder import load_checkpoint, save_checkpoint
from warpgs.pipeline.train.sampling import ImportanceConfig, SamplerConfig
from warpgs.pipeline.train.schedule import PhaseConfig, plan_phases
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.importance_sampling import (
    COARSE,
    FINE,
    NOT_SAMPLED,
    Event,
    MethodConfig,
    ProtectConfig,
    keep_contributors,
    render_before,
    sample_view,
    sampling_event,
)
from warpgs.pipeline.train.trainer import Trainer
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Gaussians

CPU = torch.device("cpu")
SWITCHES = ("hier", "s_render", "s_semantic", "s_geometry", "ra", "agp", "pm")
METHOD = MethodConfig(
    events=True, hier=True, sampler=SamplerConfig(fraction=0.01, min_alpha=0.05), protect=ProtectConfig(steps=10)
)
CONFIG = FitConfig(
    steps=40, sh_every=10, dropout=0.2, init=InitConfig(source="points"), sh_degree=1,
    density=DensityConfig(start=2, every=8, gradient=1e-5), phases=PhaseConfig(8, 12, every=5),
    strategy="importance_sampling", method=METHOD,
)  # fmt: skip


def fitted(config: FitConfig = CONFIG, steps: int | None = None, size: tuple[int, int] = (40, 32)) -> Trainer:
    views = photos(3, *size)
    fit = Trainer(views, seeds(), config, CPU, priors=priors(views))
    for _ in range(config.steps if steps is None else steps):
        fit.advance()
    return fit


def grown(fit: Trainer, keep: int | list[int], parents: list[int], **more) -> DensityUpdate:
    """A change that keeps some rows and appends copies of the first row, grown from these parents."""
    rows = torch.tensor(range(keep) if isinstance(keep, int) else keep)
    added = {n: t[:1].expand(len(parents), *t.shape[1:]) for n, t in fit.gaussians.tensors().items()}
    return DensityUpdate(rows, added, torch.tensor(parents), **more)


def event_of(fit: Trainer, views, method: MethodConfig, step: int) -> Event:
    """A sampling event on some views that is not applied."""
    protected = fit.strategy.is_protected(step) & method.pm
    return sampling_event(
        fit.gaussians, fit.strategy.fine, protected, views, method, step=step, capacity=10_000,
        options=RasterizeOptions(background=torch.zeros(3)), generator=torch.Generator().manual_seed(0),
    )  # fmt: skip


@pytest.mark.parametrize("length, count", [(5000, 21), (25_000, 102)])
def test_number_of_sampling_events(length, count):
    """The paper's schedules: 2000 + 5000 + 3000 and 2000 + 25000 + 3000 steps."""
    phases = plan_phases(PhaseConfig(2000, 3000), length + 5000)
    assert (phases.refine, phases.stable_start, len(phases.events)) == (2000, length + 2000, count)
    assert phases.events[0] == 2000 and phases.events[-1] < phases.stable_start
    gaps = [b - a for a, b in itertools.pairwise(phases.events)]
    assert gaps[0] == 100 and gaps == sorted(gaps) and 400 < gaps[-1] <= 500


def test_short_fit_has_all_phases():
    """Half the steps are phase 2, however few there are."""
    phases = plan_phases(PhaseConfig(2000, 3000), 300)
    assert (phases.refine, phases.stable_start) == (60, 210) and phases.events[0] == 60 and len(phases.events) == 21
    assert plan_phases(PhaseConfig(), 100).stable_start == 100
    few = plan_phases(PhaseConfig(2000, 3000, least=20), 300).events
    assert few[:2] == (60, 80) and 4 <= len(few) <= 6 and few[-1] < 210
    assert plan_phases(PhaseConfig(2000, 3000, least=20), 3000) == plan_phases(PhaseConfig(2000, 3000), 3000)


def test_protected_gaussian_survives_its_protection_and_no_step_longer():
    """An opacity pushed down every step stays at the least for T_protect steps after the event, then falls.

    In a step that is not taken nothing changes.
    """
    config = dataclasses.replace(CONFIG, method=dataclasses.replace(METHOD, protect=ProtectConfig(steps=5)))
    fit = fitted(config, steps=0)
    fit.table.apply(grown(fit, 2, [-1], columns={"level": FINE, "created_step": 7}))
    logits, going = fit.table.params["logit_opacities"].detach(), torch.ones(1, dtype=torch.bool)
    for step in range(8, 16):
        logits[:] = -10.0
        settings = torch.tensor(Setting.row(dropout=0.0, number=step, step=step, means_lr=0.0, shift=(0.0, 0.0, 0.0)))
        fit.strategy.after_step(fit.strategy.phase(step), settings, ~going)
        assert logits.tolist() == [-10.0] * 3
        fit.strategy.after_step(fit.strategy.phase(step), settings, going)
        held = float(logits[2]) == pytest.approx(fit.strategy.method.protect.logit)
        assert held == (step <= 12) and bool(fit.strategy.is_protected(step)[2]) == (step <= 12)
        assert logits[:2].tolist() == [-10.0, -10.0]


def test_children_are_as_old_as_their_parent():
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


def test_coarse_layer_is_stable_and_fine_layer_grows():
    """From phase 2 on coarse Gaussians are not added to; each step moves them a tenth as far; fine ones come and multiply."""
    fit = fitted(steps=8)
    before = fit.gaussians.means.clone()
    coarse = int((~fit.strategy.fine).sum())
    (event,) = fit.strategy.events
    assert event["step"] == 8 and event["added"] == int(fit.strategy.fine.sum()) > 0
    fit.advance()
    moved = (fit.gaussians.means - before).abs().amax(1)
    lr = fit.lrs(9)["means"]
    assert float(moved[~fit.strategy.fine].max()) < 0.11 * 3 * lr < float(moved[fit.strategy.fine].max())
    while fit.step < 40:
        fit.advance()
    assert int((~fit.strategy.fine).sum()) <= coarse and int(fit.strategy.fine.sum()) > event["added"]
    assert [e["step"] for e in fit.strategy.events] == list(fit.phases.events)


def test_phase_three_leaves_the_set_alone():
    """From the end of phase 2 on rows neither come nor go."""
    fit = fitted(steps=29)
    count = len(fit.gaussians)
    created_steps = fit.table.columns["created_step"].clone()
    for _ in range(11):
        fit.advance()
    assert (
        fit.phases.stable_start == 28
        and len(fit.gaussians) == count
        and torch.equal(fit.table.columns["created_step"], created_steps)
    )


def test_full_fine_layer_frees_its_least_contributors():
    """At the cap an event removes as many unprotected fine Gaussians as it adds; without unprotected ones it adds fewer."""
    fit = fitted(steps=8)
    cap = len(fit.strategy.events) and int(fit.strategy.fine.sum())
    method = dataclasses.replace(
        METHOD, sampler=dataclasses.replace(METHOD.sampler, max_fraction=cap / int((~fit.strategy.fine).sum()))
    )
    protected = event_of(fit, fit.views, method, 9)
    assert protected.evicted == 0 and len(protected.change.parents) == 0
    old = event_of(fit, fit.views, method, 500)
    assert old.evicted == len(old.change.parents) == cap
    assert bool((~fit.strategy.fine)[old.change.keep].all())


SOME = [(True,) * 7, (False,) * 7, *(tuple(i != j for i in range(7)) for j in range(7))]
"""All parts, none, and each part switched off alone."""


@pytest.mark.parametrize(
    "combinations",
    [SOME, pytest.param([*itertools.product((False, True), repeat=7)], marks=pytest.mark.slow)],
    ids=["some", "all"],
)
def test_switch_combinations_run(combinations):
    """Fits of a 32 x 32 scene, 2^7 of them in all: every one samples, protects or not as asked, and stays finite."""
    config = dataclasses.replace(CONFIG, steps=6, phases=PhaseConfig(2, 1, every=2))
    for values in combinations:
        method = dataclasses.replace(METHOD, **dict(zip(SWITCHES, values)))
        fit = fitted(dataclasses.replace(config, method=method), size=(32, 32))
        assert all(bool(torch.isfinite(t).all()) for t in fit.gaussians.tensors().values()), values
        # the first event fills the layer; the second finds no room among the protected
        first, second = fit.strategy.events
        assert first["added"] > 0 and first["evicted"] == 0, values
        assert (second["added"] > 0) == (second["evicted"] > 0) == (not method.pm), values


def test_continued_fit_with_all_parts_equals_uninterrupted_one(tmp_path):
    """Saved between two sampling events: the same bits at the end, layers and events included."""
    straight, broken = fitted(), fitted(steps=17)
    save_checkpoint(tmp_path, *broken.state())
    views = photos(3)
    resumed = Trainer(views, seeds(), CONFIG, CPU, priors=priors(views))
    resumed.load(*load_checkpoint(tmp_path))
    while resumed.step < 40:
        resumed.advance()
    a, b = straight.state()[0], resumed.state()[0]
    assert (
        a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a) and straight.strategy.events == resumed.strategy.events
    )


def test_settings_travel_through_json():
    """Nested settings come back as they were; an unknown field is an error in words."""
    assert FitConfig.from_json(CONFIG.to_json()) == CONFIG
    values = CONFIG.to_json()
    values["method"]["importance"]["colour"] = 1
    with pytest.raises(UsageError, match="another version"):
        FitConfig.from_json(values)


@pytest.mark.parametrize("reliable", [True, False])
def test_fine_gaussians_stand_at_confirmed_depths(reliable):
    """Where other views confirm a depth it is used; elsewhere nothing is drawn, or the rendered depth without reliability."""
    fit = fitted(steps=8)
    view, consistent = fit.views[0], torch.zeros(32, 40)
    consistent[:, :20] = 1.25
    views = [dataclasses.replace(view, consistent=consistent)]
    method = dataclasses.replace(
        METHOD,
        ra=reliable,
        sampler=SamplerConfig(depth="consistent", fraction=0.2, gate_quantile=0, max_fraction=50, min_alpha=0.05),
    )
    event = event_of(fit, views, method, 9)
    columns = event.views[0].at[:, 1]
    points = event.change.added["means"]
    z = points @ view.camera.viewmat[2, :3] + view.camera.viewmat[2, 3]
    assert len(z) == len(columns) > 50
    assert torch.allclose(z[columns < 20], torch.tensor(1.25), atol=1e-4)
    assert bool((columns >= 20).any()) != reliable and not torch.allclose(
        z[columns >= 20].mean(), torch.tensor(1.25), atol=0.05
    )


def test_unknown_semantics_leave_the_weights_to_the_others():
    """A view of which semantics say nothing is scored by the other two, whose weights sum to 1."""
    blank = [dataclasses.replace(p, boundary=p.boundary * 0, foreground=p.foreground * 0) for p in priors(photos(3))]
    fit = Trainer(photos(3), seeds(), CONFIG, CPU, priors=blank)
    options, generator = RasterizeOptions(background=torch.zeros(3)), torch.Generator().manual_seed(0)
    before = render_before(fit.gaussians, fit.views[0], METHOD, options)
    drawn, _ = sample_view(fit.views[0], 0, before, [], METHOD, 4, generator)
    assert fit.views[0].semantic is None
    assert torch.allclose(drawn.score, 0.5 * drawn.scores[0] + 0.5 * drawn.scores[2])


def test_gain_draws_where_all_views_ask_for_colour():
    """One of the three Gaussians is missing: most pixels sampled by the gain lie on it, and uniform ones do not."""
    fit = fitted(dataclasses.replace(CONFIG, steps=400, dropout=0.0), steps=0)
    whole = three_gaussians()
    kept = Gaussians(**{n: t[:2] for n, t in whole.tensors().items()})
    views = [dataclasses.replace(v, consistent=rasterize(whole, v.camera).depth) for v in fit.views]
    alone = {"s_semantic": False, "s_geometry": False, "importance": ImportanceConfig(residual="gain")}
    sampler = SamplerConfig(depth="consistent", fraction=0.01, gate_quantile=0, max_fraction=50, min_alpha=0.05)
    fraction = []
    for switches in (alone, {"s_render": False, **alone}):
        method = dataclasses.replace(METHOD, sampler=sampler, **switches)
        event = sampling_event(
            kept, torch.zeros(2, dtype=torch.bool), torch.zeros(2, dtype=torch.bool), views, method, step=9, capacity=10_000,
            options=RasterizeOptions(background=torch.zeros(3)), generator=torch.Generator().manual_seed(0),
        )  # fmt: skip
        away = (event.change.added["means"] - whole.means[2]).norm(dim=1)
        fraction.append(float((away < 0.45).float().mean()))
    assert fraction[0] > 0.9 > 0.6 > fraction[1]


def test_phase_3_begins_with_those_that_contribute_most():
    """Half stay, none of which has a smaller sum of blending weights than one that went; nothing changes afterwards."""
    fit = fitted(steps=27)
    options = RasterizeOptions(background=torch.zeros(3), contributions=True)
    weights = torch.stack([rasterize(fit.gaussians, v.camera, options).weight_sums[0] for v in fit.views]).sum(0)
    kept = keep_contributors(fit.gaussians, len(weights) // 2, fit.views, options)
    stays = torch.zeros(len(weights), dtype=torch.bool).index_fill(0, kept.keep, True)
    assert int(stays.sum()) == len(weights) // 2 and weights[stays].min() >= weights[~stays].max()
    whole, half = (fitted(dataclasses.replace(CONFIG, method=dataclasses.replace(METHOD, keep=k))) for k in (1.0, 0.5))
    assert len(half.gaussians) == round(0.5 * len(whole.gaussians))
    with pytest.raises(UsageError, match="keep"):
        MethodConfig(keep=0.0)


def test_growth_that_ends_early_keeps_those_that_contribute_most():
    """Then, too, they are counted once, before pixels that were held out are sampled."""
    fit = fitted(dataclasses.replace(CONFIG, method=dataclasses.replace(METHOD, keep=0.5)), steps=20)
    count, views = len(fit.gaussians), fit.views
    first, *rest = fit.strategy.catch_up(20, [dataclasses.replace(v, mask=torch.ones_like(v.image[..., 0])) for v in views], 64)
    assert len(first.keep) == round(0.5 * count) and len(first.parents) == 0 and all(len(c.keep) >= count for c in rest)


def test_unknown_residual_is_refused():
    """The message names the choices."""
    with pytest.raises(UsageError, match="length, gain"):
        ImportanceConfig(residual="error")


def test_dropout_falls_with_the_number_of_views():
    """Full up to `dropout_views` training views, then in proportion; it grows over the fit from 0."""
    plain = dataclasses.replace(CONFIG, strategy="clone_split", method=MethodConfig())
    few, many = (Trainer(photos(n), seeds(), plain, CPU) for n in (3, 6))
    assert few.dropout == pytest.approx(0.2) and many.dropout == pytest.approx(0.1)
    assert few.settings(1)[Setting.DROPOUT] == 0 and few.settings(40)[Setting.DROPOUT] == pytest.approx(0.2)


def test_auto_start_sweeps_few_views():
    """Up to `sweep_up_to` views the start comes from confirmed depths; beyond it from points or at random."""
    views = photos(3, 64, 48)
    for most, word in ((3, "sweep"), (2, "random")):
        start = initial_points(views, None, InitConfig(sweep_up_to=most, random_count=200), np.random.default_rng(0))
        assert word in start.how and (start.depths is not None) == (most == 3)
