"""Parts of a user's own in a fit: a loss term with parameters of each view, and a density strategy."""

import dataclasses
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from tests.scenes import photos, seeds
from warpgs.errors import UsageError
from warpgs.pipeline.model.init import InitConfig
from warpgs.pipeline.runs.checkpoint import load_checkpoint, save_checkpoint
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.loss import LOSS_TERMS, LossTerm, ViewParameter
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.pipeline.train.trainer import Trainer
from warpgs.scene import View

CPU = torch.device("cpu")
PLAIN = FitConfig(steps=40, sh_every=15, init=InitConfig(source="points", max_sh_degree=0))


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
class Exposure(LossTerm):
    """Squared difference of the photograph and the render times a gain that each view learns."""

    weight: float = 20.0
    lr: float = 0.05

    def view_parameters(self):
        """A gain that starts at 1."""
        return {"gain": ViewParameter((1.0,), self.lr)}

    def __call__(self, render, target, gaussians):
        """See the class."""
        return self.weight * (render.rgb.detach() * target.params["gain"] - target.image).square().mean()


def exposed() -> list[View]:
    """Two views, of which the second has half the light."""
    bright, dark = photos(2)
    return [bright, dataclasses.replace(dark, image=np.float32(0.5) * dark.image)]


@pytest.mark.parametrize("half_resolution", [0.0, 0.5])
def test_views_learn_parameters_of_their_own(tmp_path, half_resolution):
    """Gains tell the exposures apart, also where both sizes of a view share one; a checkpoint has them, and goes on from them.

    The Gaussians do not follow the term here, so that they are, bit for bit, those of a fit without it.
    """
    LOSS_TERMS.register("exposure")(Exposure)
    gray = dataclasses.replace(PLAIN, loss_terms=(Exposure(),), half_resolution=half_resolution)
    fit = Trainer(exposed(), seeds(), gray, CPU)
    assert fit.view_table.params["gain"].tolist() == [[1.0], [1.0]]
    advanced(fit, 40)
    tensors, _ = fit.state()
    bright, dark = tensors["views.params.gain"][:, 0].tolist()
    assert bright > dark + 0.2 and {"views.exp_avg.gain", "views.exp_avg_sq.gain"} <= tensors.keys()

    without = advanced(Trainer(exposed(), seeds(), dataclasses.replace(gray, loss_terms=()), CPU), 40)
    assert all(torch.equal(t, without.gaussians.tensors()[n]) for n, t in fit.gaussians.tensors().items())

    save_checkpoint(tmp_path, *advanced(Trainer(exposed(), seeds(), gray, CPU), 13).state())
    stored, values = load_checkpoint(tmp_path)
    assert stored["views.params.gain"].shape == (2, 1) and bool((stored["views.params.gain"] != 1).all())
    resumed = Trainer(exposed(), seeds(), FitConfig.from_json(values["config"]), CPU)
    resumed.load(stored, values)
    assert same_bits(advanced(resumed, 40), fit)


def test_a_term_that_is_not_active_changes_no_bit():
    """Nor do its parameters move."""

    class Never(Exposure):
        def active(self, step, steps):
            return False

    term = LOSS_TERMS.register("never")(Never)()
    fit = advanced(Trainer(exposed(), seeds(), dataclasses.replace(PLAIN, loss_terms=(term,)), CPU), 6)
    plain = advanced(Trainer(exposed(), seeds(), PLAIN, CPU), 6)
    assert fit.view_table.params["gain"].tolist() == [[1.0], [1.0]]
    assert all(torch.equal(t, plain.gaussians.tensors()[n]) for n, t in fit.gaussians.tensors().items())


def test_a_term_without_a_name_of_its_own_is_refused():
    """A run folder could not tell it: never registered, or only by the name of the class that it derives from."""
    with pytest.raises(UsageError, match=r"the loss term Exposure has no name of its own.*register"):
        dataclasses.replace(PLAIN, loss_terms=(Exposure(),))
    LOSS_TERMS.register("exposure")(Exposure)

    class Stronger(Exposure):
        """Another class, which inherits the name."""

    with pytest.raises(UsageError, match="Stronger has no name of its own"):
        dataclasses.replace(PLAIN, loss_terms=(Stronger(),))
    with pytest.raises(UsageError, match=r"0\.5 is no loss term"):
        dataclasses.replace(PLAIN, loss_terms=(0.5,))
    config = dataclasses.replace(PLAIN, loss_terms=(Exposure(3.0),))
    assert FitConfig.from_json(config.to_json()) == config


@pytest.mark.parametrize("what", ["map", "view parameter"])
def test_two_terms_with_one_name_for_a_part_are_refused(what):
    """The message names both, where one would have silently read what the other asked for."""

    @LOSS_TERMS.register("first")
    @dataclass(frozen=True)
    class First(LossTerm):
        def needs(self, view, prior):
            return {"shared": view.image[..., 0]} if what == "map" else {}

        def view_parameters(self):
            return {"shared": ViewParameter((1.0,), 0.1)} if what != "map" else {}

    @LOSS_TERMS.register("second")
    class Second(First):
        pass

    config = dataclasses.replace(PLAIN, loss_terms=(First(), Second()))
    with pytest.raises(UsageError, match=f"'first' and 'second' both have a {what} 'shared'; rename"):
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

        def __call__(self, render, target, gaussians):
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
        self.asked = len(self.trainer.table), len(self.trainer.views)

    def due(self, step):
        return step % self.config.every == 0

    def update(self, step):
        t = self.trainer
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
    with pytest.raises(UsageError, match="never imported because a file names it"):
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
