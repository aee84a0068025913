"""What views know of each Gaussian, against geometry by hand and the Jacobian by autograd."""

import dataclasses
import math

import numpy as np
import pytest
import torch

from tests.scenes import ring, three_gaussians
from warpgs.pipeline.model.coverage import CONE, SEEN, Coverage, coverage, fisher
from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.scene import Camera, Gaussians


def cameras(count: int = 4) -> list[Camera]:
    return [Camera(torch.from_numpy(c.viewmat).float(), torch.from_numpy(c.K).float(), c.width, c.height) for c in ring(count)]


def test_coverage_of_gaussians_that_all_views_see():
    """Weights, number of views, cone and footprint by hand; one behind all cameras is seen by none and has no footprint."""
    g = three_gaussians()
    far = {n: torch.cat([t, t[:1]]) for n, t in g.tensors().items()}
    far["means"][3] = torch.tensor([0.0, 0.0, -50.0])
    seen = coverage(Gaussians(**far), cameras(), RasterizeOptions())
    assert seen.views.tolist() == [4, 4, 4, 0] and float(seen.maxima[3]) == 0 == float(seen.footprint[3])
    weights = [rasterize(g, c, RasterizeOptions(contributions=True)).weight_maxima[0] for c in cameras()]
    assert torch.equal(seen.maxima[:3], torch.stack(weights).amax(0))
    for i, mean in enumerate(g.means.double().numpy()):
        directions = np.array([c.center - mean for c in ring(4)])
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        middle = directions.sum(0) / np.linalg.norm(directions.sum(0))
        assert float(seen.cone[i]) == pytest.approx(2 * np.arccos((directions @ middle).min()), rel=1e-4)
        depths = [(c.viewmat @ [*mean, 1])[2] for c in ring(4)]
        assert float(seen.footprint[i]) == pytest.approx(min(depths) / (1.3 * 40), rel=1e-5)


def test_degree_that_views_support():
    """One view or one place: degree 0. Each band asks for a view and a part of the cone more."""
    one = Coverage(
        *(torch.ones(6),), torch.tensor([0, 1, 2, 4, 4, 9]), torch.tensor([0, 0, 1.5, 0.5, 2.5, 9]) * CONE, torch.ones(6)
    )
    assert one.supported_degree().tolist() == [0, 0, 1, 0, 2, 3]
    alone = coverage(three_gaussians(), cameras(4)[:1], RasterizeOptions())
    assert alone.supported_degree().tolist() == [0, 0, 0] and not bool(alone.cone.any())
    twice = coverage(three_gaussians(), cameras(4)[:1] * 2, RasterizeOptions())
    assert twice.supported_degree().tolist() == [0, 0, 0] and twice.views.tolist() == [2, 2, 2]


def test_hidden_gaussian_is_not_seen():
    """Behind an opaque one, the largest weight falls below what counts as seen."""
    g = three_gaussians()
    rows = {n: t[[0, 0]].clone() for n, t in g.tensors().items()}
    rows["logit_opacities"][:] = 9.0
    rows["log_scales"][0], rows["log_scales"][1] = math.log(0.4), math.log(0.02)
    away = rows["means"][0] - torch.from_numpy(cameras(1)[0].center)
    rows["means"][1] = rows["means"][0] + 0.3 * away.float()
    seen = coverage(Gaussians(**rows), cameras(1), RasterizeOptions())
    assert seen.views.tolist() == [1, 0] and 0 < float(seen.maxima[1]) < SEEN


def test_fisher_is_the_trace_of_the_jacobian():
    """Mean over seeds of the estimate against the sum over pixels of squared derivatives, one pixel at a time."""
    small = [dataclasses.replace(c, K=c.K * torch.tensor([[0.2], [0.2], [1.0]]), width=8, height=6) for c in cameras(2)]
    g = three_gaussians()
    exact = torch.zeros(3)
    for c in small:
        leaves = {n: t.clone().requires_grad_() for n, t in g.tensors().items()}
        for value in rasterize(Gaussians(**leaves), c).rgb.flatten():
            v_means, v_scales = torch.autograd.grad(value, [leaves["means"], leaves["log_scales"]], retain_graph=True)
            width = g.log_scales.exp().amax(1, keepdim=True)
            exact += (v_means * width).square().sum(1) + v_scales.square().sum(1)
    estimates = torch.stack([fisher(g, small, RasterizeOptions(), seed) for seed in range(49)])
    error = estimates.std(0) / 7
    assert bool((exact > 1e-2).all()) and bool(((estimates.mean(0) - exact).abs() < 4 * error).all())
    assert bool((error < 0.25 * exact).all())
    with torch.no_grad():
        assert torch.equal(fisher(g, small, RasterizeOptions(), 0), estimates[0])
