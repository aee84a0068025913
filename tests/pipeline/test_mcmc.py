"""The MCMC strategy: its formulas against the paper's, and what it does to a fit."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.gaussians import cloud
from tests.scenes import photos, seeds
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.run.folder import load_checkpoint, save_checkpoint
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.mcmc import MAX_COPIES, MCMCConfig, perturb, relocated
from warpgs.pipeline.train.trainer import Trainer

CPU = torch.device("cpu")
CONFIG = FitConfig(
    steps=40, sh_every=10, strategy="mcmc", strategy_config=MCMCConfig(start=4, every=5, min_opacity=0.05),
    init=InitConfig(source="points", opacity=0.3), max_gaussians=75,
)  # fmt: skip


def trained(config: FitConfig = CONFIG, steps: int = 40, device: torch.device = CPU) -> Trainer:
    trainer = Trainer(photos(4), seeds(61), config, device)
    while trainer.step < steps:
        trainer.advance(steps - trainer.step)
    return trainer


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


def test_relocation_in_float32_is_that_of_float64():
    """At the ends of the range of opacities, for every number of copies."""
    opacities = torch.tensor([0.005, 0.5, 1 - 2**-24])
    for copies in range(1, MAX_COPIES + 1):
        found = relocated(opacities, torch.full((3,), copies))
        wanted = relocated(opacities.double(), torch.full((3,), copies))
        for a, b in zip(found, wanted):
            assert torch.allclose(a.double(), b, rtol=1e-6, atol=0) and bool((a > 0).all())


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


def test_the_dead_are_relocated_and_the_set_grows_to_its_cap():
    """After an event no Gaussian is dead, and none was removed; the set grows by a fraction up to the cap."""
    trainer = trained(steps=9)
    trainer.table.params["logit_opacities"].detach()[:20] = -8.0
    before = len(trainer.table)
    trainer.advance()
    assert trainer.step == 10 and len(trainer.table) == int(1.05 * before)
    assert float(trainer.gaussians.logit_opacities.sigmoid().min()) >= 0.05 - 1e-6
    assert not bool(trainer.table.exp_avg["means"][:20].any())
    assert len(trained().table) == 75


def test_a_continued_fit_gives_the_same_bits(tmp_path):
    """Noise and sampling go on as if the fit had never stopped."""
    straight, broken = trained(), trained(steps=17)
    save_checkpoint(tmp_path, *broken.state())
    resumed = Trainer(photos(4), seeds(61), CONFIG, CPU)
    resumed.load(*load_checkpoint(tmp_path))
    while resumed.step < 40:
        resumed.advance()
    a, b = straight.state()[0], resumed.state()[0]
    assert a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


@pytest.mark.cuda
def test_captured_steps_equal_single_steps():
    """On CUDA, noise and regularisation included."""
    device = torch.device("cuda", 0)
    single, captured = (trained(dataclasses.replace(CONFIG, cuda_graph=g), device=device) for g in (False, True))
    a, b = single.state()[0], captured.state()[0]
    assert all(torch.equal(a[k], b[k]) for k in a)


def test_settings_survive_json_and_bad_ones_are_refused():
    """The strategy's own settings stand in the configuration; numbers that cannot work are refused."""
    from warpgs.errors import UsageError

    assert FitConfig.from_json(CONFIG.to_json()) == CONFIG
    assert FitConfig(strategy="mcmc").strategy_config == MCMCConfig()
    for bad in ({"every": 0}, {"growth": -1.0}, {"noise_lr": math.nan}, {"min_opacity": 0.9}):
        with pytest.raises(UsageError, match="mcmc"):
            MCMCConfig(**bad)
