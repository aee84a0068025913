"""Projection against the paper's matrices: values, gradients, culling, extremes, and each guard alone at its limit."""

import dataclasses
import math

import pytest
import torch

from bench.lib.kernel_calls import project
from tests.gaussians import SMOOTH, camera, cloud, hand_placed, leaves
from tests.reference.project import project_reference
from tests.tolerances import close
from warpgs.constants import FAR, FARTHEST_PIXEL, LARGEST_COEFFICIENT, RULES, SHORTEST_QUAT
from warpgs.scene import Gaussians

EXACT = RULES["exact"]


def run(gaussians, cam, rule=EXACT, degree=1, **options):
    size = {"width": cam.width, "height": cam.height}
    return project(*gaussians.tensors().values(), cam.viewmat, cam.K, **size, degree=degree, rule=rule, **options)


def reference_result(gaussians, cam, degree=1, rule=EXACT):
    tensors = [t.cpu().double() for t in (*gaussians.tensors().values(), cam.viewmat, cam.K)]
    return project_reference(*tensors, width=cam.width, height=cam.height, degree=degree, low_pass=rule.low_pass)


def inverse_of(factor):
    u11, u12, u22 = factor.unbind(-1)
    U = torch.stack([torch.stack([u11, u12], -1), torch.stack([torch.zeros_like(u11), u22], -1)], -2)
    return U.transpose(-1, -2) @ U


def test_values_equal_reference(device, dtype):
    gaussians, cam = hand_placed(dtype, device), camera(cameras=3, dtype=dtype, device=device)
    projected, counts = run(gaussians, cam, SMOOTH, 3)
    means, covs, colors, depths, opacities = reference_result(gaussians, cam, 3)
    assert bool((counts > 0).all())
    close("projection", projected[..., 0:2], means)
    close("projection", torch.linalg.inv(inverse_of(projected[..., 2:5].cpu().double())).to(dtype), covs)
    close("projection", projected[..., 5], opacities.expand(3, -1))
    close("projection", projected[..., 6:9], colors)
    close("projection", projected[..., 9], depths)


@pytest.mark.parametrize("cameras", [1, 2])
def test_kernels_of_cuda_give_the_same_in_float64(monkeypatch, cameras):
    """In float64 they are plain Warp, so they run on a CPU beside those of the CPU, culled and broken Gaussians among them."""
    tensors, cam = [*cloud(37, torch.float64, degree=3).tensors().values()], camera(cameras=cameras, dtype=torch.float64)
    tensors[0][3], tensors[0][5, 2], tensors[1][8], tensors[2][18] = math.nan, -1.0, 0.0, math.inf
    tensors[3][20], tensors[4][33, 0, 0], tensors[2][11, 0] = math.nan, 1e7, -math.inf
    leaves = [*(t.requires_grad_() for t in tensors), cam.viewmat.clone().requires_grad_(), cam.K.clone().requires_grad_()]

    def everything():
        projected, counts = project(*leaves, width=cam.width, height=cam.height, degree=3, rule=EXACT)
        return counts, projected, *torch.autograd.grad((projected * torch.arange(12.0)).sum(), leaves)

    wanted = everything()
    assert 20 < int((wanted[0] > 0).sum()) / cameras < 37
    monkeypatch.setattr("warpgs.kernels.project._threads_each", lambda tensor: True)
    found = everything()
    assert torch.equal(found[0], wanted[0])
    for a, b in zip(found[1:], wanted[1:]):
        close("projection", a, b)


def test_gradients_equal_reference(device, dtype):
    gaussians, cam = leaves(hand_placed(dtype, device)), camera(cameras=2, dtype=dtype, device=device)
    views, Ks = cam.viewmat.clone().requires_grad_(), cam.K.clone().requires_grad_()
    projected, _ = project(*gaussians.tensors().values(), views, Ks, width=cam.width, height=cam.height, degree=3, rule=SMOOTH)
    upstream = torch.randn(projected.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    upstream[..., 10:] = 0
    (projected * upstream.to(projected)).sum().backward()

    other = [t.detach().cpu().double().requires_grad_() for t in (*gaussians.tensors().values(), cam.viewmat, cam.K)]
    means, covs, colors, depths, opacities = project_reference(
        *other, width=cam.width, height=cam.height, degree=3, low_pass=SMOOTH.low_pass
    )
    # the upper triangular factor of the inverse, by Cholesky of the flipped matrix
    inverse = torch.linalg.inv(covs)
    u11 = torch.sqrt(inverse[..., 0, 0])
    u12 = inverse[..., 0, 1] / u11
    u22 = torch.sqrt(inverse[..., 1, 1] - u12**2)
    record = torch.cat([means, torch.stack([u11, u12, u22, opacities.expand_as(u11)], -1), colors, depths[..., None]], -1)
    (record * upstream[..., :10]).sum().backward()
    names = [*gaussians.tensors(), "viewmats", "Ks"]
    for name, a, b in zip(names, [*gaussians.tensors().values(), views, Ks], other):
        wanted = b.grad.clone()
        if name == "Ks":
            wanted[:, 0, 1] = wanted[:, 1, 0] = 0
        assert bool((a.grad != 0).any()), name
        close("gradient", a.grad, wanted)


def test_gradcheck(device):
    gaussians, cam = leaves(hand_placed(device=device)), camera(cameras=2, device=device)
    inputs = [*gaussians.tensors().values(), cam.viewmat.requires_grad_(), cam.K.clone().requires_grad_()]

    def record(*tensors):
        projected, _ = project(*tensors, width=cam.width, height=cam.height, degree=3, rule=SMOOTH)
        return projected[..., :10]

    clamped = record(*inputs)[..., :2].detach().cpu()
    size = torch.tensor([cam.width, cam.height])
    assert bool((clamped > 1.15 * size).any()) and bool((clamped < -0.15 * size).any())
    assert torch.autograd.gradcheck(record, inputs, eps=1e-6, atol=1e-7, rtol=1e-5, nondet_tol=0.0)


def test_empty_and_bad_input():
    gaussians, cam = cloud(4), camera(cameras=1, dtype=torch.float32)
    empty = Gaussians(**{n: t[:0] for n, t in gaussians.tensors().items()})
    projected, counts = run(empty, cam)
    assert projected.shape == (1, 0, 12) and counts.shape == (1, 0)
    for name, t in gaussians.tensors().items():
        broken = Gaussians(**{**gaussians.tensors(), name: t[:3]})
        with pytest.raises(ValueError, match=name if name != "means" else "quats"):
            run(broken, cam)
    with pytest.raises(TypeError, match=r"log_scales is torch\.float64"):
        run(Gaussians(**{**gaussians.tensors(), "log_scales": gaussians.log_scales.double()}), cam)
    with pytest.raises(ValueError, match="the degree needs 16"):
        run(gaussians, cam, degree=3)
    one = camera(1, 1, cameras=1, dtype=torch.float32)
    assert run(gaussians, one, SMOOTH)[0].shape == (1, 4, 12)
    for width, height in ((0, 5), (5, 0)):
        with pytest.raises(ValueError, match="at least 1 x 1 px"):
            run(gaussians, dataclasses.replace(one, width=width, height=height))


# Projection at its limits, each guard alone: where < and <= differ, where only one of two conditions holds.


def facing(count=1, dtype=torch.float32, device="cpu", size=16) -> tuple[Gaussians, object]:
    """Round Gaussians of 1 px in the middle of a pixel, at depth 1 before a camera that does not turn."""
    cam = camera(size, size, cameras=1, dtype=dtype, device=device)
    gaussians = cloud(count, dtype, device)
    K = cam.K[0].cpu().double()
    x, y = (8.5 - K[0, 2]) / K[0, 0], (8.5 - K[1, 2]) / K[1, 1]
    gaussians.means[:] = torch.tensor([x, y, 1.0])
    gaussians.log_scales[:] = -math.log(float(K[0, 0]))
    gaussians.quats[:] = torch.tensor([1.0, 0, 0, 0])
    return gaussians, cam


def test_quaternions_along_an_axis_turn_as_the_reference(device, dtype):
    """Zeros and any ratio of entries are fine: the length is taken of the largest."""
    axes = torch.eye(4, dtype=torch.float64)
    quats = torch.cat([axes, axes * 1e-14, axes * 1e14, axes + 1e-25]).to(dtype)
    gaussians, cam = cloud(len(quats), dtype, device), camera(cameras=1, dtype=dtype, device=device)
    gaussians.quats[:] = quats.to(device)
    projected, counts = run(gaussians, cam, SMOOTH)
    _, covs, *_ = reference_result(gaussians, cam, rule=SMOOTH)
    inverse = torch.linalg.inv(covs)
    assert bool((counts > 0).all())
    close("projection", projected[..., 2], inverse[..., 0, 0].sqrt())
    close("projection", projected[..., 3], inverse[..., 0, 1] / inverse[..., 0, 0].sqrt())


def test_without_a_filter_a_flat_gaussian_is_culled_and_no_other(device):
    """A covariance without an inverse has no factor; a small determinant is one."""
    gaussians, cam = facing(5, device=device)
    bare = dataclasses.replace(EXACT, low_pass=0.0)
    gaussians.log_scales[4, ::2] = -45.0  # a line whose factor is finite still
    gaussians.log_scales[1] = -200.0  # a point
    gaussians.log_scales[2, ::2] = -200.0  # a line
    gaussians.log_scales[3] -= 1.0  # 0.37 px
    projected, counts = run(gaussians, cam, bare)
    assert counts.tolist() == [[1, 0, 0, 1, 0]] and bool(torch.isfinite(projected).all())


def test_the_farthest_depth_pixel_and_coefficient_are_drawn(device, dtype):
    """Each range holds its end, and not the next number."""
    K = torch.eye(3, dtype=dtype, device=device)[None]
    cam = dataclasses.replace(camera(16, 16, cameras=1, dtype=dtype, device=device), K=K)

    def drawn(**changes):
        gaussians = cloud(1, dtype, device)
        gaussians.means[:] = torch.tensor([1.0, 1.0, 1.0])
        for name, (slot, value) in changes.items():
            getattr(gaussians, name).view(-1)[slot] = value
        return int(run(gaussians, cam, SMOOTH)[1][0, 0]) > 0

    assert drawn()
    ends = [("means", 2, FAR), ("sh", 0, LARGEST_COEFFICIENT), ("sh", 7, -LARGEST_COEFFICIENT), ("sh", 11, LARGEST_COEFFICIENT)]
    ends += [("means", axis, sign * FARTHEST_PIXEL) for axis in (0, 1) for sign in (1, -1)]
    for name, slot, end in ends:
        end = torch.tensor(end, dtype=dtype)
        assert drawn(**{name: (slot, end)}), (name, slot)
        assert not drawn(**{name: (slot, torch.nextafter(end, 2 * end))}), (name, slot)


def test_quaternions_at_their_ends_and_an_opacity_at_the_cut_are_drawn(device, dtype):
    """The shortest length itself gives a rotation, a shorter one does not; likewise for the longest."""
    gaussians, cam = facing(5, dtype, device)
    shortest = torch.tensor(SHORTEST_QUAT, dtype=dtype)
    gaussians.quats[:, 0] = torch.stack(
        [shortest, torch.nextafter(shortest, 0 * shortest), 0.999 / shortest, 1.001 / shortest, shortest**0]
    )
    assert (run(gaussians, cam)[1] > 0).tolist() == [[True, False, True, False, True]]
    # sigmoid(0) is 1/2 to the bit; an opacity that rounds to 0 is culled even without a cut
    gaussians, cam = facing(3, dtype, device)
    gaussians.logit_opacities[:] = torch.tensor([0.0, -1e-3, -1000.0], dtype=dtype)
    half = dataclasses.replace(EXACT, alpha_cut=0.5)
    assert run(gaussians, cam, half)[1].tolist() == [[1, 0, 0]]
    assert (run(gaussians, cam, SMOOTH)[1] > 0).tolist() == [[True, True, False]]


@pytest.mark.parametrize("logit", [-700.0, -40.0, -3.0, 0.0, 0.7, 3.0, 40.0, 700.0, 1000.0])
def test_opacities_equal_the_sigmoid(device, logit):
    """Both signs are tested far out, in float64, whose exponential overflows beyond 709."""
    gaussians, cam = facing(1, torch.float64, device)
    gaussians.logit_opacities[:] = logit
    found = run(gaussians, cam, dataclasses.replace(SMOOTH, near=0.01))[0][0, 0, 5].cpu()
    wanted = torch.sigmoid(torch.tensor(logit, dtype=torch.float64))
    assert abs(float(found - wanted)) <= 1e-13 * float(wanted)


@pytest.mark.parametrize("log_scale", [3.0, 9.0, 14.0, 20.0])
def test_factors_of_the_largest_shrink_as_the_scale_grows(device, log_scale):
    """Beside its size the low-pass is nothing: each entry of the factor is homogeneous of degree -1 in the scales (Euler)."""
    gaussians, cam = facing(1, torch.float64, device)
    gaussians.quats[:] = torch.tensor([0.8, 0.3, -0.4, 0.2])
    gaussians.log_scales[:] = torch.tensor([0.0, -0.3, 0.4]) + log_scale
    moving = leaves(gaussians)
    projected, _ = run(moving, cam, dataclasses.replace(SMOOTH, low_pass=1e-9, near=0.01))
    for k in (2, 3, 4):
        (gradient,) = torch.autograd.grad(projected[0, 0, k], moving.log_scales, retain_graph=True)
        value = float(projected[0, 0, k].detach())
        assert value != 0 and abs(float(gradient.sum()) + value) <= 1e-9 * abs(value), k


def test_boxes_reach_to_the_cut_and_squares_are_three_sigma_rounded_up(device):
    """The reach, at which alpha is the cut, times the standard deviations; or three times the longest one, in whole pixels."""
    for rule in (EXACT, RULES["inria"]):
        gaussians, cam = cloud(200, torch.float64, device), camera(400, 300, cameras=2, device=device)
        projected, counts = run(gaussians, cam, rule)
        _, covs, *_, opacities = reference_result(gaussians, cam, rule=rule)
        seen = counts.cpu() > 0
        assert int(seen.sum()) > 100
        found, covs, opacities = projected.cpu()[seen][:, 10:], covs[seen], opacities.expand(2, -1)[seen]
        if rule is EXACT:
            reach = (2 * torch.log(opacities / EXACT.alpha_cut)).sqrt()
            wanted = reach[:, None] * torch.stack([covs[:, 0, 0], covs[:, 1, 1]], -1).sqrt()
            assert bool((found >= wanted).all()) and bool((found <= wanted * (1 + 1e-3)).all())
        else:
            wanted = torch.ceil(3 * torch.linalg.eigvalsh(covs)[:, 1].sqrt())
            assert torch.equal(found, wanted[:, None].expand(-1, 2))


def test_squares_grow_with_the_longest_axis(device, dtype):
    """Beyond 65,536 px, where axes are shrunk while they are squared, as below."""
    gaussians, cam = facing(3, dtype=dtype, device=device)
    sizes = torch.tensor([1e4, 1e6, 1e8], dtype=dtype, device=device)
    gaussians.log_scales[:] += sizes.log()[:, None]
    projected, counts = run(gaussians, cam, RULES["inria"])
    fraction = projected[0, :, 10:] / sizes[:, None]
    assert counts.tolist() == [[1, 1, 1]] and bool((fraction > 3).all())
    assert torch.allclose(fraction, fraction[:1].expand_as(fraction), rtol=1e-4)


@pytest.mark.parametrize("wanted", ["viewmats", "Ks"])
def test_one_gradient_of_the_camera_may_be_asked_for_alone(device, wanted):
    gaussians, cam = hand_placed(device=device), camera(cameras=2, device=device)
    views = cam.viewmat.clone().requires_grad_(wanted == "viewmats")
    Ks = cam.K.clone().requires_grad_(wanted == "Ks")
    size = {"width": cam.width, "height": cam.height}
    projected, _ = project(*leaves(gaussians).tensors().values(), views, Ks, **size, degree=3, rule=SMOOTH)
    (projected[..., :10] ** 2).sum().backward()
    assert bool((views if wanted == "viewmats" else Ks).grad.any())


@pytest.mark.parametrize("axis", [0, 1])
def test_huge_scales_keep_their_factor(device, axis):
    """Far beyond where the determinant leaves the range of float32, along either side of the image."""
    gaussians, cam = facing(1, device=device)
    gaussians.log_scales[0, axis] = 50.0
    exact = Gaussians(**{n: t.double() for n, t in gaussians.tensors().items()})
    wide = camera(16, 16, cameras=1, device=device)
    found, wanted = run(gaussians, cam, SMOOTH)[0], run(exact, wide, SMOOTH)[0]
    assert torch.allclose(found[..., [2, 4]].double(), wanted[..., [2, 4]], rtol=1e-5, atol=0)


def test_colours_and_gradients_of_near_gaussians(device):
    """Straight ahead, to one side, and nearer than one unit: the direction is normalised at any distance."""
    gaussians, cam = cloud(4, torch.float64, device, degree=3), camera(cameras=1, device=device)
    gaussians.means[:] = torch.tensor([[0, 0, 0.5], [0.02, 0, 0.1], [0, -0.03, 0.2], [0.01, 0.02, 0.05]], dtype=torch.float64)
    gaussians.log_scales[:] = -5.0
    moving, other = leaves(gaussians), leaves(Gaussians(**{n: t.cpu() for n, t in gaussians.tensors().items()}))
    projected, counts = run(moving, cam, SMOOTH, degree=3)
    assert bool((counts > 0).all())
    _, _, colors, _, _ = reference_result(other, cam, 3, SMOOTH)
    close("projection", projected[..., 6:9], colors)
    projected[..., 6:9].square().sum().backward()
    colors.square().sum().backward()
    close("gradient", moving.means.grad, other.means.grad)


def test_no_cut_asks_for_every_tile_and_one_gaussian_takes_its_factor(device):
    """Half sides without a cut cover any image; tiles have 16 px unless it is said."""
    gaussians, cam = facing(1, device=device)
    projected, counts = run(gaussians, cam, SMOOTH, window=(0, 0, 16, 16))
    assert bool((projected[0, :, 10:] >= 1e30).all()) and counts.tolist() == [[1]]
    assert run(*facing(1, device=device, size=17), SMOOTH)[1].tolist() == [[4]]
    gaussians, cam = facing(1, device=device)
    full, half = (
        run(gaussians, cam, SMOOTH, opacity_factors=f)[0][0, 0, 5] for f in (None, torch.full((1,), 0.5, device=device))
    )
    assert float(half) == 0.5 * float(full)
