"""A window is the crop of the whole image, to the bit, and windows rendered one by one add up to it."""

import dataclasses

import pytest
import torch

from tests.gaussians import camera, cloud, leaves
from warpgs.constants import RULES
from warpgs.errors import UsageError
from warpgs.render.chunked import chunks
from warpgs.render.compose import inputs_of, pass_of
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize

SIZE = (75, 53)  # no multiple of a tile
WINDOWS = [(0, 0, 75, 53), (0, 16, 75, 16), (32, 0, 16, 53), (16, 32, 59, 21), (64, 48, 11, 5), (48, 16, 16, 32)]


def scene(dtype, device):
    """Two cameras that see a cloud, and background colours."""
    background = torch.tensor([[0.1, 0.5, 0.9], [0.7, 0.2, 0.3]], dtype=dtype, device=device)
    return cloud(400, dtype, device), camera(*SIZE, cameras=2, dtype=dtype, device=device), background


@pytest.mark.parametrize(("rule", "tile_size"), [("exact", 8), ("gsplat-1.5", 16), ("inria", 16)])
def test_window_is_the_crop(device, dtype, rule, tile_size):
    """Bands, columns and corners: colour, alpha and depth to the bit, and contributions; float32 and the generic path."""
    gaussians, cam, background = scene(dtype, device)
    options = RasterizeOptions(rule=rule, background=background, tile_size=tile_size)
    whole = rasterize(gaussians, cam, options)
    assert bool(whole.alpha.any())
    for window in WINDOWS:
        part = rasterize(gaussians, cam, dataclasses.replace(options, window=window, contributions=True))
        x, y, width, height = window
        for name in ("rgb", "alpha", "depth"):
            crop = getattr(whole, name)[:, y : y + height, x : x + width]
            assert torch.equal(getattr(part, name), crop), (name, window)
        assert bool((part.tile_counts <= whole.tile_counts).all())
        assert torch.allclose(part.weight_sums.sum(), part.alpha.sum(), rtol=1e-4)


def gradients(gaussians, cam, background, upstream, **options) -> list[torch.Tensor]:
    """Return the gradients of Gaussians, camera and background; ``upstream`` holds those of colour, alpha and depth."""
    cam = dataclasses.replace(cam, viewmat=cam.viewmat.clone().requires_grad_(), K=cam.K.clone().requires_grad_())
    g, background = leaves(gaussians), background.clone().requires_grad_()
    r = rasterize(g, cam, RasterizeOptions(background=background, **options))
    x, y, width, height = options.get("window") or (0, 0, *SIZE)
    images = torch.cat([r.rgb, r.alpha[..., None], r.depth[..., None]], -1)
    loss = (images * upstream[:, y : y + height, x : x + width]).sum()
    inputs = [*g.tensors().values(), cam.viewmat, cam.K, background]
    return list(torch.autograd.grad(loss, inputs, allow_unused=False))


def test_gradients_of_windows_add_up(device, dtype):
    """The sum over windows equals the gradient of the whole, but for the order of sums."""
    scenery = scene(dtype, device)
    upstream = torch.rand(2, SIZE[1], SIZE[0], 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    upstream = upstream.to(device, dtype) - 0.4
    whole = gradients(*scenery, upstream)
    windows = [gradients(*scenery, upstream, window=(0, y, 75, min(16, 53 - y))) for y in range(0, 53, 16)]
    near = 3e-5 if dtype is torch.float32 else 1e-12
    for a, *pieces in zip(whole, *windows):
        assert float((a - sum(pieces)).norm()) <= near * float(a.norm())


@pytest.mark.parametrize("most", [1, 150])
def test_chunks_make_the_same_image(device, dtype, most):
    """In chunks as small as a tile, images are the same bits and gradients the same numbers."""
    gaussians, cam, background = scene(dtype, device)
    whole = rasterize(gaussians, cam, RasterizeOptions(background=background))
    chunked = rasterize(gaussians, cam, RasterizeOptions(background=background, max_instances=most, contributions=True))
    weights = rasterize(gaussians, cam, RasterizeOptions(contributions=True))
    assert torch.equal(weights.weight_maxima, chunked.weight_maxima)
    assert torch.allclose(weights.weight_sums, chunked.weight_sums, rtol=1e-5, atol=1e-6)
    assert int(whole.tile_counts.sum()) > 2 * most and torch.equal(whole.projected, chunked.projected)
    for name in ("rgb", "alpha", "depth"):
        assert torch.equal(getattr(whole, name), getattr(chunked, name)), name
    upstream = torch.rand(2, SIZE[1], SIZE[0], 5, generator=torch.Generator().manual_seed(1), dtype=torch.float64) - 0.4
    upstream = upstream.to(device, dtype)
    near = 3e-5 if dtype is torch.float32 else 1e-12
    pairs = [gradients(gaussians, cam, background, upstream, **o) for o in ({}, {"max_instances": most})]
    for a, b in zip(*pairs):
        assert float((a - b).norm()) <= near * float(a.norm())


def test_chunks_hold_no_more_instances_than_asked_for():
    """Every chunk but a single tile keeps to the number; together they are the window."""
    gaussians, cam, _ = scene(torch.float32, "cpu")
    found = list(chunks(pass_of(cam, 1, RULES["exact"], window=(16, 16, 59, 37)), 150, inputs_of(gaussians, cam)))
    covered = torch.zeros(SIZE[1], SIZE[0], dtype=torch.int32)
    for settings, counts in found:
        x, y, width, height = settings.window
        covered[y : y + height, x : x + width] += 1
        assert int(counts.sum()) <= 150 or (width <= 16 and height <= 16)
    assert len(found) > 4 and bool((covered[16:, 16:] == 1).all()) and int(covered.sum()) == 59 * 37


def test_sources_changed_before_the_gradient_are_noticed():
    """A chunk that would be rendered again from other Gaussians is an error, not a wrong gradient."""
    gaussians, cam, background = scene(torch.float32, "cpu")
    g = leaves(gaussians)
    r = rasterize(g, cam, RasterizeOptions(background=background, max_instances=100))
    with torch.no_grad():
        g.means.add_(1)
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        r.rgb.sum().backward()


@pytest.mark.parametrize(
    "window", [(1, 0, 16, 16), (0, 8, 75, 8), (0, 0, 20, 53), (0, 0, 0, 16), (0, 16, 75, 40), (-16, 0, 32, 16)]
)
def test_windows_off_the_tiles_are_refused(window):
    """An edge inside a tile or beyond the image, or an empty window."""
    gaussians, cam, _ = scene(torch.float32, "cpu")
    with pytest.raises(UsageError, match=r"window .* multiples of 16"):
        rasterize(gaussians, cam, RasterizeOptions(window=window))
