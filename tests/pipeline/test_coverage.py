"""What views know of each Gaussian, against geometry by hand and the Jacobian by autograd."""

import dataclasses
import math

import torch

from tests.scenes import ring, three_gaussians
from warpgs.pipeline.model.edit import SEEN, coverage, fisher
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians


def cameras(count: int = 4) -> list[Camera]:
    return [Camera(torch.from_numpy(c.viewmat).float(), torch.from_numpy(c.K).float(), c.width, c.height) for c in ring(count)]


def test_coverage_of_gaussians_that_all_views_see():
    """Weights and number of views; one behind all cameras is seen by none."""
    g = three_gaussians()
    far = {n: torch.cat([t, t[:1]]) for n, t in g.tensors().items()}
    far["means"][3] = torch.tensor([0.0, 0.0, -50.0])
    seen = coverage(Gaussians(**far), cameras(), RasterizeOptions())
    assert seen.views.tolist() == [4, 4, 4, 0] and float(seen.maxima[3]) == 0
    weights = [rasterize(g, c, RasterizeOptions(contributions=True)).weight_maxima[0] for c in cameras()]
    assert torch.equal(seen.maxima[:3], torch.stack(weights).amax(0))


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
