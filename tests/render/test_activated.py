"""Activated parameters: scales and opacities themselves, and the limits that stored ones reach at infinity."""

import dataclasses
import math

import pytest
import torch

from tests.gaussians import camera, cloud, hand_placed, leaves
from warpgs.errors import UsageError
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import ActivatedGaussians, CovarianceGaussians


def activated(gaussians):
    """The same Gaussians by scales and opacities, as leaves."""
    g = gaussians.tensors()
    tensors = g["means"], g["quats"], g["log_scales"].exp(), g["logit_opacities"].sigmoid(), g["sh"]
    return ActivatedGaussians(*(t.detach().clone().requires_grad_() for t in tensors))


@pytest.mark.parametrize("factors", [False, True])
def test_images_and_gradients_are_those_of_stored_parameters(device, factors):
    """By the chain rule of exp and sigmoid, in float64; opacity factors scale both alike."""
    stored, cam = leaves(hand_placed(device=device)), camera(cameras=2, device=device)
    given = activated(stored)
    options = RasterizeOptions(opacity_factors=torch.linspace(0.5, 1.0, 6).to(stored.means) if factors else None)
    for g in (stored, given):
        r = rasterize(g, cam, options)
        (r.rgb.square().sum() + r.depth.sum()).backward()
    v, w = ({n: t.grad for n, t in g.tensors().items()} for g in (stored, given))
    scales, opacities = given.scales.detach(), given.opacities.detach()
    expected = v["means"], v["quats"], v["log_scales"] / scales, v["logit_opacities"] / (opacities * (1 - opacities)), v["sh"]
    for a, b in zip(expected, w.values()):
        assert float((a - b).norm()) <= 1e-12 * float(a.norm())  # measured: 3e-16


def flat(device, dtype):
    """An opaque flat Gaussian, a line and a point, one beside the other: activated, and stored with infinities."""
    zeros, full = torch.zeros(3, 1, 3), torch.ones(3)
    means = torch.tensor([[-2.8, 0.0, 10.0], [0.0, 0.0, 10.0], [2.8, 0.0, 10.0]])
    scales = torch.tensor([[1.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]])  # exp(log 1) is 1 to the bit
    given = [t.to(device, dtype) for t in (means, torch.tensor([[0.9, 0.1, 0.2, 0.3]] * 3), scales, full, zeros)]
    given = ActivatedGaussians(*(t.requires_grad_() for t in given))
    return given, leaves(given.stored())


def test_opacity_1_and_scale_0_render(device, dtype):
    """All are visible; the pixel filter alone gives a point its width. Activated and stored bits are the same."""
    given, stored = flat(device, dtype)
    assert bool((stored.logit_opacities == math.inf).all()) and bool((stored.log_scales == -math.inf).any())
    cam = camera(40, 30, dtype=dtype, device=device)
    found = []
    for g in (given, stored):
        r = rasterize(g, cam)
        assert bool(r.visible.all()) and bool((r.projected[..., 5] == 1).all())
        (r.rgb.square().sum() + r.alpha.square().sum() + r.depth.sum()).backward()
        v = {n: t.grad for n, t in g.tensors().items()}
        assert all(bool(torch.isfinite(t).all()) for t in v.values())
        found.append((r, v))
    assert torch.equal(found[0][0].rgb, found[1][0].rgb) and torch.equal(found[0][1]["means"], found[1][1]["means"])
    # a variance of 0.3 px^2 alone: u11 = u22 = 1 / sqrt(0.3)
    assert torch.allclose(r.projected[0, 2, 2:5], torch.tensor([1, 0, 1]).to(given.means) / 0.3**0.5, rtol=1e-6, atol=1e-6)
    stored_v = found[1][1]
    assert not bool(stored_v["log_scales"][stored.log_scales.detach() == -math.inf].any())
    assert not bool(stored_v["logit_opacities"].any()) and bool(found[0][1]["opacities"].any())


def test_a_growing_flat_axis_has_the_gradient_zero():
    """The covariance depends on the square of a scale: at 0 the gradient is 0, and stepping either way gives one image."""
    given, _ = flat("cpu", torch.float64)
    cam = camera(40, 30)
    rasterize(given, cam).rgb.square().sum().backward()
    assert not bool(given.scales.grad[given.scales.detach() == 0].any()) and bool(given.scales.grad[0, :2].all())


def test_colors_need_no_harmonics():
    """``sh`` may be left out where colours are given, and nowhere else."""
    stored, cam = cloud(50), camera(dtype=torch.float32)
    given, values = activated(stored), torch.rand(50, 5)
    options = RasterizeOptions(colors=values)
    covariances = CovarianceGaussians(given.means, torch.eye(3).repeat(50, 1, 1), given.opacities, given.sh)
    for whole in (given, covariances):
        bare = dataclasses.replace(whole, sh=None)
        assert torch.equal(rasterize(bare, cam, options).rgb, rasterize(whole, cam, options).rgb)
        with pytest.raises(UsageError, match=r"no sh: give sh=..., or RasterizeOptions\(colors=...\)"):
            rasterize(bare, cam)


def test_wrong_input_is_named():
    """Errors name the fields that were given."""
    given, cam = activated(cloud(5)), camera(dtype=torch.float32)
    with pytest.raises(ValueError, match="scales"):
        rasterize(ActivatedGaussians(given.means, given.quats, given.scales[:3], given.opacities, given.sh), cam)
    with pytest.raises(ValueError, match="opacities"):
        rasterize(ActivatedGaussians(given.means, given.quats, given.scales, given.opacities[:, None], given.sh), cam)


def test_what_is_no_number_is_culled(dtype):
    """NaN and infinity in scales and opacities, and an opacity at or below 0: not there, no gradient."""
    cam = camera(dtype=dtype)
    poisons = {"scales": (math.nan, math.inf), "opacities": (math.nan, math.inf, 0.0, -1.0)}
    for name, poison in [(name, value) for name, values in poisons.items() for value in values]:
        g = activated(cloud(4, dtype))
        with torch.no_grad():
            g.tensors()[name][2] = poison
        r = rasterize(g, cam)
        r.rgb.sum().backward()
        assert not bool(r.visible[0, 2]) and int(r.visible.sum()) == 3
        assert not any(bool(t.grad[2].any()) for t in g.tensors().values())
