"""Compositing against a plain loop over Gaussians: colours, any number of channels, gradients, rules, repeatability."""

import dataclasses

import pytest
import torch

from bench.lib.kernel_calls import bin_tiles, blend, blend_channels, contributions, project
from tests.gaussians import SMOOTH, camera, cloud, hand_placed, leaves
from tests.reference.blend import blend_channels_reference, blend_reference
from tests.reference.project import project_reference
from tests.tolerances import close
from warpgs.constants import RULES
from warpgs.kernels.blend import composite
from warpgs.kernels.falloff import Pass
from warpgs.kernels.tiles import Tiles

EXACT = RULES["exact"]


def drawn(gaussians, cam, background, rule, tile_size=16, degree=1):
    size = {"width": cam.width, "height": cam.height}
    projected, counts = project(
        *gaussians.tensors().values(), cam.viewmat, cam.K, **size, degree=degree, rule=rule, tile_size=tile_size
    )
    tiles = bin_tiles(projected, counts, **size, tile_size=tile_size, rule=rule)
    return *blend(projected, tiles, background, **size, rule=rule), projected, tiles


def reference_images(tensors, cam, background, rule, tile_size=16, degree=1):
    """Return the same images by the references, stacked over cameras, and the weights [C, N, H, W]."""
    *gaussians, viewmats, Ks = tensors
    means, covs, colors, depths, opacities = project_reference(
        *gaussians, viewmats, Ks, width=cam.width, height=cam.height, degree=degree, low_pass=rule.low_pass
    )
    rows = [
        blend_reference(
            means[c], covs[c], opacities, colors[c], depths[c], background[c], cam.width, cam.height, rule, tile_size=tile_size
        )
        for c in range(len(viewmats))
    ]
    return [torch.stack(t) for t in zip(*rows)]


def doubles(gaussians, cam):
    return [t.detach().cpu().double().requires_grad_() for t in (*gaussians.tensors().values(), cam.viewmat, cam.K)]


def backgrounds(count, dtype, device):
    return torch.rand(count, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64).to(device, dtype)


SMALL_TILES = [pytest.param(8, rule, marks=pytest.mark.slow) for rule in ("exact", "gsplat-1.5", "smooth")]


@pytest.mark.parametrize(
    ("tile_size", "rule"), [*((16, r) for r in ("exact", "gsplat-1.5", "inria", "smooth")), (8, "inria"), *SMALL_TILES]
)
def test_pictures_and_gradients_equal_reference(device, dtype, rule, tile_size):
    rule = SMOOTH if rule == "smooth" else RULES[rule]
    gaussians, cam = leaves(hand_placed(dtype, device)), camera(33, 21, cameras=2, dtype=dtype, device=device)
    background = backgrounds(2, dtype, device).requires_grad_()
    other = doubles(gaussians, cam)
    other_background = background.detach().cpu().double().requires_grad_()
    rgb, alpha, depth, _, _ = drawn(gaussians, cam, background, rule, tile_size, degree=3)
    wanted = reference_images(other, cam, other_background, rule, tile_size, degree=3)
    for found, reference in zip((rgb, alpha, depth), wanted):
        close("image", found, reference)
    upstream = [torch.randn(t.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64) for t in wanted[:3]]
    sum((a * u.to(a)).sum() for a, u in zip((rgb, alpha, depth), upstream)).backward()
    sum((a * u).sum() for a, u in zip(wanted, upstream)).backward()
    for t, reference_leaf in zip((*gaussians.tensors().values(), background), (*other[:5], other_background)):
        assert bool(t.grad.any())
        close("gradient", t.grad, reference_leaf.grad)


@pytest.mark.parametrize("given", ["rgb", "rgb alpha", "rgb depth", "alpha", "depth"])
@pytest.mark.parametrize(("tile_size", "absgrad"), [(16, False), (16, True), (8, False)])
def test_gradients_of_some_images(device, dtype, tile_size, absgrad, given):
    """Colour alone runs a kernel without depth and alpha: the bits are those of gradients of zero for what is not given."""
    gaussians, cam = hand_placed(dtype, device), camera(33, 21, cameras=2, dtype=dtype, device=device)
    background = backgrounds(2, dtype, device)
    *_, record, tiles = drawn(gaussians, cam, background, SMOOTH, tile_size, degree=3)
    record, size = record.detach().requires_grad_(), {"width": 33, "height": 21, "rule": SMOOTH, "absgrad": absgrad}
    images = dict(zip(("rgb", "alpha", "depth"), blend(record, tiles, background, **size)))
    generator = torch.Generator().manual_seed(7)
    upstream = {n: torch.randn(i.shape, generator=generator, dtype=torch.float64).to(i) for n, i in images.items()}
    own = given.split()
    (found,) = torch.autograd.grad([images[n] for n in own], record, [upstream[n] for n in own], retain_graph=True)
    (whole,) = torch.autograd.grad(list(images.values()), record, [upstream[n] * (n in own) for n in images])
    assert bool(found[..., :6].any())
    assert bool(found[..., 6:9].any()) == ("rgb" in own) and bool(found[..., 9].any()) == ("depth" in own)
    if device.type == "cpu":
        assert torch.equal(found, whole)
    close("gradient", found, whole)
    if absgrad:
        assert bool((found[..., 10:] * (1 + 1e-5) >= found[..., :2].abs()).all()) and bool(found[..., 10:].any())


@pytest.mark.parametrize("cameras", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_gradcheck(device, cameras):
    gaussians, cam = hand_placed(device=device), camera(cameras=cameras, device=device)
    size = {"width": cam.width, "height": cam.height}
    background = backgrounds(cameras, torch.float64, device).requires_grad_()
    projected, counts = project(*gaussians.tensors().values(), cam.viewmat, cam.K, **size, degree=3, rule=SMOOTH)
    tiles = bin_tiles(projected, counts, **size, rule=SMOOTH)
    tail = projected[..., 10:].detach()

    def images(record, behind):
        return blend(torch.cat([record, tail], -1), tiles, behind, **size, rule=SMOOTH)

    record = projected[..., :10].detach().clone().requires_grad_()
    assert torch.autograd.gradcheck(images, (record, background), eps=1e-6, atol=1e-7, rtol=1e-5, nondet_tol=0.0)


def stack_of(opacities, dtype=torch.float64, device="cpu"):
    """Huge white Gaussians one behind another that cover the whole image, with the given opacities."""
    gaussians = cloud(len(opacities), dtype, device, degree=0)
    gaussians.means[:] = 0
    gaussians.means[:, 2] = torch.arange(len(opacities)) * 0.1 + 2
    gaussians.log_scales[:] = 8.0
    gaussians.logit_opacities[:] = torch.logit(torch.tensor(opacities, dtype=torch.float64))
    gaussians.sh[:] = 2.0
    return gaussians


def test_contributions_are_the_weights(device, dtype):
    gaussians, cam = cloud(60, dtype, device), camera(40, 30, cameras=2, dtype=dtype, device=device)
    rule = dataclasses.replace(EXACT, alpha_cut=0.0)
    background = backgrounds(2, dtype, device)
    *_, projected, tiles = drawn(gaussians, cam, background, rule)
    sums, maxima = contributions(projected, tiles, width=40, height=30, rule=rule)
    weights = reference_images(doubles(gaussians, cam), cam, background.cpu().double(), rule)[3]
    close("gradient", sums, weights.sum((2, 3)))
    close("gradient", maxima, weights.amax((2, 3)))


@pytest.mark.cuda
@pytest.mark.parametrize("tile_size", [8, 16])
def test_blocks_per_warp_change_no_bit(tile_size):
    gaussians, cam = cloud(400, torch.float32, "cuda:0"), camera(77, 45, cameras=2, dtype=torch.float32, device="cuda:0")
    size, rule = {"width": cam.width, "height": cam.height}, EXACT
    tensors = gaussians.tensors().values()
    projected, counts = project(*tensors, cam.viewmat, cam.K, **size, degree=1, rule=rule, tile_size=tile_size)
    tiles = bin_tiles(projected, counts, **size, rule=rule, tile_size=tile_size)
    found = []
    for visible in (1, len(tiles.gaussian_ids)):  # many tiles to a Gaussian, and one
        some = dataclasses.replace(tiles, visible=visible)
        settings = Pass((cam.width, cam.height), (0, 0, cam.width, cam.height), rule)
        found.append(composite(projected, some, torch.full((2, 3), 0.3, device="cuda:0"), settings, save=True))
    for one, other in zip(*(f[:6] for f in found)):
        assert torch.equal(one, other)


def test_both_passes_see_the_same_alpha(device):
    """Each of many Gaussians has a pixel whose alpha is within roundings of the cut: none is drawn in one pass alone."""
    count, side, rule = 4000, 16, EXACT
    generator = torch.Generator().manual_seed(0)

    def rand(*shape):
        return torch.rand(*shape, generator=generator)

    projected = torch.ones(count, 1, 12)
    projected[..., 0:2] = rand(count, 1, 2) * side
    projected[..., 2:5] = rand(count, 1, 3) * 0.6 + 0.2
    projected[..., 10:] = 100
    mx, my, u11, u12, u22 = projected[:, 0, :5].double().unbind(-1)
    dx = torch.floor(mx) + 0.5 - mx + 1
    dy = torch.floor(my) + 0.5 - my + 1
    q = 0.5 * ((u11 * dx + u12 * dy) ** 2 + (u22 * dy) ** 2)
    projected[:, 0, 5] = (rule.alpha_cut * torch.exp(q) * (1 + 6e-7 * (rand(count).double() - 0.5))).float()
    projected = projected.to(device).requires_grad_()
    numbers = torch.arange(count, dtype=torch.int32, device=device)
    ranges, one = torch.stack([numbers, numbers + 1], 1), torch.ones_like(numbers)
    tiles = Tiles(side, ranges, numbers, numbers, numbers, one, numbers, torch.tensor([count], device=device))
    rgb = blend(projected, tiles, torch.zeros(count, 3, device=device), width=side, height=side, rule=rule)[0]
    rgb.sum().backward()
    forward, backward = rgb[..., 0].detach().double().sum((1, 2)), projected.grad[:, 0, 6].double()
    assert bool((forward > 0).sum() > count / 2)
    assert float((forward - backward).abs().max()) < 0.5 * rule.alpha_cut


def random(*shape, seed=0, like):
    numbers = torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (3 * numbers).to(like.device, like.dtype)


def binned(gaussians, cam, rule):
    size = {"width": cam.width, "height": cam.height, "rule": rule}
    projected, counts = project(*(t.detach() for t in gaussians.tensors().values()), cam.viewmat, cam.K, **size, degree=1)
    return projected.requires_grad_(), bin_tiles(projected.detach(), counts, **size), size


@pytest.mark.parametrize("channels", [7, 12, *(pytest.param(d, marks=pytest.mark.slow) for d in (1, 3, 32))])
def test_image_and_gradients_equal_reference(device, dtype, channels):
    """Of channels in one pass and in two."""
    gaussians, cam = hand_placed(dtype, device), camera(33, 21, cameras=2, dtype=dtype, device=device)
    colors, behind = random(2, 6, channels, like=gaussians.means), random(2, channels, seed=1, like=gaussians.means)
    found_leaves = [t.clone().requires_grad_() for t in (*gaussians.tensors().values(), colors, behind)]
    wanted_leaves = [t.detach().cpu().double().requires_grad_() for t in found_leaves]
    size = {"width": 33, "height": 21, "rule": EXACT}
    projected, counts = project(*found_leaves[:5], cam.viewmat, cam.K, **size, degree=1)
    found = blend_channels(projected, bin_tiles(projected, counts, **size), *found_leaves[5:], **size)
    viewmats, Ks = (t.cpu().double() for t in (cam.viewmat, cam.K))
    means, covs, _, depths, opacities = project_reference(
        *wanted_leaves[:5], viewmats, Ks, width=33, height=21, degree=1, low_pass=EXACT.low_pass
    )
    rows = [
        blend_channels_reference(means[c], covs[c], opacities, wanted_leaves[5][c], depths[c], wanted_leaves[6][c], **size)
        for c in range(2)
    ]
    wanted = [torch.stack(t) for t in zip(*rows)]
    upstream = [random(*t.shape, seed=2, like=t) for t in wanted]
    for a, b in zip(found, wanted):
        close("image", a, b)
    assert bool((found[0] < 0).any()) and bool((found[0] > 1).any())
    sum((a * u.to(a)).sum() for a, u in zip(found, upstream)).backward()
    sum((a * u).sum() for a, u in zip(wanted, upstream)).backward()
    for a, b in zip(found_leaves[:4] + found_leaves[5:], wanted_leaves[:4] + wanted_leaves[5:]):
        close("gradient", a.grad, b.grad)
    assert not bool(found_leaves[4].grad.any())


@pytest.mark.parametrize("channels", [2, *(pytest.param(d, marks=pytest.mark.slow) for d in (1, 5, 8, 32))])
def test_blend_channels_gradcheck(device, channels):
    cam = camera(9, 8, cameras=1, device=device)
    projected, tiles, size = binned(hand_placed(device=device), cam, SMOOTH)
    record = projected.detach()
    colors, behind = random(1, 6, channels, like=record), random(1, channels, seed=1, like=record)

    def images(geometry, depth, values, backgrounds):
        whole = torch.cat([geometry, record[..., 6:9], depth, record[..., 10:]], -1)
        return blend_channels(whole, tiles, values, backgrounds, **size)

    inputs = [t.clone().requires_grad_() for t in (record[..., :6], record[..., 9:10], colors, behind)]
    assert torch.autograd.gradcheck(images, inputs, eps=1e-6, atol=1e-7, rtol=1e-5, nondet_tol=0.0)


def test_channels_of_all_cameras_share_their_gradient_and_may_have_none(device):
    """Channels [1, N, D] are those of every camera; a loss of alpha and depth leaves channels and backgrounds one of zero."""
    cam = camera(40, 30, cameras=3, dtype=torch.float32, device=device)
    projected, tiles, size = binned(cloud(100, device=device), cam, EXACT)
    colors, behind = random(1, 100, 4, like=projected).requires_grad_(), random(3, 4, like=projected).requires_grad_()
    each = colors.detach().expand(3, -1, -1).clone().requires_grad_()
    images = [blend_channels(projected, tiles, c, behind, **size)[0] for c in (colors, each)]
    assert torch.equal(*images)
    one, three = (torch.autograd.grad(i.square().sum(), c)[0] for i, c in zip(images, (colors, each)))
    assert torch.equal(one, three.sum(0, keepdim=True))
    _, alpha, depth = blend_channels(projected, tiles, colors, behind, **size)
    found = torch.autograd.grad(alpha.sum() + depth.sum(), [projected, colors, behind])
    _, alpha, depth = blend(projected, tiles, projected.new_zeros(3, 3), **size)
    assert torch.equal(found[0], torch.autograd.grad(alpha.sum() + depth.sum(), projected)[0])
    assert found[1].shape == (1, 100, 4) and not bool(found[1].any()) and not bool(found[2].any())


def test_no_gaussians_show_the_background(device, dtype):
    projected, tiles, size = binned(cloud(0, dtype, device), camera(20, 10, cameras=2, dtype=dtype, device=device), EXACT)
    colors, behind = projected.new_zeros(1, 0, 5).requires_grad_(), random(2, 5, like=projected).requires_grad_()
    for image, alpha, depth in (
        blend(projected, tiles, behind[:, :3], **size),
        blend_channels(projected, tiles, colors, behind, **size),
    ):
        channels = image.shape[-1]
        assert torch.equal(image, behind[:, None, None, :channels].expand(2, 10, 20, channels))
        assert not bool(alpha.any()) and not bool(depth.any())
    v_colors, v_behind = torch.autograd.grad(image.sum(), [colors, behind])
    assert v_colors.shape == (1, 0, 5) and bool((v_behind == 200).all())
