"""A warmup uses what a fit of the same settings uses, says what goes wrong, and leaves no trace in the fit."""

import dataclasses
import threading

import numpy as np
import pytest
import torch

from tests.scenes import photos, priors, seeds
from warpgs.errors import DataError
from warpgs.pipeline.model import start
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.paper.strategy import UNIFORM
from warpgs.pipeline.train import setup
from warpgs.pipeline.train import trainer as warmups
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.settings import settings_by_views
from warpgs.pipeline.train.setup import prepare
from warpgs.pipeline.train.strategies.sampling import Sampling
from warpgs.pipeline.train.trainer import POINTS, STEPS, Trainer, background_warmup, run, warm_up
from warpgs.priors.views import PriorConfig
from warpgs.scene import ViewDepth

CPU, CUDA = torch.device("cpu"), torch.device("cuda")
CHOSEN = {name: settings_by_views(config, photos(3), "cpu")[0] for name, config in PRESETS.items()}
"""Presets with every setting chosen, as a fit has them."""


@pytest.mark.parametrize("preset", PRESETS)
def test_every_part_of_a_fit_is_used(preset, monkeypatch):
    """Every step is taken, Gaussians are added by refinement, events sample where the preset has any, and a view is scored."""
    scored, config = [], CHOSEN[preset]
    score = warmups.score
    monkeypatch.setattr(warmups, "score", lambda view, image: scored.append(score(view, image)))
    fit = warm_up(config, CPU)
    assert fit.step == STEPS and len(fit.gaussians) > POINTS
    assert isinstance(fit.strategy, Sampling) == (preset in ("default", "quick", "paper-literal"))
    assert not isinstance(fit.strategy, Sampling) or len(fit.strategy.events) == 1
    assert len(scored) == 1 and 0 < scored[0].psnr < 30 and fit.taker.graphs is None


def test_limits_of_the_real_fit_do_not_stop_it():
    """A memory limit is for the real fit alone; a bound on Gaussians holds."""
    fit = warm_up(dataclasses.replace(CHOSEN["quick"], memory_limit=1, half_resolution=0.5, max_gaussians=50), CPU)
    assert fit.step == STEPS and len(fit.gaussians) <= 50


def test_only_a_free_gpu_is_warmed_up(monkeypatch):
    """Nothing is begun on a CPU, nor where networks for priors run on the GPU."""
    monkeypatch.setattr(warmups, "warm_up", lambda *_: pytest.fail("begun"))
    networks = dataclasses.replace(PRESETS["default"].priors, onnx_provider="cuda")
    for config, device in ((PRESETS["default"], CPU), (dataclasses.replace(PRESETS["default"], priors=networks), CUDA)):
        with background_warmup(config, device) as ready:
            assert ready() is None


def test_what_goes_wrong_is_raised(monkeypatch):
    """By what waits for the end, in the thread that waits."""

    def fail(*_):
        raise RuntimeError("out of order")

    monkeypatch.setattr(warmups, "warm_up", fail)
    monkeypatch.setattr(torch.cuda, "device", lambda _: torch.no_grad())  # there may be none here
    with background_warmup(PRESETS["default"], CUDA) as ready, pytest.raises(RuntimeError, match="out of order"):
        ready()


def test_nothing_goes_on_after_the_block(monkeypatch):
    """An error in the block, such as a scene with nothing to start from, ends the warmup after the step it is in."""
    began, ended = threading.Event(), []

    def endless(config, device, stopped):
        began.set()
        while not stopped():
            pass
        ended.append(threading.current_thread())

    monkeypatch.setattr(warmups, "warm_up", endless)
    monkeypatch.setattr(torch.cuda, "device", lambda _: torch.no_grad())
    with pytest.raises(DataError), background_warmup(PRESETS["default"], CUDA):
        began.wait()
        raise DataError("nothing to start from")
    assert len(ended) == 1 and not ended[0].is_alive()


def test_a_warmup_that_nobody_waits_for_stops():
    """Between its steps."""
    with pytest.raises(KeyboardInterrupt):
        warm_up(CHOSEN["quick"], CPU, lambda: True)


@pytest.mark.parametrize("changes", [{}, {"memory_limit": 10**9}, {"init": InitConfig(source="random")}])
def test_the_device_is_asked_for_last(changes, monkeypatch):
    """Semantics are found before `ready` is called, and a sweep comes after it, on the device or, under a limit, on the CPU."""
    order = []
    views = photos(3)
    monkeypatch.setattr(setup, "view_priors", lambda *a, depths, **k: (order.append("semantics"), depths(), ([], []))[-1])
    monkeypatch.setattr(start, "sweep_depths", lambda v, b, c, device, progress: (order.append(str(device)), consistent(v))[1])
    config = dataclasses.replace(PRESETS["default"], strategy="paper", strategy_config=None, **changes)
    made = prepare(views, None, config, np.random.default_rng(0), CUDA, None, lambda: order.append("ready"))
    swept = ["ready", "cpu" if "memory_limit" in changes else "cuda"] if "init" not in changes else []
    assert order == ["semantics", *swept, "ready"] and len(made.start.cloud) > 100


@pytest.mark.parametrize(
    ("setting", "needed"),
    [
        ({}, False), ({"s_render": True}, False), ({"s_semantic": True}, True), ({"s_geometry": True}, True),
        ({"gate_quantile": 0.6}, True), ({"gate_quantile": 0.6, "ra": False}, False),
    ],
)  # fmt: skip
def test_priors_are_made_where_an_event_reads_them(setting, needed, monkeypatch):
    """Not for uniform sampling; a network that is named all the same gets a note."""
    asked = []
    monkeypatch.setattr(setup, "view_priors", lambda *a, **k: (asked.append(1), ([], []))[-1])
    base = PRESETS["default"]
    own = {"strategy": "paper", "strategy_config": dataclasses.replace(UNIFORM, **setting)} if setting else {}
    priors = PriorConfig(segmentation_model="labels.onnx")
    config = dataclasses.replace(base, **own, init=InitConfig(source="random"), priors=priors)
    made = prepare(photos(2), None, config, np.random.default_rng(0), CPU, None, lambda: None)
    assert bool(asked) == needed
    assert any("--segmentation-model is not used" in note for note in made.notes) != needed


def consistent(views):
    """A depth of three units everywhere."""
    size = views[0].image.shape[:2]
    return [ViewDepth(np.full(size, 3.0, np.float32), np.ones(size, bool), np.ones(size, np.float32)) for _ in views]


def test_missing_points_are_said_before_anything_takes_time(monkeypatch):
    """Before networks run and before the device is waited for."""
    monkeypatch.setattr(setup, "view_priors", lambda *a, **k: pytest.fail("begun"))
    config = dataclasses.replace(PRESETS["default"], init=InitConfig(source="points"))
    with pytest.raises(DataError, match="needs 3D points"):
        prepare(photos(2), None, config, np.random.default_rng(0), CPU, None, lambda: pytest.fail("asked"))


@pytest.mark.parametrize("preset", ["default", "3dgs"])
def test_only_fits_that_sweep_warm_up_a_sweep(preset, monkeypatch):
    """And none under a memory limit, which leaves the sweep to the CPU."""
    swept = []
    monkeypatch.setattr(warmups, "sweep_depths", lambda views, *_: swept.append(len(views)))
    warm_up(CHOSEN[preset], CPU)
    warm_up(dataclasses.replace(CHOSEN[preset], memory_limit=10**9), CPU)
    assert swept == ([2] if preset == "default" else [])


@pytest.mark.cuda
def test_a_fit_is_the_same_after_a_background_warmup():
    """Bit for bit that of a fit without one."""
    device, views = torch.device("cuda"), photos(3)
    config = dataclasses.replace(CHOSEN["quick"], steps=20)
    fits = []
    for warmed_up in (False, True):
        with background_warmup(config, device if warmed_up else CPU) as ready:
            fit = Trainer(views, seeds(), config, device, priors=priors(views), ready=ready)
        run(fit, lambda _: None, lambda _: None, lambda: False)
        fits.append(fit.gaussians.tensors())
    assert all(torch.equal(fits[0][n], fits[1][n]) for n in fits[0])
