"""The training loop around gsplat, with a stand-in for gsplat that renders with our rasterizer and notes its calls."""

import sys
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from bench.lib import gsplat_trainer
from tests.scenes import photos
from warpgs import RasterizeOptions, rasterize
from warpgs.scene import Camera, Gaussians, Normalization


@pytest.fixture
def gsplat(monkeypatch):
    """A module in place of gsplat; it notes strategies, degrees, and the learning rate of the means at each step."""
    told = SimpleNamespace(strategies=[], degrees=[], lrs=[])

    class MCMCStrategy:
        def __init__(self, **settings):
            told.strategies.append(settings)
            told.lrs.clear()

        def check_sanity(self, params, optimizers):
            assert set(params) == set(optimizers) == {"means", "scales", "quats", "opacities", "sh0", "shN"}

        def initialize_state(self):
            return {}

        def step_pre_backward(self, params, optimizers, state, step, info):
            assert info == {"seen": step}

        def step_post_backward(self, params, optimizers, state, step, info, lr):
            assert all(p.grad is None for p in params.values()) and step == len(told.lrs)
            told.lrs.append(lr)

    def rasterization(means, quats, scales, opacities, colors, viewmats, Ks, width, height, sh_degree, packed):
        told.degrees.append(sh_degree)
        g = Gaussians(means, quats, scales.log(), opacities.logit(), colors)
        rgb = rasterize(g, Camera(viewmats, Ks, width, height), RasterizeOptions(rule="gsplat-1.5", sh_degree=sh_degree)).rgb
        return rgb, None, {"seen": len(told.lrs)}

    module = SimpleNamespace(MCMCStrategy=MCMCStrategy, rasterization=rasterization)
    monkeypatch.setitem(sys.modules, "gsplat", module)
    return told


def first(count: int) -> Gaussians:
    """Gaussians in front of the cameras of `photos`, of which only means and colours matter."""
    generator = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=generator) - 0.5
    return Gaussians(means, torch.zeros(count, 4), torch.zeros(count, 3), torch.zeros(count), torch.zeros(count, 1, 3))


def test_gsplat_is_trained_as_its_example_trainer_does(gsplat):
    """Settings of the strategy, degree by step, rate of the means from its start to a hundredth; the loss falls."""
    views = photos(3)
    s = gsplat_trainer.Settings(steps=12, cap=123, sh_every=4)
    params = gsplat_trainer.train(views, first(200), s, seed=1, scale=2.0, size=3.0)
    assert gsplat.strategies == [
        {"cap_max": 123, "noise_lr": 5e5, "refine_start_iter": 500, "refine_stop_iter": 10, "refine_every": 100}
    ]
    assert gsplat.degrees == [0] * 4 + [1] * 4 + [2] * 4
    wanted = [3.0 * 1.6e-4 * 0.01 ** ((k + 1) / 12) for k in range(12)]
    assert gsplat.lrs == pytest.approx(wanted)
    again = gsplat_trainer.start(2 * first(200).means, torch.full((200, 3), 0.5), s)
    before, after = (
        np.mean([np.square(gsplat_trainer.image_of(p, v, 2.0) - v.image).mean() for v in views]) for p in (again, params)
    )
    assert after < before


def test_the_unit_changes_nothing_that_is_seen(gsplat):
    """Twice the unit with twice the world gives the same image."""
    view, s = photos(1)[0], gsplat_trainer.Settings(steps=1, cap=1)
    torch.manual_seed(0)
    params = gsplat_trainer.start(first(100).means, torch.rand(100, 3), s)
    image = gsplat_trainer.image_of(params, view, 1.0)
    params["means"].data *= 2
    params["scales"].data += np.log(2)
    assert image.max() > 0.05 and np.abs(gsplat_trainer.image_of(params, view, 2.0) - image).max() < 1e-3


def test_its_own_unit_is_that_of_its_parser():
    """Cameras on a circle of radius 4 in the files that look at the origin: there 4 is 1, whatever our unit."""
    cameras, n = [], Normalization(np.array([1.0, 2.0, 3.0]), 0.5)
    for angle in np.linspace(0, 2 * np.pi, 8, endpoint=False):
        axis = -np.array([np.cos(angle), np.sin(angle), 0])
        right = np.array([-axis[1], axis[0], 0])
        rotation = np.stack([right, np.cross(axis, right), axis])
        center = 0.5 * (-4 * axis - n.offset)
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = rotation, -rotation @ center
        cameras.append(Camera(viewmat, np.eye(3), 4, 4))
    assert gsplat_trainer.own_scale(cameras, n) == pytest.approx(1 / (4 * 0.5))
    assert gsplat_trainer.scene_scale(cameras, 0.5) == pytest.approx(1.1 * 0.5 * 2)
