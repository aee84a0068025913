"""A window is the crop of the whole picture, to the bit, and windows drawn one by one add up to it."""

import dataclasses

import pytest
import torch

from tests.splats import camera, cloud, leaves
from warpgs.errors import UsageError
from warpgs.rasterizer import RasterizeOptions, rasterize

SIZE = (75, 53)  # no multiple of a tile
WINDOWS = [(0, 0, 75, 53), (0, 16, 75, 16), (32, 0, 16, 53), (16, 32, 59, 21), (64, 48, 11, 5), (48, 16, 16, 32)]


def scene(dtype, device):
    """Two cameras that see a cloud, and background colours."""
    background = torch.tensor([[0.1, 0.5, 0.9], [0.7, 0.2, 0.3]], dtype=dtype, device=device)
    return cloud(400, dtype, device), camera(*SIZE, cameras=2, dtype=dtype, device=device), background


@pytest.mark.parametrize("window", WINDOWS)
@pytest.mark.parametrize(("rule", "tile_size"), [("exact", 16), ("exact", 8), ("gsplat", 16), ("inria", 16)])
def test_window_is_the_crop(device, dtype, window, rule, tile_size):
    """Colour, alpha, depth and contributions, every bit of them; float32 and the generic float64 path."""
    gaussians, cam, background = scene(dtype, device)
    options = RasterizeOptions(rule=rule, background=background, tile_size=tile_size)
    whole = rasterize(gaussians, cam, options)
    part = rasterize(gaussians, cam, dataclasses.replace(options, window=window, contributions=True))
    x, y, width, height = window
    for name in ("rgb", "alpha", "depth"):
        crop = getattr(whole, name)[:, y : y + height, x : x + width]
        assert torch.equal(getattr(part, name), crop), name
    assert bool(whole.alpha.any()) and bool((part.tile_counts <= whole.tile_counts).all())
    assert torch.allclose(part.weight_sums.sum(), part.alpha.sum(), rtol=1e-4)


def gradients(gaussians, cam, background, upstream, **options) -> list[torch.Tensor]:
    """Of all Gaussians, camera and background, for the gradients of colour, alpha and depth in ``upstream``."""
    cam = dataclasses.replace(cam, viewmat=cam.viewmat.clone().requires_grad_(), K=cam.K.clone().requires_grad_())
    g, background = leaves(gaussians), background.clone().requires_grad_()
    r = rasterize(g, cam, RasterizeOptions(background=background, **options))
    x, y, width, height = options.get("window") or (0, 0, *SIZE)
    pictures = torch.cat([r.rgb, r.alpha[..., None], r.depth[..., None]], -1)
    loss = (pictures * upstream[:, y : y + height, x : x + width]).sum()
    inputs = [*g.tensors().values(), cam.viewmat, cam.K, background]
    return list(torch.autograd.grad(loss, inputs, allow_unused=False))


def test_gradients_of_bands_add_up(device, dtype):
    """The sum over bands equals the gradient of the whole, but for the order of sums."""
    scenery = scene(dtype, device)
    upstream = torch.rand(2, SIZE[1], SIZE[0], 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    upstream = upstream.to(device, dtype) - 0.4
    whole = gradients(*scenery, upstream)
    bands = [gradients(*scenery, upstream, window=(0, y, 75, min(16, 53 - y))) for y in range(0, 53, 16)]
    near = 3e-5 if dtype is torch.float32 else 1e-12
    for a, *parts in zip(whole, *bands):
        assert float((a - sum(parts)).norm()) <= near * float(a.norm())


@pytest.mark.parametrize(
    "window", [(1, 0, 16, 16), (0, 8, 75, 8), (0, 0, 20, 53), (0, 0, 0, 16), (0, 16, 75, 40), (-16, 0, 32, 16)]
)
def test_windows_off_the_tiles_are_refused(window):
    """An edge inside a tile, beyond the picture, or nothing at all."""
    gaussians, cam, _ = scene(torch.float32, "cpu")
    with pytest.raises(UsageError, match=r"window .* multiples of 16"):
        rasterize(gaussians, cam, RasterizeOptions(window=window))
