"""Channels of the user: instead of the spherical harmonics' colours, beside them, in windows and in chunks."""

import numpy as np
import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, leaves
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

SIZE = (75, 53)  # no multiple of a tile


def random(*shape, seed=0, dtype=torch.float32, device="cpu"):
    """Numbers of either sign, well beyond [0, 1]."""
    return (3 * torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)).to(device, dtype)


def scene(dtype, device, channels):
    """A cloud, two cameras, channels of each Gaussian and their backgrounds."""
    how = {"dtype": dtype, "device": device}
    values, behind = random(400, channels, **how), random(2, channels, seed=1, **how)
    return cloud(400, dtype, device), camera(*SIZE, cameras=2, **how), values, behind


def test_the_own_colors_as_channels_give_the_same_image(device, dtype):
    """What the spherical harmonics gave, handed in as colours of each camera: every bit of image and gradients."""
    gaussians, cam, _, behind = scene(dtype, device, 3)
    found = []
    for own in (False, True):
        g = leaves(gaussians)
        colors = rasterize(gaussians, cam).projected[..., 6:9].detach().requires_grad_() if own else None
        r = rasterize(g, cam, RasterizeOptions(background=behind, colors=colors))
        r.projected.retain_grad()
        (r.rgb.square().sum() + r.depth.sum()).backward()
        v_colors = colors.grad if own else r.projected.grad[..., 6:9]
        gradients = [t.grad for n, t in g.tensors().items() if n not in ("sh", "means")]  # means colour the view, too
        found.append([r.rgb, r.alpha, r.depth, v_colors, *gradients])
        assert bool(g.sh.grad.any()) is not own
    assert all(torch.equal(a, b) for a, b in zip(*found))


def test_features_beside_colors_change_nothing_of_them(device):
    """Colours keep their bits, features are the image of a call with them as colours, and gradients are the sum of both."""
    gaussians, cam, values, behind = scene(torch.float32, device, 5)
    plain = rasterize(gaussians, cam)
    alone = rasterize(gaussians, cam, RasterizeOptions(colors=values, background=behind))
    options = RasterizeOptions(features=values, feature_background=behind)
    both = rasterize(gaussians, cam, options)
    assert plain.features is None and alone.rgb.shape == both.features.shape == (2, *SIZE[::-1], 5)
    for name in ("rgb", "alpha", "depth"):
        assert torch.equal(getattr(both, name), getattr(plain, name)), name
    assert torch.equal(both.features, alone.rgb) and bool((alone.rgb < 0).any())
    gradients = []
    for use in ((True, False), (False, True), (True, True)):
        g = leaves(gaussians)
        r = rasterize(g, cam, options)
        images = [image for image, used in zip((r.rgb, r.features), use) if used]
        gradients.append(torch.autograd.grad(sum(i.square().sum() for i in images), list(g.tensors().values())))
    for a, b, whole in zip(*gradients):
        assert float((a + b - whole).norm()) <= 1e-5 * float(whole.norm())


def test_one_camera_has_no_leading_axis():
    """Channels [N, D], or [1, N, D] of the one camera; the background may be an array."""
    gaussians, cam, values, behind = scene(torch.float32, "cpu", 4)
    one = Camera(cam.viewmat[1], cam.K[1], *SIZE)
    r = rasterize(gaussians, one, RasterizeOptions(colors=values, background=behind[1].numpy(), features=values[None]))
    batch = rasterize(gaussians, cam, RasterizeOptions(colors=values, background=behind, features=values))
    assert torch.equal(r.rgb, batch.rgb[1]) and torch.equal(r.features, batch.features[1])


@pytest.mark.cuda
@pytest.mark.parametrize("channels", [1, 2, 3, 5, 8, 32])
def test_native_kernels_agree_with_generic_ones(channels):
    """Float32 on CUDA against float64: images and gradients within 1e-5, the same bits each time."""
    device = torch.device("cuda", 0)
    gaussians, cam, values, behind = scene(torch.float32, device, channels)
    results = []
    for dtype in (torch.float32, torch.float32, torch.float64):
        g = Gaussians(**{n: t.detach().to(dtype).requires_grad_() for n, t in gaussians.tensors().items()})
        own = [values.to(dtype).requires_grad_(), behind.to(dtype).requires_grad_()]
        view = Camera(cam.viewmat.to(dtype), cam.K.to(dtype), *SIZE)
        r = rasterize(g, view, RasterizeOptions(rule=SMOOTH, features=own[0], feature_background=own[1]))
        loss = (r.features * random(*r.features.shape, seed=2, dtype=dtype, device=device)).sum() + r.rgb.square().sum()
        results.append((r.rgb.detach(), r.features.detach(), *torch.autograd.grad(loss, [*g.tensors().values(), *own])))
    for a, b, exact in zip(*results):
        assert torch.equal(a, b) and float((a.double() - exact).norm()) <= 1e-5 * float(exact.norm())


def test_no_gaussians_show_the_background():
    """An empty set has channels, too."""
    empty, cam = cloud(0), camera(20, 12, dtype=torch.float32)
    behind = random(7)
    r = rasterize(empty, cam, RasterizeOptions(features=torch.zeros(0, 7), feature_background=behind))
    assert torch.equal(r.features, behind.expand(12, 20, 7)) and not bool(r.rgb.any())


def test_wrong_channels_are_named():
    """Type, scalar type, number of Gaussians and of cameras, no channel, backgrounds of another length."""
    gaussians, cam, values, behind = scene(torch.float32, "cpu", 8)
    for kind, words, options in [
        (TypeError, "features must be a torch tensor, not ndarray", {"features": np.zeros((400, 8))}),
        (TypeError, r"colors is torch\.float64 but means is torch\.float32", {"colors": values.double()}),
        (ValueError, r"colors must have shape \[N, D\] \(N=400, C=2, D=8\), not \[399, 8\]", {"colors": values[1:]}),
        (ValueError, r"features must have shape \[C, N, D\]", {"features": values.expand(3, -1, -1)}),
        (ValueError, "features must have at least one channel", {"features": values[:, :0]}),
        (
            ValueError,
            r"background must have shape \[8\] or \[C, 8\], C=2, not \[3\]",
            {"colors": values, "background": behind[0, :3]},
        ),
        (ValueError, r"background must have shape \[3\] .*, not \[2, 8\]", {"features": values, "background": behind}),
        (ValueError, r"feature_background .*\[8\]", {"features": values, "feature_background": behind[:, :3]}),
    ]:
        with pytest.raises(kind, match=words):
            rasterize(gaussians, cam, RasterizeOptions(**options))


@pytest.mark.parametrize("what", ["colors", "background", "features", "feature_background"])
def test_leaves_render_where_autograd_is_off(what, device):
    """A learned background or feature shows the same image under no_grad, without a gradient."""
    gaussians, cam, values, behind = scene(torch.float32, device, 5)
    given = {"colors": values, "background": behind, "features": values, "feature_background": behind}
    wanted = rasterize(gaussians, cam, RasterizeOptions(**given))
    given[what] = given[what].clone().requires_grad_()
    with torch.no_grad():
        found = rasterize(gaussians, cam, RasterizeOptions(**given))
    assert torch.equal(found.rgb, wanted.rgb) and torch.equal(found.features, wanted.features)
    assert not found.rgb.requires_grad
