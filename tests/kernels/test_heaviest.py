"""The k heaviest Gaussians of each pixel against a sort of all weights, and against the alpha of blending."""

import dataclasses

import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, hand_placed
from tests.kernels.test_median_depth import layers
from tests.reference.heaviest import heaviest_reference
from tests.reference.project import project_reference
from tests.tolerances import close
from warpgs.constants import RULES, Rule
from warpgs.errors import UsageError
from warpgs.kernels.project import project
from warpgs.kernels.tiles import bin_tiles
from warpgs.kernels.walk import heaviest
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize


def found_by(gaussians, cam, rule, k, tile_size=16):
    """Return what the kernels find."""
    size = {"width": cam.width, "height": cam.height, "rule": rule}
    projected, counts = project(*gaussians.tensors().values(), cam.viewmat, cam.K, **size, degree=1, tile_size=tile_size)
    return heaviest(projected, bin_tiles(projected, counts, **size, tile_size=tile_size), k, **size)


def wanted_by(gaussians, cam, rule, k, tile_size):
    """Return the same by the references, stacked over cameras."""
    tensors = [t.detach().cpu().double() for t in (*gaussians.tensors().values(), cam.viewmat, cam.K)]
    size = {"width": cam.width, "height": cam.height}
    means, covs, _, depths, opacities = project_reference(*tensors, **size, degree=1, low_pass=rule.low_pass)
    found = [
        heaviest_reference(means[c], covs[c], opacities, depths[c], k, *size.values(), rule, tile_size)
        for c in range(len(cam.viewmat))
    ]
    return [torch.stack(parts) for parts in zip(*found, strict=True)]


@pytest.mark.parametrize(
    ("tile_size", "rule", "k"), [(16, "exact", 3), (8, "gsplat-1.5", 1), (16, "inria", 5), (8, "smooth", 8)]
)
def test_they_equal_the_reference(device, dtype, rule, tile_size, k):
    """Under every kind of rule, in images that are no multiple of a tile; another Gaussian only where two weigh the same."""
    rule = SMOOTH if rule == "smooth" else RULES[rule]
    gaussians, cam = hand_placed(dtype, device), camera(33, 21, cameras=2, dtype=dtype, device=device)
    ids, weights, counts = (t.cpu() for t in found_by(gaussians, cam, rule, k, tile_size))
    expected, expected_weights, expected_counts = wanted_by(gaussians, cam, rule, k, tile_size)
    assert ids.dtype == counts.dtype == torch.int32 and weights.dtype == dtype and ids.shape == (2, 21, 33, k)
    close("image", weights, expected_weights)
    assert float((ids == expected).double().mean()) > 0.99 and float((counts == expected_counts).double().mean()) > 0.99
    assert bool((ids[weights == 0] == -1).all()) and bool((ids[weights > 0] >= 0).all()) and len(ids.unique()) > 2


def test_all_of_them_weigh_alpha(device, dtype):
    """With room for all, weights sum to alpha, none comes twice, and as many are there as were blended."""
    gaussians, cam = cloud(60, dtype, device), camera(75, 53, cameras=2, dtype=dtype, device=device)
    r = rasterize(gaussians, cam, RasterizeOptions(heaviest=60))
    close("image", r.heaviest_weights.sum(-1), r.alpha)
    assert torch.equal((r.heaviest_ids >= 0).sum(-1).int(), r.blend_counts) and int(r.blend_counts.max()) > 3
    assert bool((r.heaviest_weights.diff(dim=-1) <= 0).all())
    ordered = r.heaviest_ids.sort(-1).values
    assert not bool(((ordered.diff(dim=-1) == 0) & (ordered[..., 1:] >= 0)).any())
    seen = torch.zeros(2, len(gaussians), dtype=dtype, device=device)
    ids = r.heaviest_ids.long().clamp_min(0).view(2, -1)
    seen.scatter_reduce_(1, ids, r.heaviest_weights.reshape(2, -1), "amax")
    plain = rasterize(gaussians, cam, RasterizeOptions(contributions=True))
    close("image", seen, plain.weight_maxima)


@pytest.mark.parametrize(
    ("opacities", "rule", "ids", "count"),
    [
        ([0.5, 0.5, 0.25], "exact", [0, 1], 3), ([0.25, 0.5, 0.5], "exact", [1, 0], 3), ([0.001, 0.9], "exact", [1, -1], 1),
        ([0.2, 0.25], "exact", [0, 1], 2), ([], "exact", [-1, -1], 0), ([0.0625, 0.25, 0.5, 0.75], "exact", [2, 3], 4),
        ([0.3, 0.6, 0.2, 0.9], Rule("early", transmittance_stop=0.4), [1, 0], 2),
        ([0.3, 0.6, 0.2, 0.9], Rule("early", transmittance_stop=0.4, inclusive_stop=False), [0, -1], 1),
    ],
)  # fmt: skip
def test_layers(device, dtype, opacities, rule, ids, count):
    """Ties go to the nearer one; what is cut or behind the stop is not there."""
    projected, tiles = layers(opacities, device, dtype)
    rule = RULES[rule] if isinstance(rule, str) else rule
    found, weights, counts = heaviest(projected, tiles, 2, width=16, height=16, rule=rule)
    assert bool((found == torch.tensor(ids, device=device)).all()) and bool((counts == count).all())
    light, expected = 1.0, {}
    for i, alpha in enumerate(opacities):
        expected[i] = alpha * light
        light *= 1 - alpha if alpha >= rule.alpha_cut else 1
    wanted = torch.tensor([expected[i] if i >= 0 else 0.0 for i in ids], dtype=dtype, device=device)
    assert torch.allclose(weights, wanted.expand_as(weights))


def test_the_public_op_gives_them_on_request(device, dtype):
    """None by default; the same bits for windows, chunks, tile sizes, repeats and threads, and for a single camera."""
    gaussians, cam = cloud(400, dtype, device), camera(75, 53, cameras=2, dtype=dtype, device=device)
    options = RasterizeOptions(heaviest=4)
    plain = rasterize(gaussians, cam)
    assert plain.heaviest_ids is plain.heaviest_weights is plain.blend_counts is None and not options.repeatable()
    whole = rasterize(gaussians, cam, options)
    names = ("heaviest_ids", "heaviest_weights", "blend_counts")
    assert torch.equal(whole.rgb, plain.rgb) and len(whole.heaviest_ids.unique()) > 30
    threads = torch.get_num_threads()
    torch.set_num_threads(3 - min(threads, 2))
    again = rasterize(gaussians, cam, dataclasses.replace(options, tile_size=8, contributions=True))
    torch.set_num_threads(threads)
    chunked = rasterize(gaussians, cam, dataclasses.replace(options, max_instances=150, median_depth=True))
    window = rasterize(gaussians, cam, dataclasses.replace(options, window=(16, 16, 59, 37), max_instances=100))
    single = rasterize(gaussians, dataclasses.replace(cam, viewmat=cam.viewmat[1], K=cam.K[1]), options)
    for name in names:
        found = getattr(whole, name)
        assert torch.equal(getattr(again, name), found) and torch.equal(getattr(chunked, name), found), name
        assert torch.equal(getattr(window, name), found[:, 16:, 16:]) and torch.equal(getattr(single, name), found[1]), name


def test_what_cannot_be_is_refused():
    """A number below 1, and tiles of another image."""
    projected, tiles = layers([0.5], "cpu")
    for k in (0, -1):
        with pytest.raises(ValueError, match="at least 1"):
            heaviest(projected, tiles, k, width=16, height=16, rule=RULES["exact"])
    with pytest.raises(UsageError, match="heaviest"):
        rasterize(cloud(5), camera(8, 8, dtype=torch.float32), RasterizeOptions(heaviest=-1))
    with pytest.raises(ValueError, match="tiles were made for another image"):
        heaviest(projected, tiles, 1, width=17, height=16, rule=RULES["exact"])


@pytest.mark.cuda
@pytest.mark.parametrize("tile_size", [8, 16])
def test_native_kernel_agrees_with_the_generic_one(tile_size):
    """The CUDA body in float32 takes the generic kernel's Gaussians in float64, but for pixels that rounding decides."""
    device = torch.device("cuda", 0)
    gaussians, cam = cloud(3000, device=device), camera(203, 131, cameras=2, dtype=torch.float32, device=device)
    ids, weights, counts = found_by(gaussians, cam, RULES["exact"], 5, tile_size)
    double = type(gaussians)(**{n: t.double() for n, t in gaussians.tensors().items()})
    doubles = dataclasses.replace(cam, viewmat=cam.viewmat.double(), K=cam.K.double())
    others = found_by(double, doubles, RULES["exact"], 5, tile_size)
    assert float((ids != others[0]).double().mean()) <= 2e-3 and float((counts != others[2]).double().mean()) <= 2e-3
    assert float((weights.double() - others[1]).abs().max()) < 1e-2 and bool(weights.any())
    assert all(
        torch.equal(a, b) for a, b in zip((ids, weights, counts), found_by(gaussians, cam, RULES["exact"], 5, tile_size))
    )
