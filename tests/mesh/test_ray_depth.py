"""Depth along each ray is that of the densest points, and it is known where most of the weights agree."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.gaussians import camera, cloud
from warpgs import RasterizeOptions, rasterize
from warpgs.mesh import views
from warpgs.mesh.views import densest_depths, surface_depth, surface_view, weighted_median, whitening
from warpgs.pipeline.model.edit import covariances as covariances_of
from warpgs.scene import Camera, Gaussians

K = np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])
FRONT = Camera(np.eye(4), K, 48, 32)


def layer(depth: float, slope: float = 0.0, opacity: float = 3.0, spacing: float = 0.3) -> Gaussians:
    """Return flat wide Gaussians on the plane z = depth + slope x, across the whole image."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(-6, 6, spacing), np.arange(-4, 4, spacing)))
    turn = -np.arctan(slope) / 2  # about the y axis
    quat = torch.tensor([np.cos(turn), 0.0, np.sin(turn), 0.0])
    scales = torch.tensor([0.8 * spacing, 0.8 * spacing, 1e-3]).log()
    means = torch.tensor(np.stack([x, y, depth + slope * x], 1))
    count = len(means)
    return Gaussians(
        means.float(), quat.float().expand(count, 4).contiguous(), scales.float().expand(count, 3).contiguous(),
        torch.full((count,), opacity), torch.zeros(count, 1, 3),
    )  # fmt: skip


def joined(*parts: Gaussians) -> Gaussians:
    return Gaussians(*(torch.cat(t) for t in zip(*(p.tensors().values() for p in parts))))


def test_the_densest_point_of_a_ray():
    """Against the largest density of many points along it, of Gaussians of all shapes, before a turned camera."""
    gaussians, cam = cloud(40, torch.float64, "cpu"), camera(8, 6, cameras=2, dtype=torch.float64)
    one = Camera(cam.viewmat[1].numpy(), cam.K[1].numpy(), 8, 6)
    rays = torch.tensor([[0.1, -0.2, 1.0], [0.0, 0.3, 1.0]], dtype=torch.float64)
    matrices, means = whitening(gaussians, one)
    found = densest_depths(matrices, means, rays, torch.arange(40).expand(2, 40))
    rotation, translation = (torch.as_tensor(a, dtype=torch.float64) for a in (one.viewmat[:3, :3], one.viewmat[:3, 3]))
    covariances = rotation @ covariances_of(gaussians.quats, gaussians.log_scales) @ rotation.T
    centers = gaussians.means @ rotation.T + translation
    assert torch.allclose(means, centers)
    t = torch.linspace(1e-3, 20, 40_001, dtype=torch.float64)
    for p, ray in enumerate(rays):
        for i in range(40):
            away = t[:, None] * ray - centers[i]
            distance = (away @ torch.linalg.inv(covariances[i]) * away).sum(1)
            best = int(distance.argmin())
            if 0 < best < len(t) - 1:
                assert float(found[p, i]) == pytest.approx(float(t[best]), abs=1e-3)


def test_the_median_by_weight():
    """The order of the depths does not matter, and those without weight do not count."""
    depths = torch.tensor([[3.0, 1.0, 2.0, 0.1], [5.0, 4.0, 9.0, 9.0], [7.0, 7.0, 7.0, 7.0]])
    weights = torch.tensor([[0.2, 0.2, 0.3, 0.0], [0.3, 0.2, 0.0, 0.0], [0.0, 0.0, 0.0, 0.0]])
    assert weighted_median(depths, weights).tolist() == [2.0, 5.0, 7.0]


def test_a_slanted_surface_has_no_steps():
    """Wide Gaussians on a slanted plane: depth is the plane's to 0.1 %; that of their means is off 20 times as far."""
    plane = layer(4.0, 0.4)
    view = surface_view(plane, FRONT, RasterizeOptions())
    true = 4 / (1 - 0.4 * (torch.arange(48) + 0.5 - 24) / 40)
    inside = (slice(6, -6), slice(6, -6))
    error = (view.depth / true - 1).abs()[inside]
    means = (rasterize(plane, FRONT, RasterizeOptions(median_depth=True)).median_depth / true - 1).abs()[inside]
    assert float(error.max()) < 1e-3 and float(means.mean()) > 20 * float(error.mean())


def test_a_pixel_without_one_surface_is_uncertain():
    """Three layers, none with half of the weight: depth 0 and trust 0. One opaque layer before them is known again."""
    layers = [layer(depth, opacity=-1.9) for depth in (3.0, 4.0, 5.0, 6.0)]
    view = surface_view(joined(*layers, layer(8.0)), FRONT, RasterizeOptions())
    middle = (slice(8, -8), slice(8, -8))
    assert float((view.depth[middle] == 0).float().mean()) > 0.9 and not bool(view.weights[view.depth == 0].any())
    view = surface_view(joined(layer(2.5), *layers), FRONT, RasterizeOptions())
    assert torch.allclose(view.depth[middle], torch.tensor(2.5), atol=0.01)


def test_needles_and_empty_pixels(monkeypatch):
    """Axes of 1e-9 and 1e9 give finite depths; pixels without a Gaussian have none; blocks of pixels give the same bits."""
    g = layer(4.0)
    needles = dataclasses.replace(g, log_scales=g.log_scales + torch.tensor([-20.0, 20.0, 0.0]))
    r = rasterize(g, FRONT, RasterizeOptions(heaviest=8))
    depth, share = surface_depth(needles, FRONT, r.heaviest_ids, r.heaviest_weights)
    assert bool(torch.isfinite(depth).all()) and bool(((share >= 0) & (share <= 1 + 1e-6)).all())
    nothing = torch.full((32, 48, 4), -1, dtype=torch.int32)
    assert not any(bool(t.any()) for t in surface_depth(g, FRONT, nothing, torch.zeros(32, 48, 4)))
    whole = surface_depth(g, FRONT, r.heaviest_ids, r.heaviest_weights)
    monkeypatch.setattr(views, "BLOCK", 100)
    parts = surface_depth(g, FRONT, r.heaviest_ids, r.heaviest_weights)
    assert all(torch.equal(a, b) for a, b in zip(whole, parts))
