"""What a call takes: activated parameters, covariances, degree 4, batches of cameras, lists."""

import dataclasses
import functools
import itertools
import math
import sys

import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, hand_placed, leaves, of_kind
from tests.reference.project import rotations
from tests.tolerances import close
from warpgs.errors import UsageError
from warpgs.geometry import gaussian_normals, rotation_matrices
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import ActivatedGaussians, CovarianceGaussians

activated, with_covariances = (functools.partial(of_kind, kind) for kind in ("activated", "covariances"))


def gone(given, number, cam):
    r = rasterize(given, cam)
    r.rgb.sum().backward()
    rest = not any(bool(t.grad[number].any()) for t in given.tensors().values())
    return rest and not bool(r.visible[0, number]) and int(r.visible.sum()) == 3


@pytest.mark.parametrize("factors", [False, True])
def test_images_and_gradients_are_those_of_stored_parameters(device, factors):
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


def test_what_is_no_number_is_culled(device):
    """NaN and infinity anywhere in scales, opacities and covariances; an opacity of 0 or less; a negative definite matrix."""
    cam = camera(dtype=torch.float32, device=device)
    poisons = {"scales": (math.nan, math.inf), "opacities": (math.nan, math.inf, 0.0, -1.0)}
    for name, value in [(name, value) for name, values in poisons.items() for value in values]:
        g = activated(cloud(4, device=device))
        with torch.no_grad():
            g.tensors()[name][2] = value
        assert gone(g, 2, cam), (name, value)
    broken = [1 - torch.eye(3), -torch.eye(3)]
    for i, j, value in itertools.product(range(3), range(3), (math.nan, math.inf, -math.inf)):
        broken.append(torch.eye(3))
        broken[-1][i, j] = value
    for covar in broken:
        g = with_covariances(cloud(4, device=device))
        with torch.no_grad():
            g.covars[2] = covar.to(device)
        assert gone(g, 2, cam), covar


def test_missing_harmonics_and_wrong_input_are_named():
    """``sh`` may be left out where colours are given, and nowhere else; errors name the fields that were given."""
    stored, cam = cloud(50), camera(dtype=torch.float32)
    given, values = activated(stored), torch.rand(50, 5)
    options = RasterizeOptions(colors=values)
    covariances = CovarianceGaussians(given.means, torch.eye(3).repeat(50, 1, 1), given.opacities, given.sh)
    for whole in (given, covariances):
        bare = dataclasses.replace(whole, sh=None)
        assert torch.equal(rasterize(bare, cam, options).rgb, rasterize(whole, cam, options).rgb)
        with pytest.raises(UsageError, match=r"no sh: give sh=..., or RasterizeOptions\(colors=...\)"):
            rasterize(bare, cam)
    given, other, cam = activated(cloud(5)), with_covariances(cloud(5)), camera(dtype=torch.float32)
    for g, name, wrong, error in (
        (given, "scales", given.scales[:3], ValueError), (given, "opacities", given.opacities[:, None], ValueError),
        (other, "covars", other.covars[:3], ValueError), (other, "covars", other.covars[..., 0], ValueError),
        (other, "covars", other.covars.double(), TypeError),
    ):  # fmt: skip
        with pytest.raises(error, match=name):
            rasterize(dataclasses.replace(g, **{name: wrong}), cam)
    with pytest.raises(TypeError, match=r"gaussian_normals needs quats and scales"):
        gaussian_normals(other, cam)


def test_logits_and_logarithms_are_named(device, monkeypatch):
    """In place of opacities and scales. On CUDA only the first call reads them; an optimizer may step past a bound."""
    module, stored = sys.modules[rasterize.__module__], cloud(50, device=device)
    cam = camera(dtype=torch.float32, device=device)
    logits, given = stored.logit_opacities.detach() * 4 - 3, activated(stored)
    messages = r"opacities are from .*, but must be in \[0, 1\]; torch.sigmoid", "scales are from .* at least 0; torch.exp"
    wrong = {"opacities": logits}, {"scales": stored.log_scales}
    for g, values, words in zip((given, given, with_covariances(stored)), (*wrong, wrong[0]), (*messages, messages[0])):
        monkeypatch.setattr(module, "_LOOKED_AT", set())
        with pytest.raises(ValueError, match=words):
            rasterize(dataclasses.replace(g, **values), cam)
    rasterize(dataclasses.replace(given, opacities=given.opacities * 1.9 - 0.9, scales=given.scales - 0.5), cam)


@pytest.mark.parametrize("antialiased", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_images_and_gradients_are_those_of_scales(device, dtype, antialiased):
    """By the chain rule of torch from covariances on; pose and intrinsics have the same gradients."""
    scaled, given = (make(hand_placed(dtype, device)) for make in (activated, with_covariances))
    options, found = RasterizeOptions(rule=SMOOTH, antialiased=antialiased), []
    for g in (scaled, given):
        cam = camera(cameras=2, dtype=dtype, device=device)
        views, Ks = cam.viewmat.clone().requires_grad_(), cam.K.clone().requires_grad_()
        r = rasterize(g, dataclasses.replace(cam, viewmat=views, K=Ks), options)
        (r.rgb.square().sum() + r.depth.sum()).backward()
        found.append(((r.rgb, r.alpha, r.depth), (views.grad, Ks.grad, g.means.grad, g.sh.grad, g.opacities.grad)))
    for name, ours, wanted in zip(("image", "gradient"), found[1], found[0]):
        for a, b in zip(ours, wanted, strict=True):
            close(name, a, b)
    quats, scales = (t.detach().clone().requires_grad_() for t in (scaled.quats, scaled.scales))
    axes = rotation_matrices(quats / quats.norm(dim=-1, keepdim=True)) * scales[:, None]
    (axes @ axes.mT).backward(given.covars.grad)
    close("gradient", quats.grad, scaled.quats.grad)
    close("gradient", scales.grad, scaled.scales.grad)


DIRECTIONS = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, -1], [0, 1, 1]], dtype=torch.float64)
"""Vectors whose outer products span the symmetric matrices."""


@pytest.mark.parametrize("rank", [0, 1, 2])
def test_gradients_at_a_low_rank(device, rank):
    """One-sided differences towards positive semi-definite matrices; at rank 0 the gradient does not vanish."""
    stored = hand_placed(device=device, degree=1)
    stored.log_scales.data[:, rank:] = -math.inf
    given, cam, h = with_covariances(stored), camera(12, 11, device=device), 1e-5

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


def test_the_symmetric_part_counts_and_a_negative_eigenvalue_as_0(device, dtype):
    """An antisymmetric part changes no bit, and the gradient is symmetric."""
    given, cam = with_covariances(cloud(30, dtype, device)), camera(dtype=dtype, device=device)
    with torch.no_grad():  # powers of two, so that sums are exact
        given.covars.copy_(torch.round(given.covars * 2.0**20) / 2.0**20)
    turned = torch.triu(torch.full((3, 3), 2.0**-4, dtype=dtype, device=device), 1)
    skewed = dataclasses.replace(given, covars=given.covars + turned - turned.T)
    assert torch.equal(rasterize(given, cam).rgb, rasterize(skewed, cam).rgb)
    rasterize(given, cam).rgb.square().sum().backward()
    assert torch.equal(given.covars.grad, given.covars.grad.mT) and bool(given.covars.grad.any())
    # beyond rounding the Gaussian is not there, and its neighbours keep their bits
    cam, others = camera(dtype=dtype, device=device), [0, 2, 3]
    turn = rotations(torch.tensor([[0.3, 0.8, -0.4, 0.2]], dtype=torch.float64))[0]
    found = {}
    for lowest in (0.0, -2e-6, -1e-4, -0.3, -2.0):  # beside variances of 1 and 0.25, turned
        given = with_covariances(cloud(4, dtype, device))
        with torch.no_grad():
            variances = torch.tensor([1.0, 0.25, lowest], dtype=torch.float64)
            given.covars[1] = (turn @ torch.diag(variances) @ turn.T).to(given.covars)
        found[lowest] = rasterize(given, cam).projected.detach()
        assert gone(given, 1, cam) == (lowest < -1e-5)
    assert float((found[-2e-6] - found[0.0]).abs().max()) < 2e-4
    assert all(torch.equal(found[x][:, others], found[0.0][:, others]) for x in (-1e-4, -0.3, -2.0))


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
    cam = camera(dtype=torch.float32, device=device)
    for axes in ([1, 1, 1], [1, 0, 0], [1, 1, 0], [1, 1e-4, 1e-7]):
        given = with_covariances(cloud(3, device=device))
        with torch.no_grad():
            given.covars[1] = torch.diag(torch.tensor(axes) * 10.0**exponent).to(given.covars)
        r = rasterize(given, cam)
        assert bool(torch.isfinite(r.projected).all()) and (exponent > 30 or bool(r.visible[0, 1]))
        r.projected[..., :10].sum().backward()
        assert all(bool(torch.isfinite(t.grad).all()) for t in given.tensors().values())


COEFFICIENTS = {"fisheye": 4, "opencv": 8}


@pytest.mark.parametrize("model", COEFFICIENTS)
def test_one_row_of_coefficients_is_for_all_cameras(device, model):
    gaussians, cam = cloud(50, device=device), camera(20, 12, cameras=2, dtype=torch.float32, device=device)
    row = 0.01 * torch.arange(1, COEFFICIENTS[model] + 1, device=device)
    cam = dataclasses.replace(cam, model=model)
    each = rasterize(gaussians, dataclasses.replace(cam, distortion=row.expand(2, -1).contiguous())).rgb
    assert bool(each.any())
    for shared in (row, row.cpu().numpy()):
        assert torch.equal(rasterize(gaussians, dataclasses.replace(cam, distortion=shared)).rgb, each)


def test_one_K_is_for_all_cameras_and_gaussians_move_to_a_device(device):
    """Gradients are sums over the cameras, and go back to the tensors that moved."""
    gaussians, cam = cloud(50, device=device), camera(20, 12, cameras=2, dtype=torch.float32, device=device)
    shared, each = cam.K[0].clone().requires_grad_(), cam.K[:1].repeat(2, 1, 1).requires_grad_()
    images = [rasterize(gaussians, dataclasses.replace(cam, K=K)).rgb for K in (shared, each)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    assert torch.allclose(shared.grad, each.grad.sum(0)) and bool(shared.grad.any())
    gaussians = leaves(cloud(5))
    moved = gaussians.to(device)
    assert all(t.device.type == device.type for t in moved.tensors().values())
    rasterize(moved, camera(20, 12, dtype=torch.float32)).rgb.sum().backward()
    assert gaussians.means.grad.device.type == "cpu" and bool(gaussians.means.grad.any())


def cameras(device):
    made = [camera(*size, dtype=torch.float32, device=device) for size in ((40, 30), (18, 57))]
    return [*made, camera(25, 25, cameras=2, dtype=torch.float32, device=device)]


def gradients(renders, gaussians):
    tensors = [t for g in gaussians for t in g.tensors().values()]
    return torch.autograd.grad(sum(r.rgb.square().sum() + r.depth.sum() for r in renders), tensors)


def test_lists_have_the_bits_of_separate_calls(device):
    """A render for each camera, of different sizes, in their order; one scene for all, or a scene and options for each."""
    stored = [leaves(cloud(n, device=device, seed=n)) for n in (30, 0, 70)]
    scenes = [*stored[:2], activated(stored[2])]
    options = [RasterizeOptions(colors=torch.rand(30, 5).to(device)), RasterizeOptions(), RasterizeOptions(antialiased=True)]
    rule = RasterizeOptions(rule="balanced", background=torch.tensor([0.2, 0.4, 0.6], device=device))
    for g, o in ((stored[2], rule), (scenes, options)):
        each = [g] * 3 if g is stored[2] else g, [o] * 3 if o is rule else o
        separate = [rasterize(*one) for one in zip(each[0], cameras(device), each[1])]
        together = rasterize(g, tuple(cameras(device)), o)
        assert [r.rgb.shape[-3:-1] for r in together] == [(30, 40), (57, 18), (25, 25)]
        for a, b in zip(separate, together, strict=True):
            assert torch.equal(a.rgb, b.rgb) and torch.equal(a.depth, b.depth)
        for a, b in zip(*(gradients(renders[2:], each[0][2:]) for renders in (separate, together)), strict=True):
            assert torch.equal(a, b) and bool(a.any())
    # lengths are compared, and what is no camera is named; no camera gives no render
    scene, cams = cloud(5, device=device), cameras(device)
    assert rasterize(scene, []) == []
    with pytest.raises(ValueError, match="2 gaussians for 3 cameras: give one for all, or one for each camera"):
        rasterize([scene, scene], cams)
    with pytest.raises(ValueError, match="1 options for 3 cameras"):
        rasterize(scene, cams, [RasterizeOptions()])
    with pytest.raises(TypeError, match=r"gaussians must be an instance .* a list of gaussians requires a list of cameras"):
        rasterize([scene], cams[0])
    with pytest.raises(TypeError, match="camera must be an instance of Camera, not str"):
        rasterize(scene, [cams[0], "left"])
    with pytest.raises(ValueError, match=r"camera.K must have shape"):
        rasterize(scene, [cams[0], dataclasses.replace(cams[0], K=torch.eye(4))])
