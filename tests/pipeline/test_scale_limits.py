"""Limits of size and shape: held by every step and every change of the set, and told in the figures."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.gaussians import cloud
from tests.scenes import photos, ring, seeds
from warpgs.errors import UsageError
from warpgs.pipeline.model.limits import (
    LimitConfig,
    Limits,
    TrainingCameras,
    long_axes,
    scene_radius,
    shape_figures,
    shape_summary,
)
from warpgs.pipeline.model.start import InitConfig
from warpgs.pipeline.model.table import DensityUpdate
from warpgs.pipeline.train.schedule import OptimizerConfig
from warpgs.pipeline.train.settings import FitConfig
from warpgs.pipeline.train.strategies.clone_split import DensityConfig
from warpgs.pipeline.train.trainer import Trainer
from warpgs.scene import Gaussians, PointCloud

CPU = torch.device("cpu")
YES, NO = torch.tensor([True]), torch.tensor([False])
CAMERAS, VIEWS = TrainingCameras(torch.zeros(1, 3), torch.zeros(1, 9)), photos(4)


def params(log_scales: torch.Tensor) -> dict[str, torch.Tensor]:
    return {"log_scales": log_scales.clone(), "logit_opacities": torch.linspace(-8, 8, len(log_scales))}


def test_axes_are_cut_and_needles_thickened():
    """The middle axis follows the longest, the shortest stays; what is within the limits stays as it is; twice is as once."""
    found = params(torch.log(torch.tensor([[900.0, 1e-6, 1.0], [2.0, 1.0, 1e-9], [1e-3, 3.0, 0.05], [40.0, 40.0, 40.0]])))
    limits = Limits(30.0, 30.0)
    limits.hold(found, CAMERAS, YES)
    expected = torch.tensor([[30.0, 1e-6, 1.0], [2.0, 1.0, 1e-9], [1e-3, 3.0, 0.1], [30.0, 30.0, 30.0]])
    assert torch.allclose(found["log_scales"].exp(), expected, rtol=1e-5)
    once = found["log_scales"].clone()
    limits.hold(found, CAMERAS, YES)
    assert torch.equal(found["log_scales"], once)


def test_any_order_of_the_axes():
    """Longest and middle are those of a sort, ties included."""
    scales = torch.cat([torch.randn(200, 3), torch.tensor([[1.0, 1, 0], [0, 1, 1], [1, 0, 1], [2, 2, 2]])])
    ordered = scales.sort(1, descending=True).values
    longest, middle = long_axes(scales)
    assert torch.equal(longest, ordered[:, 0]) and torch.equal(middle, ordered[:, 1])
    Limits(ratio=2.0).hold({"log_scales": scales}, CAMERAS)
    longest, middle = long_axes(scales)
    assert float((longest - middle).max()) <= math.log(2) + 1e-6 and torch.equal(longest, ordered[:, 0])


def test_a_step_that_is_not_taken_changes_nothing():
    """No axis, where the step is stopped; and NaN is not hidden where it is taken."""
    found = params(torch.tensor([[9.0, 0.0, 0.0], [math.nan, 0.0, 1.0]]))
    before = {n: t.clone() for n, t in found.items()}
    limits = Limits(1.0, 2.0)
    limits.hold(found, CAMERAS, NO)
    assert all(torch.equal(t.nan_to_num(7), before[n].nan_to_num(7)) for n, t in found.items())
    limits.hold(found, CAMERAS, YES)
    assert bool(found["log_scales"][1].isnan().any()) and float(found["log_scales"][0].max()) == 0


def test_no_gaussian_reaches_a_camera():
    """Its longest axis is at most a third of the distance to the nearest of two cameras; a small one stays as it is."""
    found = params(torch.log(torch.tensor([[9.0, 1.0, 1e-3], [0.5, 0.2, 0.1], [math.inf, 1.0, 1.0]])))
    found["means"] = torch.tensor([[0.0, 0, 6], [0, 0, 6], [0, 0, 6]])
    limits, centers = LimitConfig(max_ratio=0).at(1.0, 100.0), torch.tensor([[0.0, 0, 0], [0, 0, 20]])
    limits.hold(found, CAMERAS._replace(centers=centers), YES)
    sizes = found["log_scales"].exp()
    assert torch.allclose(sizes[:2], torch.tensor([[2.0, 1.0, 1e-3], [0.5, 0.2, 0.1]])) and sizes[2, 0].isinf()
    model = Gaussians(**(cloud(2).tensors() | {n: t[:2] for n, t in found.items()}))
    cameras = ring(4)
    over = shape_figures(model, LimitConfig(), 100.0, 1.0, cameras)["largest_over_distance"]
    nearest = min(np.linalg.norm(c.center - [0, 0, 6]) for c in cameras)
    assert over == pytest.approx(2 / nearest, rel=1e-5)


def test_the_radius_holds_cameras_and_nine_tenths_of_the_points():
    """A point far away does not count; a scene smaller than its cameras' ring is as large as the ring."""
    cameras = ring(4)
    center = np.mean([c.center for c in cameras], axis=0)
    ball = center + 5 * np.eye(3)[np.arange(30) % 3]
    ball[:2] += 1e4
    colors = np.zeros((30, 3), np.float32)
    assert scene_radius(cameras, PointCloud(ball, colors)) == pytest.approx(5)
    near = PointCloud(center + 1e-3 * np.eye(3), colors[:3])
    assert scene_radius(cameras, near) > max(np.linalg.norm(c.center - center) for c in cameras)


def test_figures_count_needles_and_what_is_beyond():
    """One needle of three, weighed by opacity; a disk is thin and no needle; beyond only by limits that are on."""
    scales = torch.log(torch.tensor([[62.0, 2.0, 2.0], [3.0, 3.0, 0.01], [9.0, 1.0, 1.0]]))
    logits = torch.logit(torch.tensor([0.1, 0.5, 0.4]))
    model = Gaussians(**(cloud(3).tensors() | {"log_scales": scales, "logit_opacities": logits}))
    f = shape_figures(model, LimitConfig(max_size=1.0, max_ratio=8.0, max_reach=0), 50.0, 2.0, ring(4))
    assert f["needles"] == pytest.approx(1 / 3) and f["needles_by_opacity"] == pytest.approx(0.1, rel=1e-5)
    assert f["thin"] == pytest.approx(2 / 3) and f["beyond"] == 2
    assert f["largest_over_radius"] == pytest.approx(62 / 50) and f["largest_over_extent"] == pytest.approx(31)
    assert shape_figures(model, LimitConfig(max_size=0, max_ratio=0, max_reach=0), 50.0, 2.0, ring(4))["beyond"] == 0
    assert "33.3%" in shape_summary(f) and "2 exceed the limits" in shape_summary(f)


@pytest.mark.parametrize("strategy", ["clone_split", "mcmc"])
def test_a_fit_ends_within_its_limits(strategy):
    """Rates of scales that make needles in a few steps: none is left where limits are on, some are where they are off."""
    config = FitConfig(
        steps=40, init=InitConfig(source="points"), strategy=strategy, optimizer=OptimizerConfig(scales_lr=0.5),
        density=DensityConfig(start=5, every=10), limits=LimitConfig(max_size=0.2, max_ratio=3.0),
    )  # fmt: skip
    free = dataclasses.replace(config, limits=LimitConfig(0.0, 0.0, 0.0))
    beyond = []
    for c in (config, free):
        fit = Trainer(VIEWS, seeds(), c, CPU)
        while fit.step < c.steps:
            fit.advance()
        beyond.append(
            shape_figures(fit.gaussians, config.limits, fit.radius, fit.context.extent, [v.camera for v in VIEWS])["beyond"]
        )
    assert beyond[0] == 0 < beyond[1]


def test_what_a_change_of_the_set_adds_is_within_the_limits():
    """A strategy that adds a needle after the last step leaves none."""
    config = FitConfig(steps=2, init=InitConfig(source="points"))
    fit = Trainer(VIEWS, seeds(), config, CPU)
    fit.strategy.due = lambda step: step == config.steps

    def update(step):
        added = {n: t.detach()[:1].clone() for n, t in fit.table.params.items()}
        added["log_scales"] += torch.tensor([[20.0, 0.0, 0.0]])
        yield DensityUpdate(torch.arange(len(fit.table)), added, torch.tensor([0]))

    fit.strategy.update = update
    fit.advance()
    fit.advance()
    assert len(fit.gaussians) == len(seeds()) + 1
    assert shape_figures(fit.gaussians, config.limits, fit.radius, fit.context.extent, [v.camera for v in VIEWS])["beyond"] == 0


def test_the_ratio_is_held_from_its_time_on_and_at_the_last_step():
    """Not before; a limit of 0 is none; what cannot be a limit is refused."""
    config = LimitConfig()
    assert [config.at(p, 2.0).ratio for p in (0.0, 0.7, 0.71, 1.0)] == [math.inf, math.inf, 30, 30]
    assert config.at(0.0, 3.0).largest == 3.0
    assert LimitConfig(0.0, 0.0, 0.0).at(1.0, 2.0) == Limits()
    for wrong in (
        {"max_size": -1},
        {"max_reach": -1},
        {"max_ratio": 0.5},
        {"max_size": math.nan},
    ):
        with pytest.raises(UsageError, match="limits"):
            LimitConfig(**wrong)
