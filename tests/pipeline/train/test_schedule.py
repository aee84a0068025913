"""What changes with the steps: how many fit into a time, decays, means of parameters, and early stopping."""

import dataclasses
import itertools
import json
import math

import numpy as np
import pytest
import torch

from tests.example_terms import DepthCorrelation
from tests.pipeline.train.fits import advanced, continued, same_bits
from tests.scenes import photos, priors, seeds, three_gaussians
from tests.tolerances import OPACITY_DECAY
from warpgs.app.cli import main
from warpgs.errors import DataError, UsageError
from warpgs.pipeline.model import table
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train import settings, stopping
from warpgs.pipeline.train.memory import Layout
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import OptimizerConfig, PhaseConfig
from warpgs.pipeline.train.settings import (
    MIN_TIMED_STEPS,
    FitConfig,
    steps_by_views,
    within_budget,
)
from warpgs.pipeline.train.step import LEAST_LOGIT, StepTaker, decay_opacities
from warpgs.pipeline.train.stopping import (
    FLOOR,
    SIDES,
    Stopping,
    StoppingConfig,
    block_errors,
    decibels,
    falls_short,
    gain,
    masked,
    sample_blocks,
)
from warpgs.pipeline.train.strategies import sampling
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.mcmc import MCMCConfig
from warpgs.pipeline.train.strategies.sampling import MethodConfig, SamplerConfig
from warpgs.pipeline.train.trainer import SAMPLES, ParameterMean, Trainer, complexity_figures, complexity_summary
from warpgs.pipeline.train.view_modules import Exposure
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.synthetic.demo import split_spec

# The number of steps that fits into a time, and one clear message where none does.

CPU = torch.device("cpu")


def test_more_time_more_steps(monkeypatch):
    """By the costs of a probe of 10 ms, the predicted time keeps the budget, and one step more would not."""
    monkeypatch.setattr(settings, "probe_seconds", lambda *_: 0.01)
    views, config = photos(3), FitConfig(seed=7, rule="fast")
    setup, step = 0.01 * settings.SETUP * 3, 0.01 * settings.STEP
    for seconds in (setup + 150 * step, setup + 777.5 * step):
        chosen, why = within_budget(config, seconds, views, CPU)
        assert setup + chosen.steps * step <= seconds < setup + (chosen.steps + 1) * step + 1e-9
        assert f"--steps {chosen.steps}" in why and dataclasses.replace(chosen, steps=config.steps) == config
    for count in (3, 20):
        most, why = within_budget(config, 1e9, photos(count), CPU)
        assert most.steps == steps_by_views(count) and why.count(f"{count} views need no more") == 1
    with pytest.raises(UsageError, match=f"too short: {MIN_TIMED_STEPS} steps"):
        within_budget(config, setup + (MIN_TIMED_STEPS - 1) * step, views, CPU)


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--time-budget", "-3"], "positive number of seconds"),
        (["--time-budget", "0.001"], "too short"),
        (["--time-budget", "9", "--steps", "9"], "leave out --steps"),
    ],
)  # fmt: skip
def test_flags_that_exclude_each_other(scene, tmp_path, capsys, flags, words):
    out = tmp_path / "run"
    assert main(["fit", str(scene), "--split", split_spec(9), "--out", str(out), "--device", "cpu", *flags]) == 2
    said = capsys.readouterr().err
    assert words in said and said.count("\n") == 1 and not out.exists()


# Decay of opacities: its values, steps that are not taken, when it is chosen, and fits that are continued.

GOING = torch.tensor([True])


def test_a_fraction_of_every_opacity_goes():
    """Opaque and faint ones lose the same fraction."""
    opacities = torch.tensor([1e-6, 0.01, 0.5, 0.99, 1 - 1e-6], dtype=torch.float64)
    logits = torch.logit(opacities).float()
    before = logits.double().sigmoid()
    decay_opacities(logits, 0.01, GOING)
    error = (logits.double().sigmoid() / (0.99 * before) - 1).abs().max()
    assert float(error) < OPACITY_DECAY
    # beyond the least logit nothing decays; full opacity becomes 1 less the fraction; NaN stays NaN
    logits = torch.tensor([-math.inf, 2 * LEAST_LOGIT, math.inf, math.nan])
    decay_opacities(logits, 0.25, GOING)
    assert logits[:2].tolist() == [-math.inf, 2 * LEAST_LOGIT] and logits[3].isnan()
    assert math.isclose(float(logits[2].sigmoid()), 0.75, rel_tol=1e-6)
    # nor does a decay of 0, or of less than a rounding
    logits = torch.linspace(-3, 3, 7)
    for fraction, going in ((0.1, torch.tensor([False])), (0.0, GOING), (1e-300, GOING)):
        now = logits.clone()
        decay_opacities(now, fraction, going)
        assert torch.equal(now, logits)


# Mean of the parameters over the last steps: its samples, its bits, fits that are continued, and when it is chosen.

CONFIG = FitConfig(
    steps=20, init=InitConfig(source="points"), density=DensityConfig(start=1000), view_modules=(Exposure(),),
    optimizer=OptimizerConfig(average_last=0.25),
)  # fmt: skip
"""The last five steps are averaged, and the set of Gaussians does not change."""


def trainer(config: FitConfig = CONFIG, device: torch.device = CPU) -> Trainer:
    views = photos(4)
    return Trainer(views, seeds(61), config, device, priors=priors(views))


def begun(config: FitConfig, steps: int | None) -> Trainer:
    return advanced(Trainer(photos(4), seeds(), config, CPU), steps)


def finish(fit: Trainer, step: int | None = None) -> dict[str, torch.Tensor]:
    return {n: t.detach().clone() for n, t in advanced(fit, step).taker.params.items()}


def plain(config: FitConfig) -> FitConfig:
    return dataclasses.replace(config, optimizer=dataclasses.replace(config.optimizer, average_last=0.0))


@pytest.mark.parametrize("steps", [1, 10, 640, 660, 20_539])
@pytest.mark.parametrize("fraction", [0.0, 0.05, 1.0])
def test_samples_are_even_and_end_with_the_last_step(steps, fraction):
    """All lie in the last fraction of the steps; `wait` leads from each to the next."""
    mean, length = ParameterMean(fraction), int(fraction * steps)
    samples = sorted(mean.samples(steps))
    assert len(samples) == min(length, len(samples)) and len(samples) < 2 * SAMPLES
    assert len(samples) >= min(length, SAMPLES) and (not length or samples[-1] == steps)
    assert len({b - a for a, b in itertools.pairwise(samples)}) <= 1
    assert all(steps - length < s for s in samples)
    step, reached = 0, []
    while step < steps:
        step += mean.wait(step, steps)
        reached.append(step)
    assert reached == (samples or [steps])


def test_the_error_of_a_mean_has_a_bound():
    """n samples in float32: at most n 2^-24 of the largest, for values of any size."""
    generator = torch.Generator().manual_seed(5)
    scales = torch.logspace(-30, 30, 4000)
    samples = [scales * (1 + 0.1 * torch.randn(4000, generator=generator)) for _ in range(2 * SAMPLES - 1)]
    mean, params = ParameterMean(1.0), {"means": torch.empty(4000)}
    for step, sample in enumerate(samples, start=1):
        params["means"].copy_(sample)
        assert mean.update(step, len(samples), params) == (step == len(samples))
    doubles = torch.stack(samples).double()
    error = (params["means"].double() - doubles.mean(0)).abs() / doubles.abs().amax(0)
    assert len(samples) / 2**28 < float(error.max()) < len(samples) / 2**24
    assert float(error.mean()) < 2e-7


@pytest.mark.parametrize("stop", [12, 18])
def test_a_continued_fit_has_the_same_bits(tmp_path, stop):
    """Also from a state between two samples, and from one before all samples."""
    assert any(n.startswith("mean.") for n in advanced(trainer(), stop).state()[0]) == (stop > 15)
    assert same_bits(advanced(trainer()), continued(trainer, stop, tmp_path))


def test_the_result_is_the_mean_of_the_last_steps_since_a_change_of_the_set():
    """Of every parameter, also of view modules, in the bits of a sum and one division; all steps before are unchanged."""
    fit, single = trainer(), trainer(plain(CONFIG))
    assert finish(fit, 15).keys() >= {"means", "sh", "views.exposure_affine"}
    finish(single, 15)
    kept = [finish(single, step) for step in range(16, 21)]
    result = finish(fit)
    for name, value in result.items():
        total = kept[0][name].clone()
        for params in kept[1:]:
            total += params[name]
        assert torch.equal(value, total / 5), name
    assert not torch.equal(result["means"], kept[-1]["means"])
    # rows before and after are other Gaussians: only the steps after the change count
    config = dataclasses.replace(CONFIG, density=DensityConfig(start=5, every=9, stop_fraction=1.0, gradient=1e-9))
    fit, single = trainer(config), trainer(plain(config))
    finish(fit, 17)
    assert fit.mean.count == 2
    finish(fit, 18)
    finish(single, 18)
    assert len(fit.table) > 61
    kept = [finish(single, step) for step in (18, 19, 20)]
    expected = (kept[0]["means"] + kept[1]["means"] + kept[2]["means"]) / 3
    assert torch.equal(finish(fit)["means"], expected)


def test_a_damaged_mean_is_refused_and_the_memory_plan_counts_the_sums():
    """A missing or unknown sum, another shape or type, and a count that is none; one more copy of the parameters."""
    fit = trainer()
    finish(fit, 18)
    tensors, values = fit.state()
    damaged = [
        {"mean.means": tensors["mean.means"][:-1]}, {"mean.means": tensors["mean.means"].double()},
        {"mean.count": torch.tensor([0])}, {"mean.count": torch.tensor(3.0)}, {"mean.other": torch.zeros(3)},
    ]  # fmt: skip
    for change in damaged:
        with pytest.raises(DataError, match="stored mean"):
            trainer().load(tensors | change, values)
    for name in ("mean.count", "mean.sh"):
        with pytest.raises(DataError, match="stored mean"):
            trainer().load({n: t for n, t in tensors.items() if n != name}, values)
    fit = trainer()
    summed, without = (Layout(fit.table, fit.views, averaged=averaged) for averaged in (True, False))
    assert fit.layout.averaged and not trainer(plain(CONFIG)).layout.averaged
    assert summed.held(100) == without.held(100) + 100 * fit.table.row_bytes


@pytest.mark.cuda
@pytest.mark.parametrize("parts", [(), (DepthCorrelation(0.3, 0.7),)])
def test_graphs_give_the_same_bits(parts):
    config = dataclasses.replace(CONFIG, steps=100, loss_terms=parts)
    cuda = torch.device("cuda", 0)
    graphs, single = (finish(trainer(dataclasses.replace(config, cuda_graph=on), cuda)) for on in (True, False))
    assert all(torch.equal(single[n], t) for n, t in graphs.items())
    fit = trainer(config, cuda)
    finish(fit, 98)
    assert fit.mean.count == 23


# Early stopping by left-out blocks, with every strategy; that it is repeatable and resumable, and changes nothing when
# off.

AT_ONCE = StoppingConfig(min_gain_db=50.0)
"""Ends growth as soon as it may."""
GROWING = FitConfig(
    steps=60, sh_every=15, init=InitConfig(source="points"), sh_degree=1, stopping=AT_ONCE,
    density=DensityConfig(start=10, every=5, gradient=1e-5),
)  # fmt: skip
SAMPLING = MethodConfig(hier=True, sampler=SamplerConfig(fraction=0.01))
CONFIGS = {
    "clone_split": GROWING,
    "sampling": dataclasses.replace(GROWING, strategy="sampling", method=SAMPLING, phases=PhaseConfig(200, 400)),
    "mcmc": dataclasses.replace(
        GROWING, strategy="mcmc", strategy_config=MCMCConfig(start=10, every=5, stop_fraction=0.5), max_gaussians=200
    ),
}


def slow(config: FitConfig) -> FitConfig:
    slower = dataclasses.replace(config.density, gradient=1e-3)
    return dataclasses.replace(config, dropout=0.5, stopping=StoppingConfig(0.0), density=slower)


@pytest.fixture
def tiny(monkeypatch):
    """Images of few blocks, fits of few steps, and Gaussians that are hardly opaque."""
    monkeypatch.setattr(stopping, "FRACTION", 0.3)
    monkeypatch.setattr(stopping, "MEASUREMENTS", 4)
    monkeypatch.setattr(sampling, "MIN_ALPHA", 0.05)


def complexity(fit: Trainer) -> dict:
    return complexity_figures(fit)["complexity"]


@pytest.mark.usefixtures("tiny")
@pytest.mark.parametrize("strategy", CONFIGS)
def test_any_strategy_is_stopped(strategy):
    """Blocks are hidden until growth ends; then all pixels count, the set stays, and the fit is shorter in proportion."""
    fit = begun(CONFIGS[strategy], 14)
    early, ends = fit.stopping, fit.strategy.growth().ends
    hidden = sum(int((v.mask == 0).sum()) for v in fit.views)
    assert hidden == early.held_pixels > 0 and early.ended is None
    while early.ended is None:
        before = len(fit.gaussians)
        fit.advance()
    at = early.ended
    assert at == fit.step < ends == early.marks[-1] and all(v.mask is None for v in fit.views)
    assert fit.steps == at + round((60 - ends) * at / ends) < 60
    assert not any(fit.is_due(s) and not fit.strategy.prunes(s) for s in range(at + 1, 61))
    count, words = len(fit.gaussians), list(fit.messages)
    pixels = sum(v.image[..., 0].numel() for v in fit.views)
    if strategy == "sampling":  # as many Gaussians a pixel in the blocks as elsewhere
        assert 0 < count - before <= 1.1 * before * hidden / (pixels - hidden) + 4
    assert (count > early.measurements[-1]["count"]) == (strategy == "sampling")
    while fit.step < fit.steps:
        assert fit.advance()[0].count == count
    assert fit.phases.progress(fit.steps) == pytest.approx(1.0)
    c = complexity(fit)
    assert c["held_out"] and c["count"] == count and c["ended"] == at
    assert c["marginal_db"] == c["measurements"][-1]["gain"]
    assert c["why"] and c["why"] in words[-1] and c["why"] in complexity_summary({"complexity": c})
    json.dumps(c)


@pytest.mark.usefixtures("tiny")
@pytest.mark.parametrize("strategy", CONFIGS)
def test_a_fit_that_gains_takes_its_planned_steps(strategy, monkeypatch):
    """With next to nothing asked for, growth ends by schedule, and the last set is what the schedule has it be."""
    config = CONFIGS[strategy]
    monkeypatch.setattr(stopping, "NOISES", 1e3)
    fit = begun(dataclasses.replace(config, stopping=StoppingConfig(min_gain_db=1e-9)), None)
    assert fit.step == 60 and fit.stopping.ended == fit.stopping.marks[-1] and "its planned steps are done" in fit.stopping.why
    assert len(fit.stopping.measurements) >= 2 and all(v.mask is None for v in fit.views)


@pytest.mark.usefixtures("tiny")
@pytest.mark.parametrize("strategy", CONFIGS)
def test_spare_rows_change_no_bit(strategy, monkeypatch):
    """Nor do addresses that outlast changes of the set. With mcmc, whose loss has means over all rows, they would."""
    config = slow(CONFIGS[strategy])
    plain, honest, counts, new = begun(config, None), StepTaker.step, [], []

    def step(taker, *arguments):
        counts.append(len(taker.table))
        taker.table.settles = True
        new.append(taker.table.settle())
        with taker.table.with_spare_rows():
            assert len(taker.table) == taker.table.room >= counts[-1]
            honest(taker, *arguments)

    monkeypatch.setattr(StepTaker, "step", step)
    monkeypatch.setattr(table, "ROOM", 1.9)
    fit = begun(config, None)
    changed = [a != b for a, b in itertools.pairwise(counts)]
    assert new[0] and sum(new[1:]) < sum(changed) and not any(n and not c for n, c in zip(new[1:], changed))
    assert fit.by_rows == same_bits(fit, plain) == (strategy != "mcmc")


@pytest.mark.cuda
@pytest.mark.usefixtures("tiny")
@pytest.mark.parametrize("strategy", CONFIGS)
def test_graphs_outlast_changes_of_the_set(strategy, monkeypatch):
    """Fewer captures than with a new graph after each change, and the bits of steps without graphs."""
    fits, captured, honest = [], [], StepTaker.capture
    monkeypatch.setattr(StepTaker, "capture", lambda *arguments: captured.append(len(fits)) or honest(*arguments))
    for graphs in (True, True, False):
        config = dataclasses.replace(slow(CONFIGS[strategy]), cuda_graph=graphs)
        fits.append(advanced(Trainer(photos(4), seeds(), config, torch.device("cuda", 0))))
        monkeypatch.setattr(Trainer, "by_rows", False)
    assert [f.table.settles for f in fits] == [strategy != "mcmc", False, False]
    assert all(same_bits(fit, fits[2], but=("none",)) for fit in fits)
    first, second = captured.count(0), captured.count(1)
    assert 2 not in captured and (first < second if strategy == "sampling" else first <= second)


@pytest.mark.usefixtures("tiny")
@pytest.mark.parametrize(("strategy", "at"), [("clone_split", 11), ("sampling", 14), ("mcmc", 20)])
def test_continued_fit_equals_uninterrupted_one(tmp_path, strategy, at):
    """Saved before or between measurements, or after growth has ended: the same bits and figures at the end."""
    config = dataclasses.replace(CONFIGS[strategy], dropout=0.3)
    straight = begun(config, None)
    assert straight.stopping.ended and at < straight.steps
    assert same_bits(straight, continued(lambda: begun(config, 0), at, tmp_path))


@pytest.mark.usefixtures("tiny")
@pytest.mark.parametrize(
    ("views", "share", "words"),
    [
        (1, 0.001, "the images have only"),
        (4, 0.3, "growth lasts to the end of the fit"),
    ],
)
def test_without_evidence_it_is_the_plain_fit(views, share, words, monkeypatch):
    """Too few blocks, or no time after growth: a note says so, and the bits are those of a fit without early stopping."""
    monkeypatch.setattr(stopping, "FRACTION", share)
    density = dataclasses.replace(GROWING.density, stop_fraction=1.0 if views > 1 else 0.5)
    config = dataclasses.replace(GROWING, steps=20, density=density)
    configs = config, dataclasses.replace(config, stopping=StoppingConfig())
    fit, plain = (advanced(Trainer(photos(views), seeds(), c, CPU), 20) for c in configs)
    assert any(words in n for n in fit.notes) and not complexity(fit)["held_out"] and not plain.stopping.blocks
    assert all(torch.equal(t, plain.gaussians.tensors()[n]) for n, t in fit.gaussians.tensors().items())


@pytest.mark.usefixtures("tiny")
def test_when_growth_may_end():
    """Not while views have half size, and only in product presets; a stored state with errors of other blocks is refused."""
    assert (
        begun(GROWING, None).stopping.ended < 24 < begun(dataclasses.replace(GROWING, half_resolution=0.4), None).stopping.ended
    )
    # the baselines and the paper take their planned steps; the default's strategy samples
    stops = {name for name, c in PRESETS.items() if c.stopping.min_gain_db != 0}
    assert stops == {"default", "quick"} and {PRESETS[n].strategy for n in stops} == {"sampling"}
    fit = begun(GROWING, 13)
    tensors, plain = fit.stopping.state()
    assert plain["measured"]
    with pytest.raises(DataError, match=r"left-out blocks have shape.*fit again"):
        Stopping(AT_ONCE).load(tensors, plain)


@pytest.mark.usefixtures("tiny")
def test_command_line_says_why_growth_stopped(scene, tmp_path, capsys):
    flags = ["--split", split_spec(9), "--steps", "60", "--device", "cpu", "--preset", "3dgs", "--stopping.min-gain-db", "0.1"]
    assert main(["fit", str(scene), "--out", str(tmp_path / "run"), *flags, "--max-gaussians", "900"]) == 0
    words = capsys.readouterr().out
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    c = metrics["complexity"]
    assert c["held_out"] and c["cap"] == 900 and c["count"] == metrics["gaussians"] <= 900
    assert f"{c['count']:,} Gaussians, " in words
    page = (tmp_path / "run" / "report.html").read_text()
    assert "mean SH degree" in page and "growth ended at step" in page and "end of growth: " in page


# Held-out blocks, and when a gain on them is more than noise.


def views(count: int = 3, width: int = 160, height: int = 128, mask=None) -> list[TrainingView]:
    return [TrainingView.of(dataclasses.replace(v, mask=mask), CPU) for v in photos(count, width, height)]


def test_growth_that_may_have_bought_something_goes_on():
    """Made-up errors of ten blocks: a level bought nothing only where no gain can hide in the spread between blocks."""
    errors = torch.full((10,), 0.02, dtype=torch.float64)
    steady, mixed = 0.9 * errors, errors * torch.tensor([0.5, 1.9] * 5)
    assert gain(errors, steady)[0] == pytest.approx(10 * math.log10((0.02 + FLOOR) / (0.018 + FLOOR)))
    assert not falls_short(*gain(errors, steady), 0.02) and falls_short(*gain(errors, steady), 0.5)
    mean, noise = gain(errors, mixed)
    each = 10 * np.log10((0.02 + FLOOR) / (np.array([0.01, 0.038] * 5) + FLOOR))
    assert mean == pytest.approx(each.mean()) and noise == pytest.approx(each.std(ddof=1) / math.sqrt(10))
    assert 0 < mean < noise and not falls_short(mean, noise, mean) and falls_short(mean, noise, mean + 1.01 * noise)
    assert falls_short(*gain(errors, errors), 0.02) and falls_short(*gain(steady, errors), 0.02)
    # one block tells nothing; an error that is no number ends growth; what nobody sees buys nothing
    one, none, nan = torch.tensor([0.5]), torch.zeros(0), torch.tensor([0.1, math.nan])
    assert not falls_short(*gain(0.1 * one, one), 0.02) and falls_short(*gain(none, none), 0.02)
    assert falls_short(*gain(torch.tensor([0.5, 0.5]), nan), 0.02)
    below, seen = torch.full((8,), 0.1 * FLOOR), torch.full((8,), 1e-2)
    assert gain(below, 0.01 * below)[0] < 0.5 and gain(seen, 0.01 * seen)[0] > 15


def test_blocks_are_drawn_and_hidden():
    """Their number, side and place for a picture of usual size; masked-out blocks are no evidence; a seed decides them."""
    drawn = sample_blocks(views(), 0.1, 5)
    for rows, columns in drawn:
        cover = torch.zeros(128, 160)
        cover[rows, columns] += 1
        assert rows.shape[1] == columns.shape[2] == SIDES[0] == 16
        assert int(cover.sum()) == len(rows) * 256 == 256 * round(0.1 * 80)
    again, other = sample_blocks(views(), 0.1, 5), sample_blocks(views(), 0.1, 6)
    assert all(torch.equal(a, b) for pair in zip(drawn, again) for a, b in zip(*pair))
    assert not all(torch.equal(a, b) for pair in zip(drawn, other) for a, b in zip(*pair))
    assert not torch.equal(drawn[0][0], drawn[1][0])
    mask = np.zeros((128, 160), bool)
    mask[:, 80:] = True
    for _, columns in sample_blocks(views(mask=mask), 0.5, 0):
        assert len(columns) > 10 and bool((columns.double().mean(-1) >= 79.5).all())
    assert sample_blocks(views(1, 40, 32), 0.1, 0)[0][0].shape[1] == 4
    assert [len(r) for r, _ in sample_blocks(views(3), 0.01, 0)] == [4] * 3 and len(sample_blocks(views(1), 0.01, 0)[0][0]) == 8
    assert sample_blocks(views(1, 1600, 1200), 0.1, 0)[0][0].shape[1] == SIDES[1]
    # a view without its blocks keeps its other pixels; the errors are those of the blocks' pixels that count
    mask = np.ones((128, 160), bool)
    mask[:, :7] = False
    seen = views(mask=mask)
    blocks = sample_blocks(seen, 0.3, 1)
    hidden = masked(seen[0], blocks[0], inside=False)
    assert float(seen[0].mask.sum()) == mask.sum()
    assert not bool(hidden.mask[blocks[0]].any()) and 0.6 < float(hidden.mask.sum()) / mask.sum() < 0.8
    gaussians = dataclasses.replace(three_gaussians(), sh=0.5 * three_gaussians().sh)
    found = block_errors(gaussians, seen, blocks, RasterizeOptions())
    at = 0
    for v, held in zip(seen, blocks):
        squares = ((rasterize(gaussians, v.camera).rgb.clamp(0, 1) - v.image) ** 2).numpy().mean(2)
        for where in zip(*held):
            assert float(found[at]) == pytest.approx(squares[where][mask[where]].mean(), rel=1e-4, abs=1e-9)
            at += 1
    assert at == len(found) and float(found.max()) > 1e-3
    assert decibels(found) == pytest.approx(-10 * math.log10(float(found.mean()) + FLOOR))
