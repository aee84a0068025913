"""Warming the kernel cache: all that a fit launches, compiled once."""

import dataclasses

import numpy as np
import pytest
import torch
import warp as wp

from tests.example_terms import DepthCorrelation
from tests.scenes import photos, priors, seeds
from warpgs.app.cli import main
from warpgs.kernels import launch as interop
from warpgs.pipeline.metrics.scores import render_view, score
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.paper.strategy import PaperConfig
from warpgs.pipeline.run import precompile
from warpgs.pipeline.run.precompile import fit_kernels
from warpgs.pipeline.train.schedule import OptimizerConfig, PhaseConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies import sampling
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.render.options import RasterizeOptions


@wp.kernel(enable_backward=False, module="unique")
def nothing(begin: int): ...


@pytest.mark.parametrize("recorded", [True, False])
@pytest.mark.parametrize("strategy", ["paper", "mcmc"])
def test_a_fit_launches_nothing_else(device, strategy, recorded, monkeypatch):
    """Start, steps with and without masks, density events and scores: every module and size of blocks is among the warmed."""
    launched, launch = set(), interop.launch

    def note(kernel, count, inputs, where, *, block_dim=256, **more):
        launched.add((where.type, kernel.module, 1 if where.type == "cpu" else block_dim))
        launch(kernel, count, inputs, where, block_dim=block_dim, **more)

    monkeypatch.setattr(interop, "launch", note)
    views = photos(3)
    views[0] = dataclasses.replace(views[0], mask=np.ones(views[0].image.shape[:2], bool))
    monkeypatch.setattr(sampling, "MIN_ALPHA", 0.05)
    method = sampling.MethodConfig(hier=True, sampler=sampling.SamplerConfig(fraction=0.01, max_fraction=0.05))
    own = {} if strategy == "mcmc" else {"strategy_config": PaperConfig(pm=False)}
    config = FitConfig(
        steps=20, dropout=0.2, cuda_graph=recorded, init=InitConfig(source="points" if strategy == "mcmc" else "sweep"),
        optimizer=OptimizerConfig(opacities_decay=0.001),
        strategy=strategy, method=method, **own,
        loss_terms=(DepthCorrelation(0.1, 0.5),),
        density=DensityConfig(start=2, every=2), phases=PhaseConfig(200, 300),
    )  # fmt: skip
    fit = Trainer(views, seeds(), config, device, priors=priors(views))
    while fit.step < 20:
        fit.advance(100)
    assert strategy == "mcmc" or any(event["evicted"] for event in fit.strategy.events)
    score(views[1], render_view(fit.gaussians, views[1], RasterizeOptions())[0])
    warmed = {(kind, k.module, block) for kind in ("cpu", "cuda") for k, block in fit_kernels(kind == "cuda")}
    assert len(launched) > 8 and launched <= warmed


@pytest.mark.slow
def test_the_second_call_finds_all_in_the_cache(tmp_path, monkeypatch, capsys):
    """One small module in an empty cache: compiled by the first call, found by the second, which knows nothing of the first."""
    monkeypatch.setattr(wp.config, "kernel_cache_dir", str(tmp_path))
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.setattr(precompile, "fit_kernels", lambda cuda: [(nothing, 1)])
    said = []
    for _ in range(2):
        assert main(["doctor", "--warm"]) == 0
        said.append(capsys.readouterr().out)
        nothing.module.unload()
    assert "cpu: test_precompile.nothing, " in said[0] and "1 modules: 1 compiled, 0 were in the cache" in said[0]
    assert "test_precompile.nothing" not in said[1] and "1 modules: 0 compiled, 1 were in the cache" in said[1]


def test_kernels_of_both_kinds_of_device_are_named():
    """Also where there is no CUDA device: their sources are found and their factories called."""
    assert all(block == 1 for _, block in fit_kernels(False))
    blocks = {block for _, block in fit_kernels(True)}
    assert {32, 64, 128, 256} <= blocks and torch.float32 in interop.REALS
