"""The shortest proof that everything fits together: a tiny scene is fitted almost exactly."""

import numpy as np
import torch

from tests.scenes import photos, seeds
from warpgs.pipeline.metrics.scores import render_view, score
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.train.schedule import OptimizerConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.render.options import RasterizeOptions


def test_a_tiny_scene_passes_35_db_in_200_steps():
    """Held-out views of three Gaussians, from sixty gray points."""
    views = photos(7)
    config = FitConfig(
        steps=200, init=InitConfig(source="points"), sh_degree=0,
        optimizer=OptimizerConfig(means_lr=2e-3, scales_lr=0.03, sh_lr=0.02),
    )  # fmt: skip
    fit = Trainer([v for i, v in enumerate(views) if i != 3], seeds(), config, torch.device("cpu"))
    losses = [fit.advance()[0].loss for _ in range(200)]
    assert np.mean(losses[-10:]) < 0.1 * np.mean(losses[:10])
    assert score(views[3], render_view(fit.gaussians, views[3], RasterizeOptions())[0]).psnr > 35
