"""Compositing of any number of channels: against a product of matrices, calls of three channels, and finite differences."""

from types import SimpleNamespace

import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, hand_placed
from tests.reference.blend_channels import blend_channels_reference
from tests.reference.project import project_reference
from tests.tolerances import close
from warpgs.constants import RULES
from warpgs.kernels.blend import _width, blend, blend_channels, width_of
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles


def random(*shape, seed=0, like):
    """Numbers of either sign, well beyond [0, 1]."""
    numbers = torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    return (3 * numbers).to(like.device, like.dtype)


def binned(gaussians, cam, rule):
    """Return projected Gaussians, which require gradients, their tiles, and what blending takes by name."""
    size = {"width": cam.width, "height": cam.height, "rule": rule}
    projected, counts = project(*(t.detach() for t in gaussians.tensors().values()), cam.viewmat, cam.K, **size, degree=1)
    return projected.requires_grad_(), bin_tiles(projected.detach(), counts, **size), size


def test_image_and_gradients_equal_reference(device, dtype):
    """Seven signed channels, alpha and depth of two cameras, and gradients of Gaussians, channels and backgrounds."""
    gaussians, cam = hand_placed(dtype, device), camera(33, 21, cameras=2, dtype=dtype, device=device)
    colors, behind = random(2, 6, 7, like=gaussians.means), random(2, 7, seed=1, like=gaussians.means)
    found_leaves = [t.clone().requires_grad_() for t in (*gaussians.tensors().values(), colors, behind)]
    wanted_leaves = [t.detach().cpu().double().requires_grad_() for t in found_leaves]
    size = {"width": 33, "height": 21, "rule": RULES["exact"]}
    projected, counts = project(*found_leaves[:5], cam.viewmat, cam.K, **size, degree=1)
    found = blend_channels(projected, bin_tiles(projected, counts, **size), *found_leaves[5:], **size)
    viewmats, Ks = (t.cpu().double() for t in (cam.viewmat, cam.K))
    means, covs, _, depths, opacities = project_reference(
        *wanted_leaves[:5], viewmats, Ks, width=33, height=21, degree=1, low_pass=RULES["exact"].low_pass
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
def test_gradcheck(device, channels):
    """Finite differences agree for every value of a projected Gaussian but its colour and box, channels and backgrounds."""
    cam = camera(9, 8, cameras=1, device=device)
    projected, tiles, size = binned(hand_placed(device=device), cam, SMOOTH)
    record = projected.detach()
    colors, behind = random(1, 6, channels, like=record), random(1, channels, seed=1, like=record)

    def images(geometry, depth, values, backgrounds):
        whole = torch.cat([geometry, record[..., 6:9], depth, record[..., 10:]], -1)
        return blend_channels(whole, tiles, values, backgrounds, **size)

    inputs = [t.clone().requires_grad_() for t in (record[..., :6], record[..., 9:10], colors, behind)]
    assert torch.autograd.gradcheck(images, inputs, eps=1e-6, atol=1e-7, rtol=1e-5, nondet_tol=0.0)


@pytest.mark.parametrize("channels", [3, 8, *(pytest.param(d, marks=pytest.mark.slow) for d in (1, 5, 32))])
def test_channels_are_the_bits_of_calls_of_three(device, dtype, channels):
    """Image, alpha, depth and the gradient of channels and backgrounds; the other gradients are the sums over the calls."""
    gaussians, cam = cloud(400, dtype, device), camera(75, 53, cameras=2, dtype=dtype, device=device)
    projected, tiles, size = binned(gaussians, cam, RULES["exact"])
    colors = random(2, 400, channels, like=projected).requires_grad_()
    behind = random(2, channels, seed=1, like=projected).requires_grad_()
    upstream = random(2, 53, 75, channels, seed=2, like=projected)
    image, alpha, depth = blend_channels(projected, tiles, colors, behind, **size)
    v_depth = random(2, 53, 75, seed=3, like=projected)
    found = torch.autograd.grad([image, depth], [projected, colors, behind], [upstream, v_depth])
    geometry = torch.zeros_like(projected)
    for first in range(0, channels, 3):
        part, count = slice(first, min(first + 3, channels)), min(3, channels - first)
        record, three = projected.detach().clone(), projected.new_zeros(2, 3)
        record[..., 6:9], three[:, :count] = 0, behind.detach()[:, part]
        record[..., 6 : 6 + count] = colors.detach()[..., part]
        own = [record.requires_grad_(), three.requires_grad_()]
        rgb, *others = blend(own[0], tiles, own[1], **size)
        assert torch.equal(image[..., part], rgb[..., :count])
        assert torch.equal(alpha, others[0]) and torch.equal(depth, others[1])
        v_rgb = torch.zeros_like(rgb)
        v_rgb[..., :count] = upstream[..., part]
        # as many outputs each time: on CUDA a gradient of depth asks for another kernel
        gradients = [v_rgb, v_depth if first == 0 else torch.zeros_like(v_depth)]
        v_record, v_three = torch.autograd.grad([rgb, others[1]], own, gradients)
        assert torch.equal(found[1][..., part], v_record[..., 6 : 6 + count])
        assert torch.equal(found[2][:, part], v_three[:, :count])
        v_record[..., 6:9] = 0
        geometry += v_record
    if channels <= 3:
        assert torch.equal(found[0], geometry)
    close("gradient", found[0], geometry)


@pytest.mark.parametrize(("channels", "width"), [(1, 3), (3, 3), (4, 7), (8, 11), (12, 7), (16, 11), (32, 11), (64, 11)])
def test_passes_are_as_few_and_as_narrow_as_can_be(channels, width):
    """Channels of a pass, by the number of channels."""
    assert width_of(channels) == width


@pytest.mark.parametrize(
    ("is_cuda", "dtype", "absgrad", "width"),
    [
        (True, torch.float64, False, 3),
        (True, torch.float64, True, 11),
        (True, torch.float32, False, 11),
        (False, torch.float64, False, 11),
    ],
)
def test_float64_on_cuda_takes_narrow_passes(is_cuda, dtype, absgrad, width):
    """Its local memory grows with the width; magnitudes of gradients need one pass."""
    assert _width(SimpleNamespace(is_cuda=is_cuda, dtype=dtype), 11, absgrad) == width


def test_channels_of_all_cameras_share_their_gradient(device):
    """Channels [1, N, D] are those of every camera, and their gradient is the sum."""
    cam = camera(40, 30, cameras=3, dtype=torch.float32, device=device)
    projected, tiles, size = binned(cloud(100, device=device), cam, RULES["exact"])
    colors, behind = random(1, 100, 4, like=projected).requires_grad_(), random(3, 4, like=projected)
    each = colors.detach().expand(3, -1, -1).clone().requires_grad_()
    images = [blend_channels(projected, tiles, c, behind, **size)[0] for c in (colors, each)]
    assert torch.equal(*images)
    one, three = (torch.autograd.grad(i.square().sum(), c)[0] for i, c in zip(images, (colors, each)))
    assert torch.equal(one, three.sum(0, keepdim=True))


def test_images_without_a_gradient_have_none(device):
    """A loss of alpha and depth alone leaves channels and backgrounds a gradient of zero."""
    cam = camera(40, 30, cameras=1, dtype=torch.float32, device=device)
    projected, tiles, size = binned(cloud(100, device=device), cam, RULES["exact"])
    colors, behind = random(1, 100, 4, like=projected).requires_grad_(), random(1, 4, like=projected).requires_grad_()
    _, alpha, depth = blend_channels(projected, tiles, colors, behind, **size)
    found = torch.autograd.grad(alpha.sum() + depth.sum(), [projected, colors, behind])
    _, alpha, depth = blend(projected, tiles, projected.new_zeros(1, 3), **size)
    assert torch.equal(found[0], torch.autograd.grad(alpha.sum() + depth.sum(), projected)[0])
    assert found[1].shape == (1, 100, 4) and not bool(found[1].any()) and not bool(found[2].any())


def test_no_gaussians_show_the_background(device, dtype):
    """Exactly the background, and gradients of the right shape."""
    cam = camera(20, 10, cameras=2, dtype=dtype, device=device)
    projected, tiles, size = binned(cloud(0, dtype, device), cam, RULES["exact"])
    colors, behind = projected.new_zeros(1, 0, 5).requires_grad_(), random(2, 5, like=projected).requires_grad_()
    image, alpha, _ = blend_channels(projected, tiles, colors, behind, **size)
    assert torch.equal(image, behind[:, None, None].expand(2, 10, 20, 5)) and not bool(alpha.any())
    v_colors, v_behind = torch.autograd.grad(image.sum(), [colors, behind])
    assert v_colors.shape == (1, 0, 5) and bool((v_behind == 200).all())


def test_wrong_shapes_are_refused():
    """Another number of Gaussians, cameras or background channels, and none at all."""
    projected, tiles, size = binned(cloud(5), camera(40, 30, cameras=2, dtype=torch.float32), RULES["exact"])
    for colors, behind, words in [
        (torch.zeros(2, 4, 7), torch.zeros(2, 7), r"colors must have shape \[C, N, D\]"),
        (torch.zeros(3, 5, 7), torch.zeros(2, 7), r"colors must have shape \[C, N, D\]"),
        (torch.zeros(2, 5, 7), torch.zeros(2, 3), r"backgrounds must have shape \[C, D\]"),
        (torch.zeros(2, 5, 0), torch.zeros(2, 0), "at least one channel"),
    ]:
        with pytest.raises(ValueError, match=words):
            blend_channels(projected, tiles, colors, behind, **size)
    with pytest.raises(TypeError, match=r"colors is torch\.float64 but projected is torch\.float32"):
        blend_channels(projected, tiles, torch.zeros(2, 5, 7).double(), torch.zeros(2, 7), **size)
