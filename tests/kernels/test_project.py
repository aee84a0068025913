"""Projection against the paper's matrices: values, gradients, culling, extremes."""

import math

import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, hand_placed, leaves
from tests.reference.project import project_reference
from tests.tolerances import close
from warpgs.constants import FAR, RULES
from warpgs.kernels.project import project
from warpgs.scene import Gaussians

EXACT = RULES["exact"]


def run(gaussians, cam, rule=EXACT, degree=3):
    return project(
        *gaussians.tensors().values(), cam.viewmat, cam.K, width=cam.width, height=cam.height, degree=degree, rule=rule
    )


def reference_result(gaussians, cam, degree=3):
    tensors = [t.cpu().double() for t in gaussians.tensors().values()]
    low_pass = EXACT.low_pass
    return project_reference(
        *tensors, cam.viewmat.cpu().double(), cam.K.cpu().double(),
        width=cam.width, height=cam.height, degree=degree, low_pass=low_pass,
    )  # fmt: skip


def inverse_of(factor):
    """Inverse covariance [..., 2, 2] of factors [..., 3]."""
    u11, u12, u22 = factor.unbind(-1)
    U = torch.stack([torch.stack([u11, u12], -1), torch.stack([torch.zeros_like(u11), u22], -1)], -2)
    return U.transpose(-1, -2) @ U


def test_values_equal_reference(device, dtype):
    """Mean, factor, opacity, colour and depth of every Gaussian, also of those outside the image."""
    gaussians, cam = hand_placed(dtype, device), camera(cameras=3, dtype=dtype, device=device)
    projected, counts = run(gaussians, cam, SMOOTH)
    means, covs, colors, depths, opacities = reference_result(gaussians, cam)
    assert bool((counts > 0).all())
    close("projection", projected[..., 0:2], means)
    close("projection", torch.linalg.inv(inverse_of(projected[..., 2:5].cpu().double())).to(dtype), covs)
    close("projection", projected[..., 5], opacities.expand(3, -1))
    close("projection", projected[..., 6:9], colors)
    close("projection", projected[..., 9], depths)


def test_a_gaussian_does_not_see_its_neighbours(device, dtype):
    """A task of the CPU takes 16 Gaussians: culled and broken ones among them, or fewer, change no bit of the others."""
    count = 37
    gaussians, cam = cloud(count, dtype=dtype, device=device), camera(cameras=1, dtype=dtype, device=device)
    tensors = [t.detach().clone() for t in gaussians.tensors().values()]
    tensors[0][3], tensors[0][5, 2], tensors[1][8], tensors[2][18] = math.nan, -1.0, 0.0, math.inf
    tensors[3][20], tensors[4][33, 0, 0] = math.nan, 1e7
    broken = [3, 5, 8, 18, 20, 33]

    def results(rows):
        own = [t[rows].requires_grad_() for t in tensors]
        projected, counts = project(*own, cam.viewmat, cam.K, width=cam.width, height=cam.height, degree=1, rule=EXACT)
        return [projected[0], counts[0], *torch.autograd.grad(projected.square().sum(), own)]

    together = results(list(range(count)))
    assert not together[1][broken].any()
    kept = [n for n in range(count) if n not in broken]
    for rows in (kept, kept[11:12], list(range(16, 33))):
        for whole, part in zip(together, results(rows), strict=True):
            assert torch.equal(whole[rows], part)


@pytest.mark.parametrize("cameras", [1, 2])
def test_kernels_of_cuda_give_the_same_in_float64(monkeypatch, cameras):
    """In float64 they are plain Warp, so they run on a CPU beside those of the CPU, culled and broken Gaussians among them."""
    gaussians, cam = cloud(37, dtype=torch.float64, degree=3), camera(cameras=cameras, dtype=torch.float64)
    tensors = [t.detach().clone() for t in gaussians.tensors().values()]
    tensors[0][3], tensors[0][5, 2], tensors[1][8], tensors[2][18] = math.nan, -1.0, 0.0, math.inf
    tensors[2][11, 0], tensors[3][20], tensors[4][33, 0, 0] = -math.inf, math.nan, 1e7
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
    """Gradients of a random weighting of the results, for Gaussians, poses and intrinsics."""
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
    """Finite differences agree with the backward kernel, also where the Jacobian is clamped on either side."""
    gaussians, cam = leaves(hand_placed(device=device)), camera(cameras=2, device=device)
    inputs = [*gaussians.tensors().values(), cam.viewmat.requires_grad_(), cam.K.clone().requires_grad_()]

    def record(*tensors):
        projected, _ = project(*tensors, width=cam.width, height=cam.height, degree=3, rule=SMOOTH)
        return projected[..., :10]

    clamped = record(*inputs)[..., :2].detach().cpu()
    size = torch.tensor([cam.width, cam.height])
    assert bool((clamped > 1.15 * size).any()) and bool((clamped < -0.15 * size).any())
    assert torch.autograd.gradcheck(record, inputs, eps=1e-6, atol=1e-7, rtol=1e-5, nondet_tol=0.0)


def test_rotation_has_no_radial_gradient(device):
    """Stretching a quaternion changes nothing: bitwise for powers of two, and no gradient along it."""
    gaussians, cam = leaves(hand_placed(torch.float32, device)), camera(dtype=torch.float32, device=device, cameras=1)
    projected, _ = run(gaussians, cam, SMOOTH)
    (projected[..., 2:5].sum()).backward()
    radial = (gaussians.quats.grad * gaussians.quats.detach()).sum(1).abs()
    assert bool((radial <= 1e-5 * gaussians.quats.grad.norm(dim=1) * gaussians.quats.detach().norm(dim=1)).all())
    for factor in (2.0**40, 2.0**-40, -1.0):
        stretched = Gaussians(**{**gaussians.tensors(), "quats": gaussians.quats.detach() * factor})
        assert torch.equal(run(stretched, cam, SMOOTH)[0], projected)


@pytest.mark.parametrize("slot", ["means", "quats", "log_scales", "logit_opacities", "sh"])
@pytest.mark.parametrize("poison", [math.nan, math.inf, -math.inf])
def test_poisoned_gaussian_is_no_op(device, slot, poison):
    """A Gaussian with one non-finite number is culled: zero results, zero gradient, its neighbours untouched bit for bit."""
    if (slot, poison) in (("log_scales", -math.inf), ("logit_opacities", math.inf)):
        return  # scale 0 and opacity 1, which tests/render/test_activated.py renders
    clean, cam = cloud(8, device=device), camera(cameras=1, dtype=torch.float32, device=device)
    cut = Gaussians(**{n: torch.cat([t[:3], t[4:]]) for n, t in clean.tensors().items()})
    for column in range(clean.tensors()[slot][0].numel()):
        bad = {n: t.clone() for n, t in clean.tensors().items()}
        bad[slot].view(8, -1)[3, column] = poison
        bad = leaves(Gaussians(**bad))
        projected, counts = run(bad, cam, degree=1)
        assert int(counts[0, 3]) == 0 and not bool(projected[0, 3].any())
        projected.sum().backward()
        for name, t in bad.tensors().items():
            assert bool(torch.isfinite(t.grad).all()), name
            assert not bool(t.grad[3].any()), name
        reference, _ = run(cut, cam, degree=1)
        assert torch.equal(torch.cat([projected[:, :3], projected[:, 4:]], 1).detach(), reference)


def test_zero_quaternion_is_culled(device, dtype):
    """No rotation can be read from it."""
    gaussians, cam = cloud(3, dtype, device), camera(cameras=1, dtype=dtype, device=device)
    gaussians.quats[1] = 0
    projected, counts = run(gaussians, cam, degree=1)
    assert int(counts[0, 1]) == 0 and not bool(projected[0, 1].any())


@pytest.mark.parametrize("z", [-1.0, 0.0, -0.0, 1e-30, 0.01, 1e10, 1e30])
def test_near_plane(device, z):
    """Rendered from the near plane on up to FAR, culled before it, one float apart; gradients finite everywhere."""
    gaussians, cam = cloud(3, device=device), camera(cameras=1, dtype=torch.float32, device=device)
    near = torch.tensor(EXACT.near, dtype=torch.float32)
    gaussians.log_scales[:] = math.log(min(max(abs(z), 1e-3), FAR))
    below, above = torch.nextafter(near, torch.tensor(0.0)), torch.nextafter(near, torch.tensor(1.0))
    for depth in {z, float(below), float(near), float(above)}:
        gaussians.means[1] = torch.tensor([0.0, 0.0, depth])
        moving = leaves(gaussians)
        projected, counts = run(moving, cam, degree=1)
        assert (int(counts[0, 1]) > 0) == (float(near) <= depth <= FAR), depth
        projected[..., :10].sum().backward()
        assert all(bool(torch.isfinite(t.grad).all()) for t in moving.tensors().values())


@pytest.mark.parametrize("log_scale", [-200.0, -50.0, -44.0, -10.0, 0.0, 10.0, 40.0, 44.4, 88.0, 88.8, 200.0])
def test_extreme_scales_stay_finite(device, dtype, log_scale):
    """Any finite scale is rendered or culled; up to e^40 it is rendered; results and gradients are finite."""
    gaussians, cam = cloud(3, dtype, device), camera(cameras=1, dtype=dtype, device=device)
    for axis in range(3):
        gaussians.log_scales[1] = -2.0
        gaussians.log_scales[1, axis] = log_scale
        moving = leaves(gaussians)
        projected, counts = run(moving, cam, degree=1)
        assert bool(torch.isfinite(projected).all())
        if log_scale <= 40:
            assert int(counts[0, 1]) > 0
        projected[..., :10].sum().backward()
        assert all(bool(torch.isfinite(t.grad).all()) for t in moving.tensors().values())


def test_needles_keep_their_factor(device):
    """The float32 factor of needles up to 1e5 px gives the float64 weight to 3e-4, where a conic fails at 300 px."""
    cam = camera(640, 480, cameras=1, dtype=torch.float32, device=device)
    focal = float(cam.K[0, 0, 0])
    for sigma in (1.0, 10.0, 100.0, 300.0, 1e3, 1e4):
        turns = torch.linspace(0.01, math.pi - 0.01, 40, dtype=torch.float64)
        count = len(turns)
        base = cloud(count, torch.float64, device)
        base.means[:] = torch.tensor([0.01, 0.02, 1.0])
        base.quats[:] = torch.stack([torch.cos(turns / 2), 0 * turns, 0 * turns, torch.sin(turns / 2)], 1).to(device)
        base.log_scales[:] = torch.log(torch.tensor([sigma / focal, 1e-7, 1e-7], dtype=torch.float64))
        single = Gaussians(**{n: t.float() for n, t in base.tensors().items()})
        stored = Gaussians(**{n: t.double() for n, t in single.tensors().items()})
        exact = camera(640, 480, cameras=1, device=device)
        found, _ = run(single, cam, SMOOTH, degree=0)
        wanted, _ = run(stored, exact, SMOOTH, degree=0)
        assert bool((found[..., 2:5] != 0).any(-1).all())
        # sample the weight along the needle, in float64, so that only the factor's own error shows
        along = torch.stack([torch.cos(turns), torch.sin(turns) * 1.1], 1).to(device)
        for t in (0.3, 1.0, 2.0):
            d = along * t * sigma
            weights = []
            for record in (found.double(), wanted):
                u11, u12, u22 = record[0, :, 2:5].unbind(-1)
                weights.append(torch.exp(-0.5 * ((u11 * d[:, 0] + u12 * d[:, 1]) ** 2 + (u22 * d[:, 1]) ** 2)))
            assert float((weights[0] - weights[1]).abs().max()) <= 3e-4 * max(1.0, sigma / 1e3), sigma


def test_off_screen_is_culled_and_boundary_is_not(device, dtype):
    """A small Gaussian just outside is culled, one whose edge reaches in is kept."""
    gaussians, cam = cloud(2, dtype, device), camera(64, 48, cameras=1, dtype=dtype, device=device)
    focal = float(cam.K[0, 0, 0])
    gaussians.log_scales[:] = math.log(1.0 / focal)  # about 1 px at depth 1
    for offset, visible in ((-2.0, True), (-12.0, False)):
        x = (offset - float(cam.K[0, 0, 2])) / focal
        gaussians.means[0] = torch.tensor([x, 0.0, 1.0])
        _, counts = run(gaussians, cam, degree=1)
        assert (int(counts[0, 0]) > 0) is visible


def test_empty_and_bad_input():
    """No Gaussians are fine; wrong shapes, types and sizes name the argument."""
    gaussians, cam = cloud(4), camera(cameras=1, dtype=torch.float32)
    empty = Gaussians(**{n: t[:0] for n, t in gaussians.tensors().items()})
    projected, counts = run(empty, cam, degree=1)
    assert projected.shape == (1, 0, 12) and counts.shape == (1, 0)
    for name, t in gaussians.tensors().items():
        broken = Gaussians(**{**gaussians.tensors(), name: t[:3]})
        with pytest.raises(ValueError, match=name if name != "means" else "quats"):
            run(broken, cam, degree=1)
    with pytest.raises(TypeError, match=r"log_scales is torch\.float64"):
        run(Gaussians(**{**gaussians.tensors(), "log_scales": gaussians.log_scales.double()}), cam, degree=1)
    with pytest.raises(ValueError, match="degree 3 needs 16"):
        run(gaussians, cam, degree=3)
