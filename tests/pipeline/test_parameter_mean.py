"""Mean of the parameters over the last steps: its samples, its bits, fits that are continued, and when it is chosen."""

from __future__ import annotations

import dataclasses
import itertools
import math

import pytest
import torch

from tests.example_terms import DepthCorrelation
from tests.scenes import photos, priors, seeds, view_stub
from warpgs.errors import DataError, UsageError
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train.memory import layout_of
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.schedule import OptimizerConfig
from warpgs.pipeline.train.settings import AVERAGED_VIEWS, FitConfig, settings_by_views
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import SAMPLES, ParameterMean, Trainer
from warpgs.pipeline.train.view_modules import Exposure

CPU = torch.device("cpu")
CONFIG = FitConfig(
    steps=20, init=InitConfig(source="points"), density=DensityConfig(start=1000), view_modules=(Exposure(),),
    optimizer=OptimizerConfig(average_last=0.25),
)  # fmt: skip
"""The last five steps are averaged, and the set of Gaussians does not change."""


def trainer(config: FitConfig = CONFIG, device: torch.device = CPU) -> Trainer:
    """A fit that has not begun."""
    views = photos(4)
    return Trainer(views, seeds(61), config, device, priors=priors(views))


def finish(fit: Trainer, step: int | None = None) -> dict[str, torch.Tensor]:
    """Take steps up to ``step``, or all; return copies of the parameters."""
    while fit.step < (step or fit.steps):
        fit.advance((step or fit.steps) - fit.step)
    return {n: t.detach().clone() for n, t in fit.learned.params.items()}


def plain(config: FitConfig) -> FitConfig:
    """The settings without a mean."""
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


def test_the_result_is_the_mean_of_the_last_steps():
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


def test_a_continued_fit_has_the_same_bits():
    """Also from a state between two samples, and from one before all samples."""
    whole = finish(trainer())
    for stop in (12, 18):
        first = trainer()
        finish(first, stop)
        tensors, values = first.state()
        assert any(n.startswith("mean.") for n in tensors) == (stop > 15)
        again = trainer()
        again.load({n: t.clone() for n, t in tensors.items()}, values)
        assert all(torch.equal(whole[n], t) for n, t in finish(again).items())


def test_a_change_of_the_set_restarts_the_mean():
    """Rows before and after are other Gaussians: only the steps after the change count."""
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


def test_a_damaged_mean_is_refused():
    """A missing or unknown sum, another shape or type, and a count that is none."""
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


def test_the_memory_plan_counts_the_sums():
    """One more copy of the parameters."""
    fit = trainer()
    without = layout_of(fit.table, fit.views)
    assert fit.layout.averaged and not trainer(plain(CONFIG)).layout.averaged
    assert dataclasses.replace(without, averaged=True).held(100) == without.held(100) + 100 * fit.table.row_bytes


@pytest.mark.parametrize(("views", "fraction"), [(3, 0.0), (AVERAGED_VIEWS - 1, 0.0), (AVERAGED_VIEWS, 0.05), (300, 0.05)])
def test_many_views_have_a_mean(views, fraction):
    """The choice is named; what is given holds."""
    train = [view_stub()] * views
    config, notes = settings_by_views(PRESETS["default"], train, "cuda")
    assert config.optimizer.average_last == fraction
    assert ("mean of the last 5% of the steps" in " ".join(notes)) == (fraction > 0)
    given = dataclasses.replace(config, optimizer=dataclasses.replace(config.optimizer, average_last=0.5))
    assert settings_by_views(given, train, "cuda")[0].optimizer.average_last == 0.5


@pytest.mark.parametrize("fraction", [-0.1, 1.1, math.nan])
def test_a_fraction_out_of_range_is_refused(fraction):
    """Also one that is no number."""
    with pytest.raises(UsageError, match="average-last"):
        OptimizerConfig(average_last=fraction)


@pytest.mark.cuda
@pytest.mark.parametrize("parts", [(), (DepthCorrelation(0.3, 0.7),)])
def test_graphs_give_the_same_bits(parts):
    """Captured steps end at each sample."""
    config = dataclasses.replace(CONFIG, steps=100, loss_terms=parts)
    cuda = torch.device("cuda", 0)
    graphs, single = (finish(trainer(dataclasses.replace(config, cuda_graph=on), cuda)) for on in (True, False))
    assert all(torch.equal(single[n], t) for n, t in graphs.items())
    fit = trainer(config, cuda)
    finish(fit, 98)
    assert fit.mean.count == 23
