"""Density strategies: clone and split, MCMC, and parts of a user's own."""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch

from tests.gaussians import cloud
from tests.pipeline.train.fits import advanced, continued, same_bits
from tests.scenes import photos, seeds
from warpgs.errors import UsageError
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.model.table import DensityUpdate
from warpgs.pipeline.train.loss import LOSS_TERMS, LossTerm
from warpgs.pipeline.train.schedule import OptimizerConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies import clone_split
from warpgs.pipeline.train.strategies.base import STRATEGIES, Strategy
from warpgs.pipeline.train.strategies.clone_split import DensityConfig, refine
from warpgs.pipeline.train.strategies.mcmc import MAX_COPIES, MCMCConfig, perturb, relocated
from warpgs.pipeline.train.trainer import Trainer
from warpgs.scene import Gaussians

CPU = torch.device("cpu")

# Clone, split and prune, and how fast scales may change meanwhile.


def run(gaussians, pull, config=DensityConfig(), after_reset=False, seed=0, capacity=1000):  # noqa: B008
    generator, pull = torch.Generator().manual_seed(seed), torch.tensor(pull, dtype=torch.float32)
    return refine(
        gaussians, pull, config, extent=1.0, capacity=capacity, after_reset=after_reset, generator=generator
    )  # fmt: skip


def gaussians_of(scales: list[float], opacities: list[float]) -> Gaussians:
    g = cloud(len(scales))
    g.log_scales[:] = torch.log(torch.tensor(scales))[:, None]
    g.logit_opacities[:] = torch.logit(torch.tensor(opacities))
    return g


def test_children_lie_where_their_parent_does():
    """The children of many equal parents have the parent's mean and covariance (a needle turned by 60 degrees)."""
    count = 4000
    g = cloud(count)
    g.means[:] = torch.tensor([1.0, 2.0, 3.0])
    g.quats[:] = 3 * torch.tensor([math.cos(math.pi / 6), 0, 0, math.sin(math.pi / 6)])
    g.log_scales[:] = torch.log(torch.tensor([0.5, 0.1, 0.2]))
    g.logit_opacities[:] = 2.0
    children = run(g, [1.0] * count, capacity=2 * count).added["means"].double()
    offsets = children - torch.tensor([1.0, 2.0, 3.0], dtype=torch.float64)
    c, s = 0.5, math.sqrt(0.75)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    wanted = turn @ torch.diag(torch.tensor([0.25, 0.01, 0.04], dtype=torch.float64)) @ turn.T
    assert float(offsets.mean(0).abs().max()) < 0.03
    assert float((offsets.T @ offsets / len(offsets) - wanted).abs().max()) < 0.02


def test_small_ones_are_cloned_large_ones_split_faint_ones_removed(monkeypatch):
    """Rows: 0 small and pulled, 1 large and pulled, 2 faint, 3 left alone."""
    g = gaussians_of([0.005, 0.5, 0.005, 0.005], [0.5, 0.5, 0.001, 0.5])
    change = run(g, [1.0, 1.0, 1.0, 0.0])
    assert change.keep.tolist() == [0, 3]
    assert len(change.added["means"]) == 3  # one clone, two children
    assert torch.equal(change.added["means"][0], g.means[0])
    assert torch.allclose(change.added["log_scales"][1:], g.log_scales[1] - math.log(1.6))
    assert not torch.equal(change.added["means"][1], change.added["means"][2])
    # with room for one, the most pulled Gaussian is cloned; with none, nothing is
    g = gaussians_of([0.005] * 4, [0.5] * 4)
    change = run(g, [1.0, 3.0, 2.0, 0.0], capacity=5)
    assert torch.equal(change.added["means"], g.means[1:2])
    assert len(run(g, [1.0] * 4, capacity=4).added["means"]) == 0
    # size pruning waits for the first opacity reset, as in the reference
    g = gaussians_of([0.5, 0.005], [0.5, 0.5])
    assert run(g, [0, 0]).keep.tolist() == [0, 1]
    assert run(g, [0, 0], after_reset=True).keep.tolist() == [1]
    # the most opaque stays where all are faint
    assert run(gaussians_of([0.1] * 3, [0.001, 0.003, 0.002]), [0, 0, 0]).keep.tolist() == [1]
    # two faint ones, one of them protected; two that are pulled at, one of which may grow
    monkeypatch.setattr(clone_split, "CLONE_SIZE", 1.0)
    gaussians = gaussians_of([0.1] * 4, [0.001, 0.001, 0.5, 0.5])
    pull = torch.tensor([0.0, 0, 1, 1])
    change = refine(
        gaussians, pull, DensityConfig(), extent=1.0, capacity=100, after_reset=False,
        generator=torch.Generator(),
        growing=torch.tensor([True, True, True, False]), protected=torch.tensor([True, False, False, False]),
    )  # fmt: skip
    assert change.keep.tolist() == [0, 2, 3] and change.parents.tolist() == [2]


def test_when_scales_slow_down_and_growth_begins():
    """Log-linear to the share that is left at the last step, from where the set settles; level where nothing is asked for."""
    falling = OptimizerConfig(scales_lr=0.1, scales_decay=0.01)

    def lrs(stable_start: float, *progress: float) -> list[float]:
        return [falling.lrs(p, 1.0, stable_start)["log_scales"] for p in progress]

    assert lrs(0.0, 0.0, 0.5, 1.0) == pytest.approx([0.1, 0.01, 0.001])
    assert lrs(0.5, 0.0, 0.5, 0.75, 1.0) == pytest.approx([0.1, 0.1, 0.01, 0.001])
    assert OptimizerConfig(scales_lr=0.1).lrs(1.0, 1.0)["log_scales"] == pytest.approx(0.1)
    # and ends when phase 3 begins, or after the fraction that is asked for in a fit without phases
    for strategy, ends in (("clone_split", 20), ("mcmc", 33)):
        config = FitConfig(steps=40, init=InitConfig(source="points"), strategy=strategy)
        growth = Trainer(photos(2), seeds(), config, CPU).strategy.growth()
        assert growth[:2] == (10, ends) and [s for s in range(41) if growth.due(s, 7)] == [*range(14, ends + 1, 7)]


# The MCMC strategy: its formulas against the paper's, and what it does to a fit.

CONFIG = FitConfig(
    steps=40, sh_every=10, strategy="mcmc", strategy_config=MCMCConfig(start=4, every=5, min_opacity=0.05),
    init=InitConfig(source="points", opacity=0.3), max_gaussians=75,
)  # fmt: skip


def trained(config: FitConfig = CONFIG, steps: int = 40, device: torch.device = CPU) -> Trainer:
    return advanced(Trainer(photos(4), seeds(61), config, device), steps)


@pytest.mark.parametrize("copies", [1, 2, 5, MAX_COPIES])
def test_relocated_gaussians_render_as_the_one_they_stand_for(copies):
    """Equation 9: as opaque at the centre, and the same integral along a line, by quadrature of what is composited."""
    opacities = torch.tensor([0.005, 0.3, 0.9, 0.999], dtype=torch.float64)
    new, factor = relocated(opacities, torch.full((4,), copies))
    assert torch.allclose(1 - (1 - new) ** copies, opacities, rtol=1e-12)
    x = np.linspace(-40, 40, 400_001)
    for o, n, f in zip(opacities.tolist(), new.tolist(), factor.tolist()):
        shape = np.exp(-0.5 * (x / f) ** 2)
        composited = 1 - (1 - n * shape) ** copies
        whole = o * math.sqrt(2 * math.pi)
        assert np.trapezoid(composited, x) == pytest.approx(whole, rel=1e-6)
    assert copies == 1 or bool((new < opacities).all())


def test_noise_has_each_gaussians_covariance_and_spares_the_opaque(device):
    """Of many equal needles: covariance Sigma^2 of the move, nothing for opaque ones or for a step that is not taken."""
    g = cloud(20_000, device=device)
    g.means[:] = 0
    g.quats[:] = torch.tensor([math.cos(math.pi / 6), 0, 0, math.sin(math.pi / 6)], device=device)
    g.log_scales[:] = torch.log(torch.tensor([0.5, 0.1, 0.2], device=device))
    g.logit_opacities[:] = torch.where(torch.arange(20_000, device=device) < 10_000, -20.0, 3.0)
    settings = torch.tensor([0.0, 7.0, 0.1, 0.0, 0.0, 0.0], device=device)
    still = torch.zeros(1, dtype=torch.bool, device=device)
    perturb(g, settings, still, seed=0, noise_lr=10.0)
    assert not bool(g.means.any())
    perturb(g, settings, ~still, seed=0, noise_lr=10.0)
    moved = g.means[:10_000].double().cpu()
    c, s = 0.5, math.sqrt(0.75)
    turn = torch.tensor([[c, -s, 0], [s, c, 0], [0, 0, 1]], dtype=torch.float64)
    sigma = turn @ torch.diag(torch.tensor([0.25, 0.01, 0.04], dtype=torch.float64)) @ turn.T
    gate = 1 / (1 + math.exp(-0.5))  # opacity 0 is 0.005 below the middle of the gate
    wanted = gate**2 * sigma @ sigma
    assert float((moved.T @ moved / len(moved) - wanted).abs().max()) < 0.05 * float(wanted.max())
    assert float(g.means[10_000:].abs().max()) < 1e-12
    again = g.means.clone()
    g.means[:] = 0
    perturb(g, settings, ~still, seed=0, noise_lr=10.0)
    assert torch.equal(g.means, again)


def test_relocation_in_float32_and_of_the_dead():
    """At the ends of the range of opacities, for every number of copies; the set grows by a fraction up to the cap."""
    opacities = torch.tensor([0.005, 0.5, 1 - 2**-24])
    for copies in range(1, MAX_COPIES + 1):
        found = relocated(opacities, torch.full((3,), copies))
        wanted = relocated(opacities.double(), torch.full((3,), copies))
        for a, b in zip(found, wanted):
            assert torch.allclose(a.double(), b, rtol=1e-6, atol=0) and bool((a > 0).all())
    trainer = trained(steps=9)
    trainer.table.params["logit_opacities"].detach()[:20] = -8.0
    before = len(trainer.table)
    trainer.advance()
    assert trainer.step == 10 and len(trainer.table) == int(1.05 * before)
    assert float(trainer.gaussians.logit_opacities.sigmoid().min()) >= 0.05 - 1e-6
    assert not bool(trainer.table.exp_avg["means"][:20].any())
    assert len(trained().table) == 75


@pytest.mark.cuda
def test_captured_steps_equal_single_steps():
    """On CUDA, noise and regularisation included."""
    device = torch.device("cuda", 0)
    single, captured = (trained(dataclasses.replace(CONFIG, cuda_graph=g), device=device).state()[0] for g in (False, True))
    assert all(torch.equal(t, captured[n]) for n, t in single.items())


# Parts of a user's own in a fit: loss terms, and a density strategy.

PLAIN = FitConfig(steps=40, sh_every=15, init=InitConfig(source="points"), sh_degree=0)


@dataclass(frozen=True)
class Gray(LossTerm):
    """Mean squared difference of the render from a gray."""

    weight: float = 20.0

    def __call__(self, inputs):
        return self.weight * (inputs.outputs["rgb"] - 0.5).square().mean()


@pytest.mark.usefixtures("registries_as_they_were")
def test_terms_without_a_name_or_map_of_their_own_are_refused():
    """A run folder could not tell a term that is not registered, or has the name of the class that it derives from."""
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

    # one would have silently read what the other asked for
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


@pytest.mark.usefixtures("registries_as_they_were")
def test_a_term_without_a_gradient_is_refused_at_its_first_step(device):
    """Detached, it would change nothing without a word; 0 says that it does not apply to a view."""

    @LOSS_TERMS.register("constant")
    @dataclass(frozen=True)
    class Constant(Gray):
        def __call__(self, inputs):
            return super().__call__(inputs).detach()

    config = dataclasses.replace(PLAIN, steps=4, cuda_graph=False)
    with pytest.raises(UsageError, match=r"'constant' has no gradient, so it changes nothing: Constant\.__call__ must"):
        Trainer(photos(2), seeds(), dataclasses.replace(config, loss_terms=(Constant(),)), device).advance()
    nothing = advanced(Trainer(photos(2), seeds(), dataclasses.replace(config, loss_terms=(Constant(0.0),)), device))
    assert nothing.step == 4


def own_update(make):
    class Own(Strategy):
        def due(self, step):
            return step == 2

        def update(self, step):
            yield make(self.context)

    STRATEGIES.register("own")(Own)
    return dataclasses.replace(PLAIN, strategy="own", steps=4, max_gaussians=100)


def grown(context, count, parent=0, value=None, keep=None):
    rows = {n: t[:1].repeat(count, *[1] * (t.dim() - 1)) for n, t in context.gaussians.tensors().items()}
    if value is not None:
        rows["means"][-1, 0] = value
    keep = range(len(context.table)) if keep is None else keep
    keep, parents = (torch.tensor(list(i), dtype=torch.int64, device=context.device) for i in (keep, [parent] * count))
    return DensityUpdate(keep, rows, parents)


def overwriting(context, rows, value=0.0):
    means, keep = (
        torch.full((len(rows), 3), value, device=context.device),
        torch.arange(len(context.table), device=context.device),
    )
    return DensityUpdate(keep, overwritten=torch.tensor(rows, device=context.device), values={"means": means})


@pytest.mark.usefixtures("registries_as_they_were")
@pytest.mark.parametrize(
    "make, message",
    [
        (lambda c: grown(c, 41), "makes 101 Gaussians of 60, but max_gaussians and the memory limit allow 100; add at most"),
        (lambda c: grown(c, 2, value=math.nan), "rows of means have non-finite values"),
        (lambda c: grown(c, 2, value=math.inf), "rows of means have non-finite values"),
        (lambda c: grown(c, 1, keep=[0, 1, 1, 2]), "keep holds a row twice"),
        (lambda c: grown(c, 1, keep=[1, 2, 1]), "keep holds a row twice"),
        (lambda c: grown(c, 1, keep=[0, 60]), "keep must be from 0 to 59"),
        (lambda c: grown(c, 1, keep=[-1, 0]), "keep must be from 0 to 59"),
        (lambda c: grown(c, 1, parent=60), "parents must be from -1 to 59"),
        (lambda c: overwriting(c, [3, 3]), "overwritten holds a row twice"),
        (lambda c: overwriting(c, [60]), "overwritten must be from 0 to 59"),
        (lambda c: overwriting(c, [1], math.nan), "rows of means have non-finite values"),
        (lambda c: DensityUpdate(torch.ones(60, dtype=torch.bool)), "keep must be an int64 tensor of one axis"),
    ],
)
def test_an_update_that_damages_the_table_is_refused_by_name(make, message, device):
    """Whatever the strategy: the set keeps to its capacity, its rows are finite and come from rows that exist."""
    fit = Trainer(photos(2), seeds(), own_update(make), device)
    with pytest.raises(UsageError, match=rf"^the strategy Own, after step 2: .*{message}"):
        advanced(fit)
    assert len(fit.table) == 60
    fit = Trainer(photos(2), seeds(), own_update(lambda c: grown(c, 40)), device)
    assert len(advanced(fit).table) == 100


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


@pytest.mark.usefixtures("registries_as_they_were")
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

    stored = FitConfig.from_json(config.to_json())
    assert same_bits(continued(lambda: Trainer(photos(2), seeds(), stored, CPU), 7, tmp_path), fit)

    often = dataclasses.replace(config, strategy_config=cls.Config(every=2))
    assert FitConfig.from_json(often.to_json()) == often
    assert len(advanced(Trainer(photos(2), seeds(), often, CPU), 6).gaussians) == 63
