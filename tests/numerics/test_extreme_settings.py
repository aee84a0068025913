"""Settings of a fit at the extremes: any number in any field is refused, or gives finite steps (docs/numerics.md, T11)."""

import dataclasses
import math

import pytest
import torch

from tests.scenes import photos, priors, seeds
from warpgs.errors import UsageError
from warpgs.pipeline.model.limits import LimitConfig
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train.loss import LossConfig
from warpgs.pipeline.train.sampling import ImportanceConfig, SamplerConfig
from warpgs.pipeline.train.schedule import OptimizerConfig, PhaseConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.stopping import StoppingConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.strategies.importance_sampling import MethodConfig, ProtectConfig
from warpgs.pipeline.train.trainer import Trainer

NUMBERS = [math.nan, math.inf, -1, 0, 1e-300, 1, 3, 1e300]
KINDS = [
    DensityConfig, OptimizerConfig, LossConfig, ImportanceConfig, SamplerConfig, ProtectConfig, PhaseConfig, MethodConfig,
    InitConfig, StoppingConfig, LimitConfig, FitConfig,
]  # fmt: skip
SHORT = FitConfig(
    steps=4, init=InitConfig(source="points"), sh_degree=1, sh_every=2, phases=PhaseConfig(coarse=1, every=1),
    density=DensityConfig(start=1, every=2, stop_fraction=1.0, gradient=1e-6),
    max_gaussians=200, strategy="importance_sampling",
    method=MethodConfig(events=True, hier=True, pm=False, sampler=SamplerConfig(min_alpha=0.01)),
)  # fmt: skip


def composed(part, name: str, value) -> FitConfig:
    """The short fit with one field of one of its parts changed; a part's own checks run."""
    if type(part) is FitConfig:
        return dataclasses.replace(part, **{name: value})
    for f in dataclasses.fields(SHORT):
        own = getattr(SHORT, f.name)
        if type(own) is part:
            return dataclasses.replace(SHORT, **{f.name: dataclasses.replace(own, **{name: value})})
    for f in dataclasses.fields(SHORT.method):
        own = getattr(SHORT.method, f.name)
        if type(own) is part:
            method = dataclasses.replace(SHORT.method, **{f.name: dataclasses.replace(own, **{name: value})})
            return dataclasses.replace(SHORT, method=method)
    return dataclasses.replace(SHORT, **{name: value})


def test_the_list_of_settings_is_complete():
    """Whatever settings dataclass a fit is composed of is in the list above, but for the priors', which hold names."""
    parts = [getattr(c, f.name) for c in (SHORT, SHORT.method) for f in dataclasses.fields(c)]
    held = {type(p).__name__ for p in parts if dataclasses.is_dataclass(p)} | {"FitConfig"}
    assert held - {k.__name__ for k in KINDS} == {"PriorConfig"}


@pytest.mark.parametrize(
    "numbers", [(math.nan, -1, 0, 1e300), pytest.param(NUMBERS, marks=pytest.mark.slow)], ids=["few", "all"]
)
@pytest.mark.parametrize("kind", KINDS, ids=lambda k: k.__name__)
def test_a_setting_is_refused_or_works(kind, numbers):
    """Any number in any field, zero intervals too: a UsageError at once, or steps, events and resets that stay finite."""
    views, points = photos(1, 12, 10), seeds(12)
    known, refused = priors(views), 0
    torch.set_num_threads(1)  # everything is tiny
    for field in dataclasses.fields(kind):
        # bytes of memory and numbers of points are amounts of work, not numbers that could be wrong
        if type(field.default) not in (int, float) or field.name in ("memory_limit", "random_count", "steps"):
            continue
        for value in numbers:
            if type(field.default) is int and value not in range(-9, 10):
                continue  # the command line reads whole numbers
            try:
                config = composed(kind, field.name, type(field.default)(value))
            except UsageError:
                refused += 1
                continue
            fit = Trainer(views, points, config, torch.device("cpu"), priors=known)
            for _ in range(2):
                assert math.isfinite(fit.advance()[0].loss), (field.name, value)
            fit.table.reset_opacities(config.density.reset_opacity)
            fit.strategy.gradients.was_reset = True
            assert math.isfinite(fit.advance()[0].loss), (field.name, value)
            for name, t in fit.table.state().items():
                assert bool(torch.isfinite(t).all()), (field.name, value, name)
    assert refused > 0
