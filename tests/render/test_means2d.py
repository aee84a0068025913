"""Gradients of the projected means, as density strategies read them: summed over pixels, and summed by magnitude."""

import copy
import pickle

import pytest
import torch

from tests.gaussians import camera, cloud, hand_placed, leaves
from warpgs.errors import UsageError
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize


def scalar(render):
    """A loss that reads all three images."""
    return render.rgb.square().sum() + render.alpha.square().sum() + 0.1 * render.depth.square().sum()


@pytest.mark.parametrize("colors", [None, 5], ids=["harmonics", "channels"])
def test_absgrad_sums_the_magnitude_of_each_pixels_gradient(device, colors):
    """Against one backward pass for each pixel, in float64; gradients stay the same.

    Where no channels are given, and on a CPU, they have the same bits. On CUDA float64 takes five channels in two passes, but
    magnitudes take one: sums differ by rounding.
    """
    gaussians, cam = leaves(hand_placed(device=device, degree=1)), camera(13, 11, cameras=2, device=device)
    values = None if colors is None else torch.randn(6, colors, generator=torch.Generator().manual_seed(0)).to(gaussians.means)
    found = []
    for absgrad in (False, True):
        r = rasterize(gaussians, cam, RasterizeOptions(absgrad=absgrad, colors=values))
        means2d = r.means2d
        v = torch.autograd.grad(scalar(r), list(gaussians.tensors().values()), retain_graph=True, allow_unused=True)
        found.append((means2d.grad, *(t for t in v if t is not None)))
    error = 1e-13 if device.type == "cuda" and colors else 0.0  # 143 pixels round by 2e-14 of the largest value at most
    assert all(float((a - b).abs().max()) <= error * float(a.abs().max()) for a, b in zip(*found))
    absgrad, images = means2d.absgrad, [r.rgb, r.alpha, r.depth]  # before further passes add to it
    upstream = torch.autograd.grad(scalar(r), images, retain_graph=True)
    total = torch.zeros_like(means2d)
    for y in range(11):
        for x in range(13):
            one = [torch.zeros_like(v) for v in upstream]
            for v, whole in zip(one, upstream):
                v[:, y, x] = whole[:, y, x]
            total += torch.autograd.grad(images, r.projected, one, retain_graph=True)[0][..., :2].abs()
    assert float((absgrad - total).norm()) <= 1e-12 * float(total.norm())  # measured: 3e-16
    assert bool((absgrad > 1.5 * found[1][0].abs()).any())  # signs cancel in the plain sum


@pytest.mark.parametrize(
    "options", [{"max_instances": 60}, {"tile_size": 8}, {"deterministic": False}], ids=lambda o: next(iter(o))
)
def test_absgrad_does_not_depend_on_how_it_is_rendered(device, options):
    """In chunks, by other tiles, and by atomic sums on CUDA."""
    gaussians, cam = cloud(200, device=device), camera(75, 53, dtype=torch.float32, device=device)
    found = []
    for more in ({}, options):
        r = rasterize(leaves(gaussians), cam, RasterizeOptions(absgrad=True, **more))
        means2d = r.means2d
        scalar(r).backward()
        found.append(means2d.absgrad)
    assert float((found[0] - found[1]).norm()) <= 1e-5 * float(found[0].norm())


def test_a_strategy_holds_the_projected_means():
    """``retain_grad`` and ``grad`` work as in the graph; two backward passes add up; ``absgrad`` is there only on request."""
    r = rasterize(leaves(cloud(50)), camera(dtype=torch.float32))
    means2d = r.means2d
    means2d.retain_grad()
    r.projected.retain_grad()
    assert means2d.shape == (1, 50, 2) and means2d is r.means2d and means2d.grad is None
    r.rgb.sum().backward(retain_graph=True)
    once = means2d.grad.clone()
    r.rgb.sum().backward()
    assert bool(once.any()) and torch.equal(means2d.grad, 2 * once) and torch.equal(means2d.grad, r.projected.grad[..., :2])
    assert not hasattr(means2d, "absgrad")
    assert torch.equal(means2d.detach(), r.projected.detach()[..., :2])


def test_means2d_after_the_backward_pass_is_an_error():
    """Its gradients are gone; a render that was not read yet may be read after a pass through another one."""
    gaussians, cam = leaves(cloud(50)), camera(dtype=torch.float32)
    r, other = rasterize(gaussians, cam), rasterize(gaussians, cam)
    r.rgb.sum().backward()
    for _ in range(2):
        with pytest.raises(UsageError, match=r"read render\.means2d before the backward pass"):
            _ = r.means2d
    means2d = other.means2d
    other.rgb.sum().backward()
    assert bool(means2d.grad.any()) and other.means2d is means2d


def test_a_missing_absgrad_names_the_option():
    """Where the option is off, and before the backward pass; means are plain tensors in other operations."""
    for options in (RasterizeOptions(), RasterizeOptions(absgrad=True)):
        means2d = rasterize(leaves(cloud(5)), camera(dtype=torch.float32), options).means2d
        with pytest.raises(AttributeError, match=r"RasterizeOptions\(absgrad=True\) and a backward pass"):
            _ = means2d.absgrad
        with pytest.raises(AttributeError, match="has no attribute 'other'"):
            _ = means2d.other
        assert type(means2d + 1) is type(means2d.detach()) is torch.Tensor


def test_without_gradients_means2d_is_plain():
    """No gradient to hold where none is recorded."""
    with torch.no_grad():
        r = rasterize(leaves(cloud(5)), camera(dtype=torch.float32))
    assert not r.means2d.requires_grad


def test_absgrad_takes_one_pass():
    """Magnitudes of several passes do not add up to that of their sum."""
    gaussians, cam = cloud(5), camera(dtype=torch.float32)
    for options in ({"features": torch.ones(5, 2)}, {"colors": torch.ones(5, 12)}):
        with pytest.raises(UsageError, match="absgrad supports at most 11 channels of colors, and no features"):
            rasterize(gaussians, cam, RasterizeOptions(absgrad=True, **options))


@pytest.mark.parametrize("absgrad", [False, True])
@pytest.mark.filterwarnings("error")
def test_means_can_be_copied_and_pickled(absgrad):
    """Before and after the backward pass. A copy has memory of its own; like any tensor, a pickled one leaves out ``grad``."""
    gaussians, cam = leaves(hand_placed()), camera(13, 11)
    render = rasterize(gaussians, cam, RasterizeOptions(absgrad=absgrad))
    means2d = render.means2d
    for backward in (False, True):
        if backward:
            render.rgb.sum().backward()
        copied, loaded = copy.deepcopy(means2d), pickle.loads(pickle.dumps(means2d))
        for other in (copied, loaded):
            assert type(other) is type(means2d) and torch.equal(other, means2d) and other.data_ptr() != means2d.data_ptr()
            assert not other.requires_grad
            if absgrad and backward:
                assert torch.equal(other.absgrad, means2d.absgrad) and other.absgrad.data_ptr() != means2d.absgrad.data_ptr()
            else:
                with pytest.raises(AttributeError, match="absgrad"):
                    other.absgrad  # noqa: B018
        assert (copied.grad is not None) == backward
        assert not backward or (torch.equal(copied.grad, means2d.grad) and copied.grad.data_ptr() != means2d.grad.data_ptr())
    both = copy.deepcopy([means2d, means2d])
    assert both[0] is both[1]
