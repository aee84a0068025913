"""Walks along rays: the median depth and the heaviest Gaussians, against loops and sorts."""

import dataclasses

import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, hand_placed
from tests.reference.project import project_reference
from tests.reference.walk import heaviest_reference, median_depth_reference
from tests.tolerances import close
from warpgs.constants import RULES, Rule
from warpgs.errors import UsageError
from warpgs.kernels.blend import blend
from warpgs.kernels.project import project
from warpgs.kernels.tiles import Tiles, bin_tiles
from warpgs.kernels.walk import heaviest, median_depth
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize

# Median depth against a plain loop over Gaussians, and against the alpha of blending.


def rendered(gaussians, cam, rule, tile_size=16):
    """Return median depth and alpha of the kernels."""
    size = {"width": cam.width, "height": cam.height, "rule": rule}
    tensors = (*gaussians.tensors().values(), cam.viewmat, cam.K)
    projected, counts = project(*tensors, **size, degree=1, tile_size=tile_size)
    tiles = bin_tiles(projected, counts, **size, tile_size=tile_size)
    background = projected.new_zeros(len(cam.viewmat), 3)
    return median_depth(projected, tiles, **size), blend(projected, tiles, background, **size)[1]


def wanted(gaussians, cam, rule, tile_size):
    """Return the same median depth by the references, stacked over cameras."""
    tensors = [t.detach().cpu().double() for t in (*gaussians.tensors().values(), cam.viewmat, cam.K)]
    size = {"width": cam.width, "height": cam.height}
    means, covs, _, depths, opacities = project_reference(*tensors, **size, degree=1, low_pass=rule.low_pass)
    found = [
        median_depth_reference(means[c], covs[c], opacities, depths[c], *size.values(), rule, tile_size)
        for c in range(len(cam.viewmat))
    ]
    return torch.stack(found)


@pytest.mark.parametrize(("tile_size", "rule"), [(16, "exact"), (8, "gsplat-1.5"), (16, "inria"), (8, "smooth")])
def test_median_depth_equals_reference(device, dtype, rule, tile_size):
    """Under every kind of rule, in images that are no multiple of a tile; few pixels have no median."""
    rule = SMOOTH if rule == "smooth" else RULES[rule]
    gaussians, cam = hand_placed(dtype, device), camera(33, 21, cameras=2, dtype=dtype, device=device)
    gaussians.logit_opacities.add_(1.5)
    found, _ = rendered(gaussians, cam, rule, tile_size)
    reference = wanted(gaussians, cam, rule, tile_size)
    assert 0.1 < float((reference == 0).double().mean()) < 0.9 and len(reference.unique()) > 6
    close("image", found, reference)


@pytest.mark.parametrize("rule", ["exact", "gsplat-1.5", "inria"])
def test_median_depth_is_there_where_alpha_is_a_half(device, dtype, rule):
    """It is above 0 where the alpha of the same render is at least 1/2, to the pixel, and 0 elsewhere."""
    gaussians, cam = cloud(400, dtype, device), camera(75, 53, cameras=2, dtype=dtype, device=device)
    found, alpha = rendered(gaussians, cam, RULES[rule])
    assert 0.1 < float((alpha < 0.5).double().mean()) < 0.9
    assert torch.equal(found > 0, alpha >= 0.5)


def layers(opacities, device, dtype=torch.float64):
    """Return flat layers over one tile, at depths 1, 2, ..., whose alpha is the opacity to the bit, and their tile."""
    count = len(opacities)
    projected = torch.zeros(1, count, 12, dtype=dtype)
    projected[0, :, 5] = torch.tensor(opacities, dtype=dtype)
    projected[0, :, 9] = torch.arange(1, count + 1)
    projected[0, :, 10:] = 100.0
    numbers = torch.arange(count, dtype=torch.int32, device=device)
    ranges = torch.tensor([[0, count]], dtype=torch.int32, device=device)
    one, total = torch.ones_like(numbers), torch.tensor([count], device=device)
    return projected.to(device), Tiles(16, ranges, numbers, numbers, numbers, one, numbers * 0, total)


@pytest.mark.parametrize(
    ("opacities", "depth"),
    [
        ([0.5], 1), ([0.49, 0.01], 0), ([0.25, 0.25, 0.25], 3), ([0.25, 0.5, 0.5], 2), ([0.0001, 0.9], 2), ([], 0),
        ([0.001] * 100 + [0.99], 101), ([0.75, 0.75, 0.75], 1),
    ],
)  # fmt: skip
def test_layers_that_halve_the_light(device, dtype, opacities, depth):
    """The layer at which transmittance is exactly one half counts; layers below the alpha cut do not."""
    projected, tiles = layers(opacities, device, dtype)
    found = median_depth(projected, tiles, width=16, height=16, rule=RULES["exact"])
    assert bool((found == depth).all())


def test_faint_gaussians_at_the_end_of_a_strip(device, dtype):
    """Sixty of them at the first and the last pixel of a row: the ellipse is narrow, and each halves nothing by itself."""
    projected, tiles = layers([0.02] * 120, device, dtype)
    projected[..., 2] = projected[..., 4] = 1.8
    projected[..., 10:] = 1.1
    projected[..., 0] = torch.where(torch.arange(120, device=device) % 2 == 0, 0.5, 15.5).to(dtype)
    projected[..., 1] = 7.5
    size = {"width": 16, "height": 16, "rule": RULES["exact"]}
    found = median_depth(projected, tiles, **size)[0]
    alpha = blend(projected, tiles, projected.new_zeros(1, 3), **size)[1][0]
    assert torch.equal(found > 0, alpha >= 0.5) and int((found > 0).sum()) == 2
    assert float(found[7, 0]) == 69 and float(found[7, 15]) == 70  # 0.98^34 > 1/2 > 0.98^35


@pytest.mark.parametrize(("inclusive", "depth"), [(True, 2), (False, 0)])
def test_the_layer_that_crosses_the_stop(device, dtype, inclusive, depth):
    """It is blended under an inclusive rule; under an exclusive one the pixel ends before it, and before what lies behind."""
    rule = Rule("early", transmittance_stop=0.4, inclusive_stop=inclusive)
    projected, tiles = layers([0.3, 0.6, 0.2, 0.9], device, dtype)
    assert bool((median_depth(projected, tiles, width=16, height=16, rule=rule) == depth).all())
    assert bool((median_depth(projected, tiles, width=5, height=3, rule=dataclasses.replace(rule, alpha_max=0.4)) == 2).all())


@pytest.mark.parametrize(
    ("rule", "opacities", "depth"),
    [(Rule("cut", alpha_cut=0.5), [0.5], 1), (Rule("stop", transmittance_stop=0.75), [0.25, 0.5], 2)],
)
def test_alpha_and_transmittance_equal_to_a_cut_off(device, dtype, rule, opacities, depth):
    """An alpha equal to the cut is blended, and a transmittance equal to the stop does not end a pixel, as in blending."""
    projected, tiles = layers(opacities, device, dtype)
    assert bool((median_depth(projected, tiles, width=16, height=16, rule=rule) == depth).all())


def test_the_public_op_gives_it_on_request(device, dtype):
    """None by default; the same bits for windows, chunks, tile sizes, repeats and threads, and for a single camera."""
    gaussians, cam = cloud(400, dtype, device), camera(75, 53, cameras=2, dtype=dtype, device=device)
    options = RasterizeOptions(median_depth=True)
    assert rasterize(gaussians, cam).median_depth is None and not options.repeatable()
    whole = rasterize(gaussians, cam, options)
    plain = rasterize(gaussians, cam)
    assert torch.equal(whole.rgb, plain.rgb) and torch.equal(whole.depth, plain.depth)
    threads = torch.get_num_threads()
    torch.set_num_threads(3 - min(threads, 2))
    again = rasterize(gaussians, cam, dataclasses.replace(options, tile_size=8, contributions=True))
    torch.set_num_threads(threads)
    chunked = rasterize(gaussians, cam, dataclasses.replace(options, max_instances=150))
    window = rasterize(gaussians, cam, dataclasses.replace(options, window=(16, 16, 59, 37), max_instances=100))
    assert bool(whole.median_depth.any()) and whole.median_depth.shape == (2, 53, 75)
    for found in (again, chunked):
        assert torch.equal(found.median_depth, whole.median_depth)
    assert torch.equal(window.median_depth, whole.median_depth[:, 16:, 16:])
    single = dataclasses.replace(cam, viewmat=cam.viewmat[1], K=cam.K[1])
    assert torch.equal(rasterize(gaussians, single, options).median_depth, whole.median_depth[1])


def test_tiles_of_another_image_are_refused():
    """The error is that of `blend`."""
    projected, tiles = layers([0.5], "cpu")
    with pytest.raises(ValueError, match="tiles were made for another image"):
        median_depth(projected, tiles, width=17, height=16, rule=RULES["exact"])


@pytest.mark.cuda
@pytest.mark.parametrize("tile_size", [8, 16])
def test_median_depth_native_kernel_agrees_with_the_generic_one(tile_size):
    """The CUDA body in float32 takes the generic kernel's Gaussian in float64, but for pixels that rounding decides."""
    device = torch.device("cuda", 0)
    gaussians, cam = cloud(3000, device=device), camera(203, 131, cameras=2, dtype=torch.float32, device=device)
    found, _ = rendered(gaussians, cam, RULES["exact"], tile_size)
    double = type(gaussians)(**{n: t.double() for n, t in gaussians.tensors().items()})
    doubles = dataclasses.replace(cam, viewmat=cam.viewmat.double(), K=cam.K.double())
    other, _ = rendered(double, doubles, RULES["exact"], tile_size)
    assert bool(found.any())
    near = (found.double() - other).abs() <= 1e-5 * other
    assert float((~near).double().mean()) <= 1e-3


# The k heaviest Gaussians of each pixel against a sort of all weights, and against the alpha of blending.


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
def test_heaviest_native_kernel_agrees_with_the_generic_one(tile_size):
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
