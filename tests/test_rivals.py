"""The published methods in examples/rivals: each term or change on a case computed by hand, and a short fit."""

import dataclasses
import math
import sys
from pathlib import Path

import pytest
import torch

from tests.scenes import photos, priors, seeds, three_gaussians
from warpgs import Gaussians, UsageError
from warpgs.kernels.update import Setting, opacity_dropout
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.model.table import DensityUpdate, Table
from warpgs.pipeline.train.loss import LossInputs, Target
from warpgs.pipeline.train.presets import preset_settings
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.base import STRATEGIES
from warpgs.pipeline.train.trainer import Trainer

CPU = torch.device("cpu")
FOLDER = Path(__file__).parent.parent / "examples" / "rivals"

pytestmark = pytest.mark.usefixtures("registries_as_they_were")


def preset(name: str) -> FitConfig:
    return preset_settings(f"{FOLDER / name}.py:{name}")[0]


def short(config: FitConfig, device: torch.device = CPU, **own) -> Trainer:
    """Return a fit at step 0 that refines after each step, with the rival's settings changed by name."""
    changed = None if config.strategy_config is None else dataclasses.replace(config.strategy_config, **own)
    density = dataclasses.replace(config.density, start=0, every=1, gradient=1e-6, stop_fraction=1.0)
    config = dataclasses.replace(
        config, steps=3, init=InitConfig(source="points"), sh_degree=0, density=density, strategy_config=changed
    )
    found = photos(3)
    return Trainer(found, seeds(), config, device, priors=priors(found))


def advanced(trainer: Trainer, until: int = 3) -> Trainer:
    while trainer.step < until:
        assert all(math.isfinite(report.loss) for report in trainer.advance())
    return trainer


def module(config: FitConfig):
    return sys.modules[STRATEGIES.find(config.strategy).__module__]


def replaced(table: Table, gaussians: Gaussians) -> None:
    table.apply(DensityUpdate(torch.arange(len(gaussians))))
    for name, t in gaussians.tensors().items():
        table.params[name].detach().copy_(t)


def rows(count: int) -> Gaussians:
    return Gaussians(
        means=torch.arange(count)[:, None] * torch.tensor([[1.0, 0.0, 0.0]]),
        quats=torch.tensor([[math.sqrt(0.5), 0.0, 0.0, math.sqrt(0.5)]]).repeat(count, 1),  # x turns to y
        log_scales=torch.tensor([[1.0, 2.0, 4.0]]).log().repeat(count, 1),
        logit_opacities=torch.arange(count, dtype=torch.float32),
        sh=torch.ones(count, 1, 3),
    )


@pytest.mark.parametrize("name", [p.stem for p in sorted(FOLDER.glob("*.py"))])
def test_a_resumed_fit_has_the_same_bits(name, device):
    """A fit of three steps that adds Gaussians after each, with every term from the first step on."""
    own = {"fsgs": {"distance": 0.01, "until": 1.0}, "binocular3dgs": {"begins": 0.0}}.get(name, {})
    whole, half, again = (short(preset(name), device, **own) for _ in range(3))
    again.load(*advanced(half, 2).state())
    (tensors, plain), (others, rest) = advanced(whole).state(), advanced(again).state()
    assert plain == rest and tensors.keys() == others.keys()
    assert all(torch.equal(t, others[n]) for n, t in tensors.items())
    assert len(whole.gaussians) > len(seeds())


def test_nexusgs_starts_from_flow_and_splits_into_four():
    """One child is at its parent's mean, three are spread by three times its scales; all are 3.2 times smaller; capacity."""
    config = preset("nexusgs")
    assert (config.init.source, config.init.merge_px, config.init.fill_px, config.steps) == ("flow", 0, 0, 30_000)
    children = module(config).split(rows(2000).tensors(), 4, torch.Generator().manual_seed(0))
    moved = (children["means"].view(4, 2000, 3) - rows(2000).means).double()
    assert not moved[0].any()
    torch.testing.assert_close(moved[1:].std((0, 1)), torch.tensor([6.0, 3.0, 12.0]).double(), rtol=0.05, atol=0)
    torch.testing.assert_close(children["log_scales"][7999].exp(), torch.tensor([1.0, 2.0, 4.0]) / 3.2)
    trainer = short(config)
    count, context, parents = len(trainer.gaussians), trainer.context, torch.tensor([2, 0, 0, 1, 1])
    added = {n: t[parents] for n, t in context.gaussians.tensors().items()}
    change = DensityUpdate(torch.arange(2, count), added, parents)
    assert trainer.strategy.widened(change).parents.tolist() == [2, *[0, 1] * 4]
    context.capacity = count + 6  # three more than with two children each: room for two more of one split
    assert trainer.strategy.widened(change).parents.tolist() == [2, 1, 1, 0, 0, 0, 0]


def test_fsgs_adds_gaussians_on_long_edges_and_correlates_depth():
    """A far point gets one on each of its three edges, with the size of the end; correlation is 1, -1 and a case by hand."""
    config = preset("fsgs")
    own = module(config)
    distances, ends = own.neighbours(torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [3, 0, 0], [30, 0, 0]]))
    assert distances[4].tolist() == [27, 28, 29] and ends[4].tolist() == [3, 2, 1]
    a, ones = torch.tensor([[1.0, 2.0], [3.0, 6.0]]), torch.ones(2, 2)
    for b, result in ((2 * a + 5, 1), (-a, -1), (torch.tensor([[0.0, 1], [0, 1]]), 2 / math.sqrt(14)), (ones, 0)):
        assert float(own.correlation(a, b, ones)) == pytest.approx(result, abs=1e-6)
    (term,), view = config.loss_terms, short(config).views[0]
    depth = torch.rand(32, 40, generator=torch.Generator().manual_seed(0)) + 1
    given = term.needs(dataclasses.replace(view, depth=3 * depth), None)
    maps = term.needs(view, priors(photos(1))[0])["fsgs_depth"]
    assert torch.equal(maps[..., 0], -torch.from_numpy(priors(photos(1))[0].disparity)) and bool((maps[..., 1] == 1).all())
    outputs = {"alpha": torch.ones(32, 40), "depth": depth}
    inputs = LossInputs(outputs, Target(view.image, None, given), rows(4), view.camera, torch.ones(()))
    assert float(term(inputs)) == pytest.approx(0, abs=1e-6)
    inputs = dataclasses.replace(inputs, outputs=outputs | {"depth": 9 - depth})
    assert float(term(inputs)) == pytest.approx(2 * 0.05, abs=1e-6) and not term.active(96, 100)
    strategy = short(config).strategy
    replaced(strategy.context.table, rows(5))
    strategy.context.table.params["means"].detach()[4] = torch.tensor([30.0, 0, 0])
    strategy.config = dataclasses.replace(strategy.config, distance=20 / strategy.context.extent)
    change = strategy.unpooled()
    assert change.parents.tolist() == [3, 2, 1] and change.added["means"][:, 0].tolist() == [16.5, 16, 15.5]
    assert change.added["logit_opacities"].tolist() == [3, 2, 1] and not change.added["sh"].any()
    assert change.added["quats"].tolist() == [[1, 0, 0, 0]] * 3 and change.keep.tolist() == [0, 1, 2, 3, 4]


def test_dngaussian_compares_normalised_patches_and_moves_what_each_term_may():
    """Equal up to scale and offset: 0; reversed: 0.4, and 4 by the image; hard depth moves means alone, soft one opacities."""
    config = preset("dngaussian")
    own, a = module(config), torch.tensor([[1.0, 2.0], [3.0, 4.0]])
    every = torch.ones(2, 2, dtype=torch.bool)
    assert float(own.depth_difference(a, 3 * a + 7, every)) == 0
    assert float(own.depth_difference(a, -a, every)) == pytest.approx(4.4, rel=1e-5)
    two, given = torch.cat([a, 2 * a + 6], 1), torch.cat([a, -a], 1)  # by the image: variances 21.1875 and 7.5
    gap = ((torch.tensor([-1.5, -0.5, 0.5, 1.5]) ** 2).mean()) * torch.tensor(
        [(21.1875**-0.5 - 7.5**-0.5) ** 2, (2 * 21.1875**-0.5 + 7.5**-0.5) ** 2]
    )
    settings = own.DnConfig(patch=2, tolerance=0)
    found = float(own.depth_difference(two, given, torch.ones(2, 4, dtype=torch.bool), settings))
    assert found == pytest.approx(0.1 * 2 + float(gap.mean()), rel=1e-4)
    strategy = short(config).strategy
    table = strategy.context.table
    for term, names in zip(strategy.terms(table.gaussians), ({"means"}, {"logit_opacities"}), strict=True):
        gradients = torch.autograd.grad(term, list(table.params.values()), allow_unused=True)
        assert {n for n, g in zip(table.params, gradients) if g is not None and g.any()} == names
    views = photos(2)
    with pytest.raises(UsageError, match="one size"):
        Trainer([views[0], photos(1, 24, 16)[0]], seeds(), dataclasses.replace(config, init=InitConfig(source="points")), CPU,
                priors=[*priors(views[:1]), *priors(photos(1, 24, 16))])  # fmt: skip


def test_dropgaussian_hides_a_fifth_in_the_last_step():
    """The others have 1.25 times their opacity; a step in the middle hides a tenth."""
    config = preset("dropgaussian")
    assert (short(config).dropout, config.density.reset_opacity, config.steps) == (0.2, 0.01, 10_000)
    for p in (0.1, 0.2):
        factors = opacity_dropout(
            20_000, torch.tensor(Setting.row(dropout=p, number=1, step=1, means_lr=0.0, shift=(0.0, 0.0, 0.0))), 0
        )
        hidden = factors == 0
        assert float(hidden.float().mean()) == pytest.approx(p, abs=0.01)
        torch.testing.assert_close(factors[~hidden], torch.full_like(factors[~hidden], 1 / (1 - p)))


def test_binocular3dgs_warps_by_the_disparity_and_decays_opacities():
    """A ramp moves by whole and half pixels; moved renders of a good model match the photographs, those of another do not."""
    config = preset("binocular3dgs")
    own, ramp = module(config), torch.arange(5.0)[None, :, None].repeat(1, 1, 3)
    found, inside = own.warped(ramp, torch.tensor([[0.0, 1.0, 0.5, -0.5, -1.5]]))
    assert found[0, :4, 0].tolist() == [0, 0, 1.5, 3.5]
    assert inside.tolist() == [[True, True, True, True, False]]
    one = torch.ones(1, 5)
    term = own.stereo_difference(ramp, 2 * ramp, one, torch.ones(1, 5, dtype=torch.bool))
    assert float(term) == pytest.approx((1 + 0 + 1 + 2) / 4)  # |2 (x - 1) - x| for x from 1 to 4
    assert config.optimizer.opacities_decay == 0.005
    strategy = short(config, begins=0.0, distance=0.02).strategy
    assert strategy.phase(1)[1] and not short(config).strategy.phase(2)[1]
    replaced(strategy.context.table, three_gaussians())
    losses = []
    for moved in (0, 0.1):
        strategy.context.table.params["means"].detach()[:, 0] += moved
        losses.append(float(strategy.regularisation((True, True), strategy.context.table.gaussians).detach()))
    assert losses[0] < 0.003 < 0.01 < losses[1], losses
