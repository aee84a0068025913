"""Projection at its limits, each guard alone: where < and <= differ, where only one of two conditions holds."""

import dataclasses
import math

import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, hand_placed, leaves
from tests.reference.project import project_reference
from tests.tolerances import close
from warpgs.constants import FAR, FARTHEST_PIXEL, LARGEST_COEFFICIENT, RULES, SHORTEST_QUAT
from warpgs.kernels.project import project
from warpgs.scene import C0, Gaussians

EXACT = RULES["exact"]


def run(gaussians, cam, rule=EXACT, degree=1, **options):
    return project(
        *gaussians.tensors().values(),
        cam.viewmat,
        cam.K,
        width=cam.width,
        height=cam.height,
        degree=degree,
        rule=rule,
        **options,
    )


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
    plain = [t.cpu().double() for t in gaussians.tensors().values()]
    _, covs, *_ = project_reference(
        *plain, cam.viewmat.cpu().double(), cam.K.cpu().double(), width=18, height=17, degree=1, low_pass=SMOOTH.low_pass
    )
    inverse = torch.linalg.inv(covs)
    assert bool((counts > 0).all())
    close("projection", projected[..., 2], inverse[..., 0, 0].sqrt())
    close("projection", projected[..., 3], inverse[..., 0, 1] / inverse[..., 0, 0].sqrt())


@pytest.mark.parametrize("slot", [0, 1])
def test_a_mean_whose_pixel_overflows_is_culled(device, slot):
    """Its depth is fine and so is the other coordinate."""
    gaussians, cam = facing(2, device=device)
    gaussians.means[1, slot], gaussians.means[1, 2] = 3e38, 0.02
    projected, counts = run(gaussians, cam)
    assert counts.tolist() == [[1, 0]] and not bool(projected[0, 1].any())


@pytest.mark.parametrize(("axis", "log_scale"), [(0, 88.0), (1, 88.0), (2, 89.0), (0, 100.0)])
def test_one_axis_that_overflows_culls(device, axis, log_scale):
    """The mean lies in the image, beside it along one side, or beyond a corner."""
    gaussians, cam = facing(2, device=device)
    gaussians.log_scales[1, axis] = log_scale
    projected, counts = run(gaussians, cam)
    assert counts.tolist() == [[1, 0]] and not bool(projected[0, 1].any())


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


def test_quaternions_up_to_the_shortest_and_longest(device, dtype):
    """The shortest length itself gives a rotation, a shorter one does not; likewise for the longest."""
    gaussians, cam = facing(5, dtype, device)
    shortest = torch.tensor(SHORTEST_QUAT, dtype=dtype)
    gaussians.quats[:, 0] = torch.stack(
        [shortest, torch.nextafter(shortest, 0 * shortest), 0.999 / shortest, 1.001 / shortest, shortest**0]
    )
    assert (run(gaussians, cam)[1] > 0).tolist() == [[True, False, True, False, True]]


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


def test_an_opacity_equal_to_the_cut_is_drawn_and_none_is_not(device, dtype):
    """sigmoid(0) is 1/2 to the bit; an opacity that rounds to 0 is culled even without a cut."""
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


def test_tiles_have_16_px_unless_it_is_said(device):
    """An image of 17 px has two columns and two rows of them."""
    gaussians, cam = facing(1, device=device, size=17)
    gaussians.log_scales.add_(6.0)
    assert run(gaussians, cam)[1].tolist() == [[4]]


def test_a_colour_of_exactly_zero_has_no_gradient():
    """The clamp begins at zero: its slope there is that of the flat side; just above it is one.

    On a CPU, whose rounding of the product makes it zero to the bit.
    """
    gaussians, cam = facing(2, torch.float64)
    gaussians.sh[:, 1:] = 0
    gaussians.sh[0, 0], gaussians.sh[1, 0] = -0.5 / C0, (1e-9 - 0.5) / C0
    moving = leaves(gaussians)
    projected, _ = run(moving, cam)
    projected[..., 6:9].sum().backward()
    assert not bool(projected[0, 0, 6:9].any()) and bool((projected[0, 1, 6:9] > 0).all())
    assert not bool(moving.sh.grad[0].any()) and bool((moving.sh.grad[1, 0] != 0).all())


def boxes(rule, device):
    """Half sides of the box in float64, and the covariances, of a cloud seen by two cameras."""
    gaussians, cam = cloud(200, torch.float64, device), camera(400, 300, cameras=2, device=device)
    projected, counts = run(gaussians, cam, rule)
    plain = [t.cpu() for t in gaussians.tensors().values()]
    *_, opacities = reference_result = project_reference(
        *plain, cam.viewmat.cpu(), cam.K.cpu(), width=400, height=300, degree=1, low_pass=rule.low_pass
    )
    seen = counts.cpu() > 0
    assert int(seen.sum()) > 100
    return projected.cpu()[seen][:, 10:], reference_result[1][seen], opacities.expand(2, -1)[seen]


def test_boxes_reach_to_the_cut(device):
    """Half sides are the reach, at which alpha is the cut, times the standard deviations."""
    found, covs, opacities = boxes(EXACT, device)
    reach = (2 * torch.log(opacities / EXACT.alpha_cut)).sqrt()
    wanted = reach[:, None] * torch.stack([covs[:, 0, 0], covs[:, 1, 1]], -1).sqrt()
    assert bool((found >= wanted).all()) and bool((found <= wanted * (1 + 1e-3)).all())


def test_squares_are_three_sigma_rounded_up(device):
    """The classic rule: three times the longest standard deviation, a whole number of pixels."""
    found, covs, _ = boxes(RULES["inria"], device)
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


def test_no_cut_asks_for_every_tile_however_far(device):
    """Half sides without a cut cover any image."""
    gaussians, cam = facing(1, device=device)
    projected, counts = run(gaussians, cam, SMOOTH, window=(0, 0, 16, 16))
    assert bool((projected[0, :, 10:] >= 1e30).all()) and counts.tolist() == [[1]]


def test_image_and_coefficients_may_be_the_smallest():
    """One pixel by one; exactly as many coefficients as the degree needs."""
    gaussians = cloud(3, degree=1)
    one = camera(1, 1, cameras=1, dtype=torch.float32)
    assert run(gaussians, one, SMOOTH)[0].shape == (1, 3, 12)
    for width, height in ((0, 5), (5, 0)):
        with pytest.raises(ValueError, match="at least 1 x 1 px"):
            run(gaussians, dataclasses.replace(one, width=width, height=height))


@pytest.mark.parametrize("wanted", ["viewmats", "Ks"])
def test_one_gradient_of_the_camera_may_be_asked_for_alone(device, wanted):
    """Camera gradients that are not needed are None."""
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
    _, _, colors, _, _ = project_reference(
        *other.tensors().values(), cam.viewmat.cpu(), cam.K.cpu(), width=18, height=17, degree=3, low_pass=SMOOTH.low_pass
    )
    close("projection", projected[..., 6:9], colors)
    projected[..., 6:9].square().sum().backward()
    colors.square().sum().backward()
    close("gradient", moving.means.grad, other.means.grad)


def test_one_gaussian_takes_its_factor(device):
    """It holds for a single Gaussian, too, with half of its opacity, or none."""
    gaussians, cam = facing(1, device=device)
    full = run(gaussians, cam, SMOOTH)[0][0, 0, 5]
    for factor in (0.5, 1.0):
        found = run(gaussians, cam, SMOOTH, opacity_factors=torch.tensor([factor], device=device))[0][0, 0, 5]
        assert float(found) == factor * float(full)
    assert run(gaussians, cam, SMOOTH, opacity_factors=torch.zeros(1, device=device))[1].tolist() == [[0]]


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_unseen_gaussians_have_zero_gradients(device, degree):
    """Memory full of NaN is overwritten for rows of every length, of Gaussians seen by one camera, both or none."""
    gaussians, cam = cloud(300, torch.float32, device, degree=degree), camera(cameras=2, dtype=torch.float32, device=device)
    gaussians.means[::3, 2] = -4.0
    gaussians.means[130:260, 0] += 2.2
    exact = Gaussians(**{n: t.cpu().double() for n, t in gaussians.tensors().items()})
    results = []
    torch.use_deterministic_algorithms(True)  # torch then fills what it allocates
    try:
        wide = dataclasses.replace(cam, viewmat=cam.viewmat.cpu().double(), K=cam.K.cpu().double())
        for g, view in ((gaussians, cam), (exact, wide)):
            moving = leaves(g)
            projected, counts = run(moving, view, degree=degree)
            weights = torch.linspace(0.5, 1.5, 9).to(projected)
            (projected[..., :9].square() * weights).sum().backward()
            results.append((counts.cpu(), [t.grad.cpu() for t in moving.tensors().values()]))
    finally:
        torch.use_deterministic_algorithms(False)
    (counts, found), (_, wanted) = results
    seen = (counts > 0).sum(0)
    assert set(seen.tolist()) == {0, 1, 2}
    for a, b in zip(found, wanted, strict=True):
        assert not bool(a[seen == 0].any())
        assert float((a.double() - b).norm()) <= 1e-4 * float(b.norm())


@pytest.mark.parametrize("degree", [0, 1, 2, 3, 4])
def test_colour_gradients_of_every_degree(device, degree):
    """Rows of coefficients that are a multiple of 16 bytes long and such that are not: as in float64, one camera or two."""
    for cameras in (1, 2):
        found = {}
        for kind, where in ((torch.float32, device), (torch.float64, torch.device("cpu"))):
            g, cam = leaves(cloud(60, kind, where, degree=degree)), camera(40, 30, cameras=cameras, dtype=kind, device=where)
            projected, _ = project(*g.tensors().values(), cam.viewmat, cam.K, width=40, height=30, degree=degree, rule=EXACT)
            upstream = torch.linspace(-1, 1, projected.numel(), dtype=kind, device=where).view(projected.shape)
            upstream[..., 9:] = 0
            found[kind] = torch.autograd.grad((projected * upstream).sum(), [g.sh, g.means])
        for single, double in zip(found[torch.float32], found[torch.float64], strict=True):
            close("gradient", single, double)
