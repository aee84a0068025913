"""Windows and lists of pixels: the bits of the whole image there, and its gradients."""

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


def scene(dtype, device):
    background = torch.tensor([[0.1, 0.5, 0.9], [0.7, 0.2, 0.3]], dtype=dtype, device=device)
    return cloud(400, dtype, device), camera(*SIZE, cameras=2, dtype=dtype, device=device), background


def test_chunks_keep_to_their_number_and_notice_changed_sources():
    """Every chunk but a single tile keeps to the number; together they are the window."""
    gaussians, cam, background = scene(torch.float32, "cpu")
    found = list(chunks(pass_of(cam, 1, RULES["exact"], window=(16, 16, 59, 37)), 150, inputs_of(gaussians, cam)))
    covered = torch.zeros(SIZE[1], SIZE[0], dtype=torch.int32)
    for settings, counts in found:
        x, y, width, height = settings.window
        covered[y : y + height, x : x + width] += 1
        assert int(counts.sum()) <= 150 or (width <= 16 and height <= 16)
    assert len(found) > 4 and bool((covered[16:, 16:] == 1).all()) and int(covered.sum()) == 59 * 37
    # an error, not a wrong gradient
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
    gaussians, cam, _ = scene(torch.float32, "cpu")
    with pytest.raises(UsageError, match=r"window .* multiples of 16"):
        rasterize(gaussians, cam, RasterizeOptions(window=window))


MAPS = ("rgb", "alpha", "depth", "median_depth", "features", "heaviest_ids", "heaviest_weights", "blend_counts")


def pixels_scene(device, dtype=torch.float32, cameras=2):
    gaussians, cam = cloud(300, dtype, device), camera(*SIZE, cameras=cameras, dtype=dtype, device=device)
    features = torch.randn(300, 5, dtype=dtype, generator=torch.Generator().manual_seed(1)).to(device)
    options = RasterizeOptions(
        features=features, median_depth=True, heaviest=3, background=torch.tensor([0.1, 0.5, 0.9])
    )  # fmt: skip
    return gaussians, cam, options


def some(count, seed, low=(0, 0), high=SIZE):
    generator = torch.Generator().manual_seed(seed)
    return torch.stack([torch.randint(a, b, (count,), generator=generator) for a, b in zip(low, high, strict=True)], 1)


@pytest.mark.parametrize("low,high", [((0, 0), SIZE), ((20, 17), (44, 30)), ((74, 52), SIZE)], ids=["all", "part", "corner"])
@pytest.mark.parametrize("how", [{}, {"tile_size": 8}, {"max_instances": 100}], ids=["", "8", "chunked"])
def test_they_have_the_bits_of_the_image(device, dtype, low, high, how):
    """Every map, for pixels of all cameras and of each its own, some of them twice, and for a single camera."""
    gaussians, cam, options = pixels_scene(device, dtype)
    whole = rasterize(gaussians, cam, options)
    shared, own = some(9, 1, low, high), torch.stack([some(9, 2, low, high), some(9, 3, low, high)])
    for pixels in (shared, own.int()):
        found = rasterize(gaussians, cam, dataclasses.replace(options, pixels=pixels.to(device), **how))
        x, y = (pixels.expand(2, 9, 2)[..., i].long().to(device) for i in range(2))
        of = torch.arange(2, device=device)[:, None]
        for name in MAPS:
            image = getattr(whole, name)
            assert (getattr(found, name) is None) == (image is None)
            assert image is None or torch.equal(getattr(found, name), image[of, y, x]), name
    single = dataclasses.replace(cam, viewmat=cam.viewmat[1], K=cam.K[1])
    found = rasterize(gaussians, single, dataclasses.replace(options, pixels=shared, **how))
    assert found.rgb.shape == (9, 3) and found.alpha.shape == (9,)
    bounded = dataclasses.replace(options, pixels=shared, error_bound=True, **how)
    assert rasterize(gaussians, single, bounded).error_bound.shape == (9,)
    assert torch.equal(found.rgb, whole.rgb[1][shared[:, 1], shared[:, 0]])


@pytest.mark.parametrize("how", [{}, {"max_instances": 100}, {"colors": True}], ids=["", "chunked", "channels"])
def test_gradients_are_those_of_the_image(device, how):
    gaussians, cam, options = pixels_scene(device)
    options = dataclasses.replace(options, heaviest=0, **{k: v for k, v in how.items() if k != "colors"})
    if "colors" in how:
        options = dataclasses.replace(options, colors=options.features[:, :4], background=None)
    pixels = torch.cat([some(40, 4), some(3, 4)]).to(device)
    weight = torch.randn(2, 43, generator=torch.Generator().manual_seed(5)).to(device)

    (x, y), found = pixels.T, []
    for listed in (True, False):
        own = [t.detach().clone().requires_grad_() for t in (*gaussians.tensors().values(), cam.viewmat, cam.K)]
        view = dataclasses.replace(cam, viewmat=own[5], K=own[6])
        r = rasterize(type(gaussians)(*own[:5]), view, dataclasses.replace(options, pixels=pixels) if listed else options)
        images = [getattr(r, n) if listed else getattr(r, n)[:, y, x] for n in ("rgb", "alpha", "depth", "features")]
        rgb, alpha, depth, features = images
        ((rgb.square().sum(-1) + alpha + 0.1 * depth + features.sum(-1)) * weight).sum().backward()
        found.append([t.grad for t in own if t.grad is not None])
    pairs = list(zip(*found, strict=True))
    assert len(pairs) >= 6 and any(bool(a.any()) for a, _ in pairs)
    for a, b in pairs:
        if device.type == "cpu" and "max_instances" not in how:
            assert torch.equal(a, b)
        assert torch.allclose(a, b, rtol=1e-4, atol=1e-5 * float(b.abs().max()))


def test_no_pixel_at_all(device):
    gaussians, cam, options = pixels_scene(device)
    gaussians.means.requires_grad_()
    r = rasterize(gaussians, cam, dataclasses.replace(options, pixels=torch.zeros(0, 2, dtype=torch.int64)))
    assert r.rgb.shape == (2, 0, 3) and r.heaviest_ids.shape == (2, 0, 3)
    r.rgb.sum().backward()
    assert not bool(gaussians.means.grad.any())


@pytest.mark.parametrize(
    ("pixels", "kind", "match"),
    [
        (torch.zeros(3, 2), TypeError, "integers"), ([[1, 2]], TypeError, "integers"),
        (torch.zeros(3, 3, dtype=torch.int64), ValueError, r"\[P, 2\] or \[2, P, 2\]"),
        (torch.zeros(3, 4, 2, dtype=torch.int64), ValueError, r"\[P, 2\] or \[2, P, 2\]"),
        (torch.tensor([[75, 0]]), ValueError, "leave the 75 x 53"), (torch.tensor([[0, -1]]), ValueError, "leave the"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused(pixels, kind, match):
    gaussians, cam, _ = pixels_scene(torch.device("cpu"))
    with pytest.raises(kind, match=match):
        rasterize(gaussians, cam, RasterizeOptions(pixels=pixels))
