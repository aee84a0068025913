"""Recorded steps on CUDA: the same bits as step by step, whatever happens on the way."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.example_terms import DepthCorrelation
from tests.pipeline.test_paper import CONFIG as METHOD
from tests.scenes import photos, priors, seeds
from warpgs.errors import NotFiniteError
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train import step
from warpgs.pipeline.train.schedule import OptimizerConfig, PhaseConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.scene import View

pytestmark = pytest.mark.cuda

BUSY = FitConfig(
    steps=60, sh_every=15, init=InitConfig(source="points"),
    density=DensityConfig(start=8, every=9, gradient=1e-5, reset_every=25), optimizer=OptimizerConfig(opacities_decay=0.002),
)  # fmt: skip


def fitted(views: list[View], recorded: bool, config: FitConfig = BUSY) -> tuple[Trainer, list]:
    """A fit of all steps on CUDA, and its reports."""
    config = dataclasses.replace(config, cuda_graph=recorded)
    fit = Trainer(views, seeds(61), config, torch.device("cuda", 0), priors=priors(views))
    reports = []
    while fit.step < config.steps:
        reports += fit.advance(100)
    return fit, reports


def four() -> list[View]:
    """Views of one size."""
    return photos(4)


def sizes() -> list[View]:
    """Views of two sizes, one of them with a mask."""
    views = photos(2) + photos(2, 24, 20)
    views = [View(f"{i}", v.camera, v.image) for i, v in enumerate(views)]
    mask = np.ones(views[0].image.shape[:2], bool)
    mask[:, :8] = False
    return [View("masked", views[0].camera, views[0].image, mask), *views[1:]]


def cut_out() -> list[View]:
    """Views that know an opacity, which grows from left to right."""
    views = photos(4)
    alpha = np.linspace(0, 1, views[0].image.shape[1], dtype=np.float32)
    return [dataclasses.replace(v, alpha=np.broadcast_to(alpha, v.image.shape[:2]).copy()) for v in views]


THREE = dataclasses.replace(BUSY, batch=3, dropout=0.2, steps=40)
DEPTH = dataclasses.replace(BUSY, loss_terms=(DepthCorrelation(0.3, 0.7),), half_resolution=0.3)
HALF = dataclasses.replace(BUSY, half_resolution=0.5, antialiased=True)
EVENTS = dataclasses.replace(METHOD, steps=20, phases=PhaseConfig(600, 400))


@pytest.mark.parametrize(
    ("make", "config"),
    [
        *((make, config) for make in (four, sizes, cut_out) for config in (BUSY, THREE)), (four, DEPTH), (sizes, DEPTH),
        (four, HALF), (four, EVENTS),
    ],
)  # fmt: skip
def test_recorded_steps_equal_single_steps(make, config):
    """Through densification, opacity resets, changes of degree and size, dropout, events and protection, in batches or not.

    A term that ends on the way changes the result.
    """
    single, said = fitted(make(), recorded=False, config=config)
    recorded, reports = fitted(make(), recorded=True, config=config)
    a, b = single.state()[0], recorded.state()[0]
    assert len(single.gaussians) != 61 and recorded.layout.graphs > 0
    assert config is not EVENTS or (single.strategy.events == recorded.strategy.events and len(single.strategy.events) > 2)
    assert all(torch.equal(a[k], b[k]) for k in a)
    assert [(r.step, r.count) for r in said] == [(r.step, r.count) for r in reports]
    assert np.allclose([r.loss for r in said], [r.loss for r in reports], rtol=1e-6)
    if config is DEPTH:
        without, _ = fitted(make(), recorded=True, config=dataclasses.replace(config, loss_terms=()))
        assert not torch.equal(recorded.gaussians.means[:10], without.gaussians.means[:10])


def test_recordings_do_not_pile_up(monkeypatch):
    """Memory of recordings that are no longer used goes back: a long fit holds no more than a short one of its size."""
    torch.cuda.empty_cache()
    monkeypatch.setattr(step, "DEAD_BYTES", 2**22)
    fit, _ = fitted(photos(4), recorded=True)
    held = []
    for _ in range(40):
        fit.taker.clear()
        fit.step -= 1
        fit.advance(1)
        held.append(torch.cuda.memory_reserved())
    assert max(held[20:]) <= max(held[:10]) + 2**22


@pytest.mark.parametrize("batch", [1, 3])
def test_too_little_capacity_is_found_and_fixed(monkeypatch, batch):
    """Steps that would overflow change nothing; they are captured anew and taken, and the result is the same."""
    config = dataclasses.replace(BUSY, batch=batch)
    reference, _ = fitted(photos(4), recorded=False, config=config)
    honest, tries = step.instance_capacity, []

    def scarce(*args):
        tries.append(honest(*args))
        return 16 if len(tries) % 2 else tries[-1]

    monkeypatch.setattr(step, "instance_capacity", scarce)
    fit, reports = fitted(photos(4), recorded=True, config=config)
    assert len(tries) >= 4
    a, b = reference.state()[0], fit.state()[0]
    assert all(torch.equal(a[k], b[k]) for k in a) and [r.step for r in reports] == list(range(1, 61))


def test_loss_that_is_no_number_stops_before_it_harms():
    """A NaN in one photograph: the Gaussians are those of the step before."""
    views = photos(4)
    bad = [*views[:3], View("bad", views[3].camera, np.full_like(views[3].image, np.nan))]
    config = dataclasses.replace(BUSY, density=DensityConfig(start=1000))
    fit = Trainer(bad, seeds(), config, torch.device("cuda", 0))
    with pytest.raises(NotFiniteError, match="became nan"):
        fit.advance(100)
    assert fit.step < 4 and all(bool(torch.isfinite(t).all()) for t in fit.gaussians.tensors().values())
