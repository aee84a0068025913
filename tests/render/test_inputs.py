"""What a call takes: activated parameters, covariances, degree 4, batches of cameras, lists."""

import dataclasses
import functools
import math

import numpy as np
import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, hand_placed, leaves
from tests.reference.blend import blend_reference
from tests.reference.project import project_reference, rotations
from tests.tolerances import close
from warpgs.errors import UsageError
from warpgs.geometry import gaussian_normals, rotate, rotation_matrices
from warpgs.pipeline.model.edit import rotation_about
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import ActivatedGaussians, CovarianceGaussians

# Activated parameters: scales and opacities themselves, and the limits that stored ones reach at infinity.


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


def test_activated_wrong_input_is_named():
    """Errors name the fields that were given."""
    given, cam = activated(cloud(5)), camera(dtype=torch.float32)
    with pytest.raises(ValueError, match="scales"):
        rasterize(ActivatedGaussians(given.means, given.quats, given.scales[:3], given.opacities, given.sh), cam)
    with pytest.raises(ValueError, match="opacities"):
        rasterize(ActivatedGaussians(given.means, given.quats, given.scales, given.opacities[:, None], given.sh), cam)


def test_activated_what_is_no_number_is_culled(dtype):
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


# Covariances instead of rotations and scales: equal images, gradients, limits.

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
def test_covariances_what_is_no_number_is_culled(device, poison):
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


def test_covariances_wrong_input_is_named():
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


# Spherical harmonics of degree 4: whole renders against references, turned scenes, coefficients that are not used.


def test_images_and_gradients_equal_reference(device, dtype):
    """Through projection and blending, two cameras at once, so that coefficients get sums."""
    gaussians, cam = leaves(hand_placed(dtype, device, degree=4)), camera(cameras=2, dtype=dtype, device=device)
    r = rasterize(gaussians, cam, RasterizeOptions(rule=SMOOTH))
    other = [t.detach().cpu().double().requires_grad_() for t in (*gaussians.tensors().values(), cam.viewmat, cam.K)]
    parts = project_reference(*other, width=cam.width, height=cam.height, degree=4, low_pass=SMOOTH.low_pass)
    means, covs, colors, depths, opacities = parts
    size, black = (cam.width, cam.height), torch.zeros(3, dtype=torch.float64)
    images = [
        blend_reference(*p, opacities, *q, black, *size, SMOOTH)[0] for p, q in zip(zip(means, covs), zip(colors, depths))
    ]
    wanted = torch.stack(images)
    close("image", r.rgb, wanted)
    upstream = torch.randn(wanted.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    (r.rgb * upstream.to(r.rgb)).sum().backward()
    (wanted * upstream).sum().backward()
    assert bool(gaussians.sh.grad[:, 16:].any())
    for a, b in zip(gaussians.tensors().values(), other):
        close("gradient", a.grad, b.grad)


@pytest.mark.parametrize("degree", [3, 4])
def test_a_turned_scene_with_its_camera_gives_the_same_image(device, dtype, degree):
    """Means, shapes and harmonics turn; colours and gradients of opacities stay."""
    turn = rotation_about(np.array([0.3, -0.8, 0.5]), 1.1)
    gaussians, cam = cloud(60, dtype, device, degree=degree), camera(40, 30, dtype=dtype, device=device)
    pose = torch.eye(4, dtype=dtype, device=device)
    pose[:3, :3] = torch.from_numpy(turn.T).to(pose)
    turned = dataclasses.replace(cam, viewmat=cam.viewmat @ pose)
    found = []
    for g, c in ((gaussians, cam), (rotate(gaussians, turn), turned)):
        g = leaves(g)
        r = rasterize(g, c)
        r.rgb.square().sum().backward()
        found.append((r.rgb, g.logit_opacities.grad))
    limit = 2e-5 if dtype == torch.float32 else 1e-12  # measured: 2.0e-6, 4.1e-15
    assert float((found[0][0] - found[1][0]).detach().abs().max()) <= limit
    assert float((found[0][1] - found[1][1]).norm()) <= 10 * limit * float(found[0][1].norm())
    unturned = rasterize(gaussians, turned).rgb
    assert float((unturned - found[0][0]).detach().abs().max()) > 0.01


@pytest.mark.parametrize("degree", [0, 2, 3])
def test_lower_degrees_of_25_coefficients(device, degree):
    """The bits of those coefficients alone; those above may be NaN, and get gradients of 0."""
    gaussians, cam = cloud(60, device=device, degree=4), camera(40, 30, cameras=2, dtype=torch.float32, device=device)
    count = (degree + 1) ** 2
    gaussians.sh[:, count:] = math.nan
    found = []
    for sh in (gaussians.sh, gaussians.sh[:, :count].contiguous()):
        g = leaves(dataclasses.replace(gaussians, sh=sh))
        r = rasterize(g, cam, RasterizeOptions(sh_degree=degree))
        r.rgb.square().sum().backward()
        found.append((r.rgb, g.sh.grad, g.means.grad))
    (a, v, m), (b, w, n) = found
    assert torch.equal(a, b) and torch.equal(v[:, :count], w) and torch.equal(m, n) and not bool(v[:, count:].any())


# Cameras and Gaussians brought together: shared intrinsics and lenses, errors of those that do not fit, and devices.

COEFFICIENTS = {"fisheye": 4, "opencv": 8}


@pytest.mark.parametrize("model", COEFFICIENTS)
def test_one_row_of_coefficients_is_for_all_cameras(device, model):
    """As the same row for each camera; numpy coefficients work too."""
    gaussians, cam = cloud(50, device=device), camera(20, 12, cameras=2, dtype=torch.float32, device=device)
    row = 0.01 * torch.arange(1, COEFFICIENTS[model] + 1, device=device)
    cam = dataclasses.replace(cam, model=model)
    each = rasterize(gaussians, dataclasses.replace(cam, distortion=row.expand(2, -1).contiguous())).rgb
    assert bool(each.any())
    for shared in (row, row.cpu().numpy()):
        assert torch.equal(rasterize(gaussians, dataclasses.replace(cam, distortion=shared)).rgb, each)


def test_one_K_is_for_all_cameras(device):
    """Its gradient is the sum of those of the cameras."""
    gaussians, cam = cloud(50, device=device), camera(20, 12, cameras=2, dtype=torch.float32, device=device)
    shared, each = cam.K[0].clone().requires_grad_(), cam.K[:1].repeat(2, 1, 1).requires_grad_()
    images = [rasterize(gaussians, dataclasses.replace(cam, K=K)).rgb for K in (shared, each)]
    assert torch.equal(*images)
    for image in images:
        image.square().sum().backward()
    assert torch.allclose(shared.grad, each.grad.sum(0)) and bool(shared.grad.any())


@pytest.mark.parametrize(
    "change, message",
    [
        ({"K": torch.eye(3).repeat(3, 1, 1)}, r"camera\.K must have shape \[3, 3\] or \[2, 3, 3\].*, not \[3, 3, 3\]"),
        ({"viewmat": torch.eye(4)}, r"camera\.K must have shape \[3, 3\] or \[1, 3, 3\].*camera\.viewmat.*, not \[2, 3, 3\]"),
        ({"distortion": torch.zeros(3, 4)}, r"camera\.distortion must have shape \[4\] or \[2, 4\].*, not \[3, 4\]"),
    ],
    ids=["K", "viewmat", "distortion"],
)
def test_cameras_that_do_not_fit_together(change, message):
    """The error names the camera's own field, and the shape that was given."""
    cam = dataclasses.replace(camera(20, 12, cameras=2, dtype=torch.float32), model="fisheye", distortion=torch.zeros(4))
    with pytest.raises(ValueError, match=message):
        rasterize(cloud(5), dataclasses.replace(cam, **change))


def test_gaussians_move_to_a_device(device):
    """All five tensors, with gradients back to those that moved."""
    gaussians = leaves(cloud(5))
    moved = gaussians.to(device)
    assert all(t.device.type == device.type for t in moved.tensors().values())
    rasterize(moved, camera(20, 12, dtype=torch.float32)).rgb.sum().backward()
    assert gaussians.means.grad.device.type == "cpu" and bool(gaussians.means.grad.any())


# Lists of cameras of different sizes, of scenes and of options: the bits of separate calls.


def cameras(device):
    """Two single cameras and a batch, of three sizes."""
    made = [camera(*size, dtype=torch.float32, device=device) for size in ((40, 30), (18, 57))]
    return [*made, camera(25, 25, cameras=2, dtype=torch.float32, device=device)]


def gradients(renders, gaussians):
    """Gradients of all images by all tensors."""
    tensors = [t for g in gaussians for t in g.tensors().values()]
    return torch.autograd.grad(sum(r.rgb.square().sum() + r.depth.sum() for r in renders), tensors)


def test_cameras_of_different_sizes(device):
    """One scene: a render for each camera, in their order, as separate calls give them; a tuple is a list."""
    scene, cams = leaves(cloud(80, device=device)), cameras(device)
    options = RasterizeOptions(rule="balanced", background=torch.tensor([0.2, 0.4, 0.6], device=device))
    separate = [rasterize(scene, cam, options) for cam in cams]
    together = rasterize(scene, tuple(cams), options)
    assert [r.rgb.shape[-3:-1] for r in together] == [(30, 40), (57, 18), (25, 25)]
    for a, b in zip(separate, together, strict=True):
        assert torch.equal(a.rgb, b.rgb) and torch.equal(a.depth, b.depth)
    for a, b in zip(gradients(separate, [scene]), gradients(together, [scene]), strict=True):
        assert torch.equal(a, b) and bool(a.any())


def test_scenes_of_different_counts_and_options(device):
    """A scene and options for each camera: as many Gaussians as each has, of either kind, with colours of its own."""
    stored = [leaves(cloud(n, device=device, seed=n)) for n in (30, 0, 70)]
    t = {n: v.detach() for n, v in stored[2].tensors().items()}
    last = (t["means"], t["quats"], t["log_scales"].exp(), t["logit_opacities"].sigmoid())
    scenes = [*stored[:2], ActivatedGaussians(*(v.requires_grad_() for v in last), sh=stored[2].sh)]
    options = [RasterizeOptions(colors=torch.rand(30, 5).to(device)), RasterizeOptions(), RasterizeOptions(antialiased=True)]
    separate = [rasterize(g, c, o) for g, c, o in zip(scenes, cameras(device), options)]
    together = rasterize(scenes, cameras(device), options)
    for a, b in zip(separate, together, strict=True):
        assert torch.equal(a.rgb, b.rgb) and a.rgb.shape == b.rgb.shape
    own = [scenes[2]]
    assert all(torch.equal(a, b) for a, b in zip(gradients(separate[2:], own), gradients(together[2:], own)))


def test_lists_that_do_not_go_together(device):
    """Lengths are compared, and what is no camera is named; no camera gives no render."""
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
