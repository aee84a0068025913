"""Parts of a user's own in a fit: loss terms, and a density strategy."""

import dataclasses
from dataclasses import dataclass

import pytest
import torch

from tests.scenes import photos, seeds
from warpgs.errors import UsageError
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.folder import load_checkpoint, save_checkpoint
from warpgs.pipeline.train.loss import LOSS_TERMS, LossTerm
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.pipeline.train.trainer import Trainer

CPU = torch.device("cpu")
PLAIN = FitConfig(steps=40, sh_every=15, init=InitConfig(source="points"), sh_degree=0)


@pytest.fixture(autouse=True)
def registries_as_they_were(monkeypatch):
    """What a test registers is gone after it."""
    for registry in (STRATEGIES, LOSS_TERMS):
        registry.names()
        monkeypatch.setattr(registry, "_classes", dict(registry._classes))


def advanced(fit: Trainer, until: int) -> Trainer:
    while fit.step < until:
        fit.advance()
    return fit


def same_bits(a: Trainer, b: Trainer) -> bool:
    (tensors, plain), (others, again) = a.state(), b.state()
    return tensors.keys() == others.keys() and all(torch.equal(t, others[n]) for n, t in tensors.items()) and plain == again


@dataclass(frozen=True)
class Gray(LossTerm):
    """Mean squared difference of the render from a gray."""

    weight: float = 20.0

    def __call__(self, inputs):
        """See the class."""
        return self.weight * (inputs.outputs["rgb"] - 0.5).square().mean()


def test_a_term_that_is_not_active_changes_no_bit():
    """One that is active does."""

    class Never(Gray):
        def active(self, step, steps):
            return False

    plain, active, never = (
        advanced(Trainer(photos(2), seeds(), dataclasses.replace(PLAIN, loss_terms=terms), CPU), 6).gaussians.tensors()
        for terms in ((), (LOSS_TERMS.register("gray")(Gray)(),), (LOSS_TERMS.register("never")(Never)(),))
    )
    assert all(torch.equal(t, never[n]) for n, t in plain.items()) and not torch.equal(active["sh"], plain["sh"])


def test_a_term_without_a_name_of_its_own_is_refused():
    """A run folder could not tell it: never registered, or only by the name of the class that it derives from."""
    with pytest.raises(UsageError, match=r"the loss term Gray has no registered name.*register_loss_term"):
        dataclasses.replace(PLAIN, loss_terms=(Gray(),))
    LOSS_TERMS.register("gray")(Gray)

    class Stronger(Gray):
        """Another class, which inherits the name."""

    with pytest.raises(UsageError, match="Stronger has no registered name"):
        dataclasses.replace(PLAIN, loss_terms=(Stronger(),))
    with pytest.raises(UsageError, match=r"0\.5 is not a loss term"):
        dataclasses.replace(PLAIN, loss_terms=(0.5,))
    config = dataclasses.replace(PLAIN, loss_terms=(Gray(3.0),))
    assert FitConfig.from_json(config.to_json()) == config


def test_two_terms_with_one_name_for_a_map_are_refused():
    """The message names both, where one would have silently read what the other asked for."""

    @LOSS_TERMS.register("first")
    @dataclass(frozen=True)
    class First(LossTerm):
        def needs(self, view, prior):
            return {"shared": view.image[..., 0]}

    @LOSS_TERMS.register("second")
    class Second(First):
        pass

    config = dataclasses.replace(PLAIN, loss_terms=(First(), Second()))
    with pytest.raises(UsageError, match="'first' and 'second' both have a map 'shared'; rename"):
        Trainer(photos(2), seeds(), config, CPU)


def test_a_term_sees_the_maps_that_it_asked_for():
    """Those of the step's own view, at the size at which it is fitted; and what it returns is trained on."""
    seen = []

    @LOSS_TERMS.register("number")
    @dataclass(frozen=True)
    class Number(LossTerm):
        def needs(self, view, prior):
            assert prior is None
            return {"red": view.image[..., 0], "pair": view.image[..., 1:]}

        def __call__(self, inputs):
            target, gaussians = inputs.target, inputs.gaussians
            seen.append(tuple(target.image.shape))
            assert torch.allclose(target.maps["red"], target.image[..., 0], atol=1e-6)
            assert torch.allclose(target.maps["pair"], target.image[..., 1:], atol=1e-6)
            return 0.1 * gaussians.log_scales.square().mean()

    config = dataclasses.replace(PLAIN, loss_terms=(Number(),), half_resolution=0.5, steps=8)
    fit, plain = (Trainer(photos(3), seeds(), c, CPU) for c in (config, dataclasses.replace(config, loss_terms=())))
    advanced(fit, 8), advanced(plain, 8)
    assert seen == [(16, 20, 3)] * 4 + [(32, 40, 3)] * 4
    assert not torch.equal(fit.gaussians.log_scales, plain.gaussians.log_scales)


OWN = """
from dataclasses import dataclass
import torch
from warpgs.pipeline.model.table import Column, DensityUpdate
from warpgs.pipeline.train.strategies.base import Strategy

@dataclass(frozen=True)
class Settings:
    every: int = 5

class OneMore(Strategy):
    Config = Settings

    def columns(self):
        return {"came": Column(0, torch.int32, inherited=False)}

    def setup(self):
        self.asked = len(self.context.table), len(self.context.views)

    def due(self, step):
        return step % self.config.every == 0

    def update(self, step):
        t = self.context
        keep = torch.arange(len(t.table), device=t.device)
        added = {n: row[:1] for n, row in t.gaussians.tensors().items()}
        yield DensityUpdate(keep, added, keep[:1], {"came": step})
        assert len(t.table) == len(keep) + 1

    def state(self):
        return {"own.seen": torch.tensor(self.asked)}, {"asked": list(self.asked)}

    def load(self, tensors, plain):
        assert tensors["own.seen"].tolist() == plain["asked"] == list(self.asked)
"""


@pytest.mark.parametrize("named", ["by file", "by name"])
def test_a_strategy_of_ones_own(tmp_path, named):
    """One more Gaussian every 5 steps, or as its settings say; it has columns and a state, and goes on from a checkpoint."""
    (tmp_path / "own.py").write_text(OWN)
    spec = f"{tmp_path / 'own.py'}:OneMore"
    config = dataclasses.replace(PLAIN, strategy=spec, steps=12)
    with pytest.raises(UsageError, match="does not load your code"):
        Trainer(photos(2), seeds(), config, CPU)
    cls = STRATEGIES.load(spec)
    if named == "by name":
        config = dataclasses.replace(config, strategy=STRATEGIES.register("one_more")(cls).name)
        assert config.strategy == "one_more" and config.strategy_config == cls.Config(5)
    fit, reports = Trainer(photos(2), seeds(), config, CPU), []
    while fit.step < 12:
        reports += fit.advance()
    assert [r.count for r in reports] == [60] * 4 + [61] * 5 + [62] * 3
    assert fit.table.columns["came"].tolist() == [0] * 60 + [5, 10] and fit.strategy.asked == (60, 2)

    save_checkpoint(tmp_path, *advanced(Trainer(photos(2), seeds(), config, CPU), 7).state())
    stored, values = load_checkpoint(tmp_path)
    resumed = Trainer(photos(2), seeds(), FitConfig.from_json(values["config"]), CPU)
    resumed.load(stored, values)
    assert same_bits(advanced(resumed, 12), fit)

    often = dataclasses.replace(config, strategy_config=cls.Config(every=2))
    assert FitConfig.from_json(often.to_json()) == often
    assert len(advanced(Trainer(photos(2), seeds(), often, CPU), 6).gaussians) == 63
