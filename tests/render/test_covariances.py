"""Covariances instead of rotations and scales: equal images, gradients, limits."""

import dataclasses
import functools
import math

import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, hand_placed
from tests.reference.project import rotations
from tests.tolerances import close
from warpgs.geometry import gaussian_normals, rotation_matrices
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import ActivatedGaussians, CovarianceGaussians

ANTIALIASED = RasterizeOptions(antialiased=True)


def pair(stored):
    """The same Gaussians by scales and by covariances, as leaves."""
    g = {n: t.detach() for n, t in stored.tensors().items()}
    scales, opacities = g["log_scales"].exp(), g["logit_opacities"].sigmoid()
    axes = rotation_matrices(g["quats"] / g["quats"].norm(dim=-1, keepdim=True)) * scales[:, None]
    activated = ActivatedGaussians(*(t.clone().requires_grad_() for t in (g["means"], g["quats"], scales, opacities, g["sh"])))
    given = (g["means"], axes @ axes.mT, opacities, g["sh"])
    return activated, CovarianceGaussians(*(t.clone().requires_grad_() for t in given))


def covariances(activated):
    """Covariances [N, 3, 3] of Gaussians by scales, differentiable by torch."""
    quats = activated.quats / activated.quats.norm(dim=-1, keepdim=True)
    axes = rotation_matrices(quats) * activated.scales[:, None]
    return axes @ axes.mT


@pytest.mark.parametrize("antialiased", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_images_and_gradients_are_those_of_scales(device, dtype, antialiased):
    """By the chain rule of torch from covariances on; pose and intrinsics have the same gradients."""
    activated, given = pair(hand_placed(dtype, device))
    options, found = RasterizeOptions(rule=SMOOTH, antialiased=antialiased), []
    for g in (activated, given):
        cam = camera(cameras=2, dtype=dtype, device=device)
        views, Ks = cam.viewmat.clone().requires_grad_(), cam.K.clone().requires_grad_()
        r = rasterize(g, dataclasses.replace(cam, viewmat=views, K=Ks), options)
        (r.rgb.square().sum() + r.depth.sum()).backward()
        found.append((r, views.grad, Ks.grad))
    (r, v_views, v_Ks), (s, w_views, w_Ks) = found
    for a, b in ((s.rgb, r.rgb), (s.alpha, r.alpha), (s.depth, r.depth)):
        close("image", a, b)
    for a, b in (
        (w_views, v_views),
        (w_Ks, v_Ks),
        (given.means.grad, activated.means.grad),
        (given.sh.grad, activated.sh.grad),
    ):
        close("gradient", a, b)
    close("gradient", given.opacities.grad, activated.opacities.grad)
    quats, scales = (t.detach().clone().requires_grad_() for t in (activated.quats, activated.scales))
    covariances(dataclasses.replace(activated, quats=quats, scales=scales)).backward(given.covars.grad)
    close("gradient", quats.grad, activated.quats.grad)
    close("gradient", scales.grad, activated.scales.grad)


DIRECTIONS = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, -1], [0, 1, 1]], dtype=torch.float64)
"""Vectors whose outer products span the symmetric matrices."""


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_gradients_at_a_low_rank(device, rank):
    """One-sided differences towards positive semi-definite matrices; at rank 0 the gradient does not vanish."""
    stored = hand_placed(device=device, degree=1)
    stored.log_scales.data[:, rank:] = -math.inf
    given, cam, h = pair(stored)[1], camera(12, 11, device=device), 1e-5

    def total(covars):
        r = rasterize(dataclasses.replace(given, covars=covars), cam, RasterizeOptions(rule=SMOOTH))
        return r.rgb.square().sum() + r.alpha.square().sum()

    (v,) = torch.autograd.grad(total(given.covars), given.covars)
    covars = given.covars.detach()
    for direction in DIRECTIONS.to(covars):
        step = h * torch.outer(direction, direction)
        slope = (4 * total(covars + step) - total(covars + 2 * step) - 3 * total(covars)) / (2 * h)
        assert float(slope.detach()) == pytest.approx(float((v * step).sum()) / h, rel=1e-6)  # measured: 3e-9
        assert abs(float(slope.detach())) > 1e-3


def test_zeros_render_as_scale_0(device, dtype):
    """A point, as wide as the pixel filter, to the bit; antialiased it is nothing."""
    stored, cam = cloud(9, dtype, device), camera(40, 30, dtype=dtype, device=device)
    stored.log_scales[:] = -math.inf
    activated, given = pair(stored)
    assert not bool(given.covars.any())
    r, s = rasterize(activated, cam), rasterize(given, cam)
    assert torch.equal(r.rgb, s.rgb) and torch.equal(r.visible, s.visible) and int(s.visible.sum()) >= 8
    s.rgb.sum().backward()
    assert bool(torch.isfinite(given.covars.grad).all()) and bool(given.covars.grad.any())
    assert not bool(rasterize(given, cam, ANTIALIASED).visible.any())


def test_the_symmetric_part_counts(device, dtype):
    """An antisymmetric part changes no bit, and the gradient is symmetric."""
    given, cam = pair(cloud(30, dtype, device))[1], camera(dtype=dtype, device=device)
    with torch.no_grad():  # powers of two, so that sums are exact
        given.covars.copy_(torch.round(given.covars * 2.0**20) / 2.0**20)
    turned = torch.triu(torch.full((3, 3), 2.0**-4, dtype=dtype, device=device), 1)
    skewed = dataclasses.replace(given, covars=given.covars + turned - turned.T)
    assert torch.equal(rasterize(given, cam).rgb, rasterize(skewed, cam).rgb)
    rasterize(given, cam).rgb.square().sum().backward()
    assert torch.equal(given.covars.grad, given.covars.grad.mT) and bool(given.covars.grad.any())


def with_lowest(given, lowest):
    """The second Gaussian with variances 1, 0.25 and ``lowest``, turned."""
    turn = rotations(torch.tensor([[0.3, 0.8, -0.4, 0.2]], dtype=torch.float64))[0]
    variances = torch.tensor([1.0, 0.25, lowest], dtype=torch.float64)
    with torch.no_grad():
        given.covars[1] = (turn @ torch.diag(variances) @ turn.T).to(given.covars)
    return given


def test_a_negative_eigenvalue_counts_as_0_or_culls(device, dtype):
    """Within rounding the image is that of 0; beyond, the Gaussian is not there, and its neighbours keep their bits."""
    cam, others = camera(dtype=dtype, device=device), [0, 2, 3]
    made = functools.partial(with_lowest, pair(cloud(4, dtype, device))[1])
    flat = rasterize(made(0.0), cam).projected.detach()
    near = rasterize(made(-2e-6), cam)
    assert bool(near.visible[0, 1]) and float((near.projected - flat).detach().abs().max()) < 2e-4
    for lowest in (-1e-4, -0.3, -2.0):
        given = made(lowest)
        r = rasterize(given, cam)
        assert not bool(r.visible[0, 1]) and torch.equal(r.projected[:, others].detach(), flat[:, others])
        r.rgb.sum().backward()
        assert not any(bool(t.grad[1].any()) for t in given.tensors().values())


@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_is_culled(device, poison):
    """In any entry; so is a diagonal of zeros beside other entries, and a negative definite matrix."""
    cam = camera(dtype=torch.float32, device=device)
    broken = [
        torch.eye(3).index_put((torch.tensor(i), torch.tensor(j)), torch.tensor(poison)) for i in range(3) for j in range(3)
    ]
    broken += [1 - torch.eye(3), -torch.eye(3)]
    for covar in broken:
        given = pair(cloud(4, device=device))[1]
        with torch.no_grad():
            given.covars[2] = covar.to(device)
        r = rasterize(given, cam)
        r.rgb.sum().backward()
        assert not bool(r.visible[0, 2]) and int(r.visible.sum()) == 3
        assert not any(bool(t.grad[2].any()) for t in given.tensors().values())


def test_rounding_culls_no_needle_and_no_disc(device):
    """Rank 1 and 2 and everything between, turned in float32 as Sigma -> R Sigma R^T: all are visible, gradients are finite."""
    count, generator = 4000, torch.Generator().manual_seed(0)
    exponents = -4 * torch.rand(count, 3, generator=generator) * torch.tensor([0.0, 1, 3])
    exponents[::4, 2] = exponents[::8, 1] = -math.inf
    turns = rotations(torch.randn(2 * count, 4, generator=generator)).view(2, count, 3, 3)
    covars = turns[0] @ torch.diag_embed(10 ** (2 * exponents)) @ turns[0].mT
    covars = (turns[1] @ covars @ turns[1].mT).to(device).requires_grad_()
    ones = torch.ones(count, device=device)
    given = CovarianceGaussians(torch.tensor([0.0, 0, 4]).to(device).expand(count, 3), covars, ones, None)
    values = torch.rand(count, 3, generator=generator).to(device)
    r = rasterize(given, camera(16, 16, dtype=torch.float32, device=device), RasterizeOptions(colors=values))
    assert bool(r.visible.all())
    r.projected[..., :10].sum().backward()
    assert bool(torch.isfinite(covars.grad).all())


@pytest.mark.parametrize("exponent", [-45, -30, -10, 10, 20, 30, 38])
def test_extremes_stay_finite(device, exponent):
    """Points, needles and discs of any variance that float32 holds: results and gradients are finite."""
    cam = camera(dtype=torch.float32, device=device)
    for axes in ([1, 1, 1], [1, 0, 0], [1, 1, 0], [1, 1e-4, 1e-7]):
        given = pair(cloud(3, device=device))[1]
        with torch.no_grad():
            given.covars[1] = torch.diag(torch.tensor(axes) * 10.0**exponent).to(given.covars)
        r = rasterize(given, cam)
        assert bool(torch.isfinite(r.projected).all()) and (exponent > 30 or bool(r.visible[0, 1]))
        r.projected[..., :10].sum().backward()
        assert all(bool(torch.isfinite(t.grad).all()) for t in given.tensors().values())


def test_wrong_input_is_named():
    """Errors name the field."""
    given, cam = pair(cloud(5))[1], camera(dtype=torch.float32)
    for wrong, error in (
        (given.covars[:3], ValueError),
        (given.covars[..., 0], ValueError),
        (given.covars.double(), TypeError),
    ):
        with pytest.raises(error, match="covars"):
            rasterize(dataclasses.replace(given, covars=wrong), cam)
    with pytest.raises(TypeError, match=r"gaussian_normals needs quats and scales"):
        gaussian_normals(given, cam)
