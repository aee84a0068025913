"""Early stopping by left-out blocks, with every strategy; that it is repeatable and resumable, and changes nothing when off."""

import dataclasses
import json
import math

import pytest
import torch

from tests.scenes import photos, seeds
from warpgs.app.cli import main
from warpgs.errors import DataError, UsageError
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.folder import load_checkpoint, save_checkpoint
from warpgs.pipeline.train import stopping
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import PhaseConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.stopping import Stopping, StoppingConfig
from warpgs.pipeline.train.strategies import sampling
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.mcmc import MCMCConfig
from warpgs.pipeline.train.strategies.sampling import MethodConfig, SamplerConfig
from warpgs.pipeline.train.trainer import Trainer, complexity_figures, complexity_summary
from warpgs.synthetic.demo import split_spec, write_demo

CPU = torch.device("cpu")
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


@pytest.fixture(autouse=True)
def tiny(monkeypatch):
    """Images of few blocks, fits of few steps, and Gaussians that are hardly opaque."""
    monkeypatch.setattr(stopping, "FRACTION", 0.3)
    monkeypatch.setattr(stopping, "MEASUREMENTS", 4)
    monkeypatch.setattr(sampling, "MIN_ALPHA", 0.05)


def advanced(config: FitConfig, steps: int | None = None) -> Trainer:
    fit = Trainer(photos(4), seeds(), config, CPU)
    while fit.step < (fit.steps if steps is None else steps):
        fit.advance()
    return fit


def complexity(fit: Trainer) -> dict:
    return complexity_figures(fit)["complexity"]


@pytest.mark.parametrize("strategy", CONFIGS)
def test_any_strategy_is_stopped(strategy):
    """Blocks are hidden until growth ends; then all pixels count, the set stays, and the fit is shorter in proportion."""
    fit = advanced(CONFIGS[strategy], 14)
    early, ends = fit.stopping, fit.strategy.growth().ends
    hidden = sum(int((v.mask == 0).sum()) for v in fit.views)
    assert hidden == early.held_pixels > 0 and early.ended is None
    while early.ended is None:
        fit.advance()
    at = early.ended
    assert at == fit.step < ends == early.marks[-1] and all(v.mask is None for v in fit.views)
    assert fit.steps == at + round((60 - ends) * at / ends) < 60
    assert not any(fit.is_due(s) for s in range(at + 1, 61))
    count, words = len(fit.gaussians), list(fit.messages)
    caught_up = strategy == "sampling"
    assert (count > early.measurements[-1].count) == caught_up
    while fit.step < fit.steps:
        assert fit.advance()[0].count == count
    assert fit.progress(fit.steps) == pytest.approx(1.0)
    c = complexity(fit)
    assert c["held_out"] and c["count"] == count and c["ended"] == at
    assert c["marginal_db"] == c["measurements"][-1]["gain"]
    assert c["why"] and c["why"] in words[-1] and c["why"] in complexity_summary({"complexity": c})
    json.dumps(c)


@pytest.mark.parametrize("strategy", CONFIGS)
def test_a_fit_that_gains_takes_its_planned_steps(strategy, monkeypatch):
    """With next to nothing asked for, growth ends by schedule, and the last set is what the schedule has it be."""
    config = CONFIGS[strategy]
    monkeypatch.setattr(stopping, "NOISES", 1e3)
    fit = advanced(dataclasses.replace(config, stopping=StoppingConfig(min_gain_db=1e-9)))
    assert fit.step == 60 and fit.stopping.ended == fit.stopping.marks[-1] and "its planned steps are done" in fit.stopping.why
    assert len(fit.stopping.measurements) >= 2 and all(v.mask is None for v in fit.views)


def test_pixels_that_were_held_out_catch_up():
    """Sampling adds Gaussians in the blocks when growth ends: as many a pixel as elsewhere."""
    config = CONFIGS["sampling"]
    fit = advanced(config, 11)
    before = None
    while fit.stopping.ended is None:
        before = int(fit.strategy.fine.sum())
        fit.advance()
    pixels = sum(v.image[..., 0].numel() for v in fit.views)
    held = fit.stopping.held_pixels
    added = int(fit.strategy.fine.sum()) - before
    assert before > 0 and 0 < added <= 1.1 * before * held / (pixels - held) + 4


@pytest.mark.parametrize("strategy", CONFIGS)
@pytest.mark.parametrize("at", [11, 14, 20])
def test_continued_fit_equals_uninterrupted_one(tmp_path, strategy, at):
    """Saved before or between measurements, or after growth has ended: the same bits and figures at the end."""
    config = dataclasses.replace(CONFIGS[strategy], dropout=0.3)
    straight = advanced(config)
    assert straight.stopping.ended and at < straight.steps
    save_checkpoint(tmp_path, *advanced(config, at).state())
    resumed = Trainer(photos(4), seeds(), config, CPU)
    resumed.load(*load_checkpoint(tmp_path))
    while resumed.step < resumed.steps:
        resumed.advance()
    (a, plain), (b, again) = straight.state(), resumed.state()
    assert a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)
    assert plain["stopping"] == again["stopping"] and plain["notes"] == again["notes"]


def test_errors_of_other_blocks_are_refused():
    """A stored state whose measurements are not of these blocks."""
    fit = advanced(GROWING, 13)
    tensors, plain = fit.stopping.state()
    assert plain["measured"]
    with pytest.raises(DataError, match=r"left-out blocks have shape.*fit again"):
        Stopping(AT_ONCE).load(tensors, plain)


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
    fit, plain = (
        Trainer(photos(views), seeds(), c, CPU) for c in (config, dataclasses.replace(config, stopping=StoppingConfig()))
    )
    for _ in range(20):
        fit.advance()
        plain.advance()
    assert any(words in n for n in fit.notes) and not complexity(fit)["held_out"] and not plain.stopping.blocks
    assert all(torch.equal(t, plain.gaussians.tensors()[n]) for n, t in fit.gaussians.tensors().items())


def test_only_the_product_presets_stop_early():
    """The baselines and the paper take their planned steps; the default's strategy samples."""
    stops = {name for name, c in PRESETS.items() if c.stopping.min_gain_db != 0}
    assert stops == {"default", "quick"} and {PRESETS[n].strategy for n in stops} == {"sampling"}


@pytest.mark.parametrize("bad", [{"min_gain_db": x} for x in (-1, math.inf, math.nan)])
def test_bad_settings_are_refused(bad):
    with pytest.raises(UsageError, match=r"stopping\.min-gain-db must be at least 0 and finite"):
        StoppingConfig(**bad)


def test_command_line_says_why_growth_stopped(tmp_path, capsys):
    """A whole run with early stopping and --max-gaussians: terminal, metrics.json and report."""
    write_demo(tmp_path / "scene", views=8, width=64, height=48)
    flags = ["--split", split_spec(8), "--steps", "60", "--device", "cpu", "--preset", "3dgs", "--stopping.min-gain-db", "0.1"]
    assert main(["fit", str(tmp_path / "scene"), "--out", str(tmp_path / "run"), *flags, "--max-gaussians", "900"]) == 0
    words = capsys.readouterr().out
    metrics = json.loads((tmp_path / "run" / "metrics.json").read_text())
    c = metrics["complexity"]
    assert c["held_out"] and c["cap"] == 900 and c["count"] == metrics["gaussians"] <= 900
    assert f"{c['count']:,} Gaussians, " in words
    page = (tmp_path / "run" / "report.html").read_text()
    assert "mean SH degree" in page and "growth ended at step" in page and "growth stopped because" in page
