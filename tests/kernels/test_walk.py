"""Walks along rays: the median depth and the heaviest Gaussians, against loops and sorts."""

import dataclasses

import pytest
import torch

from bench.lib.kernel_calls import bin_tiles, blend, heaviest, median_depth, project
from tests.gaussians import SMOOTH, camera, cloud, hand_placed
from tests.reference.project import project_reference
from tests.reference.walk import heaviest_reference, median_depth_reference
from tests.tolerances import close
from warpgs.constants import RULES, Rule
from warpgs.kernels.tiles import Tiles
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize

EXACT = RULES["exact"]


def walked(gaussians, cam, rule, k, tile_size=16):
    size = {"width": cam.width, "height": cam.height, "rule": rule}
    tensors = (*gaussians.tensors().values(), cam.viewmat, cam.K)
    projected, counts = project(*tensors, **size, degree=1, tile_size=tile_size)
    tiles = bin_tiles(projected, counts, **size, tile_size=tile_size)
    alpha = blend(projected, tiles, projected.new_zeros(len(cam.viewmat), 3), **size)[1]
    return median_depth(projected, tiles, **size), heaviest(projected, tiles, k, **size), alpha


@pytest.mark.parametrize(
    ("tile_size", "rule", "k"), [(16, "exact", 3), (8, "gsplat-1.5", 1), (16, "inria", 5), (8, "smooth", 8)]
)
def test_both_equal_the_references(device, dtype, rule, tile_size, k):
    """Under every kind of rule, in images that are no multiple of a tile; another Gaussian only where two weigh the same."""
    rule = SMOOTH if rule == "smooth" else RULES[rule]
    gaussians, cam = hand_placed(dtype, device), camera(33, 21, cameras=2, dtype=dtype, device=device)
    gaussians.logit_opacities.add_(1.5)
    depth, found, _ = walked(gaussians, cam, rule, k, tile_size)
    tensors = [t.detach().cpu().double() for t in (*gaussians.tensors().values(), cam.viewmat, cam.K)]
    means, covs, _, depths, opacities = project_reference(*tensors, width=33, height=21, degree=1, low_pass=rule.low_pass)
    each = [(means[c], covs[c], opacities, depths[c]) for c in range(2)]
    median = torch.stack([median_depth_reference(*e, 33, 21, rule, tile_size) for e in each])
    assert 0.1 < float((median == 0).double().mean()) < 0.9 and len(median.unique()) > 6
    close("image", depth, median)
    wanted = zip(*(heaviest_reference(*e, k, 33, 21, rule, tile_size) for e in each), strict=True)
    expected, expected_weights, expected_counts = (torch.stack(parts) for parts in wanted)
    ids, weights, counts = (t.cpu() for t in found)
    assert ids.dtype == counts.dtype == torch.int32 and weights.dtype == dtype and ids.shape == (2, 21, 33, k)
    close("image", weights, expected_weights)
    assert float((ids == expected).double().mean()) > 0.99 and float((counts == expected_counts).double().mean()) > 0.99
    assert bool((ids[weights == 0] == -1).all()) and bool((ids[weights > 0] >= 0).all()) and len(ids.unique()) > 2


@pytest.mark.parametrize("rule", ["exact", "gsplat-1.5", "inria"])
def test_median_depth_is_there_where_alpha_is_a_half(device, dtype, rule):
    gaussians, cam = cloud(400, dtype, device), camera(75, 53, cameras=2, dtype=dtype, device=device)
    found, _, alpha = walked(gaussians, cam, RULES[rule], 1)
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


EARLY, EXCLUSIVE = (Rule("early", transmittance_stop=0.4, inclusive_stop=i) for i in (True, False))
CLAMPED = dataclasses.replace(EARLY, alpha_max=0.4)


@pytest.mark.parametrize(
    ("opacities", "rule", "depth", "ids", "count"),
    [
        ([0.5], EXACT, 1, [0, -1], 1), ([0.49, 0.01], EXACT, 0, [0, 1], 2), ([0.25, 0.25, 0.25], EXACT, 3, [0, 1], 3),
        ([0.5, 0.5, 0.25], EXACT, 1, [0, 1], 3), ([0.25, 0.5, 0.5], EXACT, 2, [1, 0], 3), ([0.001, 0.9], EXACT, 2, [1, -1], 1),
        ([0.2, 0.25], EXACT, 0, [0, 1], 2), ([], EXACT, 0, [-1, -1], 0), ([0.75, 0.75, 0.75], EXACT, 1, [0, 1], 3),
        ([0.0625, 0.25, 0.5, 0.75], EXACT, 3, [2, 3], 4), ([0.001] * 100 + [0.99], EXACT, 101, [100, -1], 1),
        ([0.3, 0.6, 0.2, 0.9], EARLY, 2, [1, 0], 2), ([0.3, 0.6, 0.2, 0.9], EXCLUSIVE, 0, [0, -1], 1),
        ([0.3, 0.6, 0.2, 0.9], CLAMPED, 2, [0, 1], 3),
        ([0.5], Rule("cut", alpha_cut=0.5), 1, [0, -1], 1), ([0.25, 0.5], Rule("stop", transmittance_stop=0.75), 2, [1, 0], 2),
    ],
)  # fmt: skip
def test_layers(device, dtype, opacities, rule, depth, ids, count):
    """Half of the light lost counts; ties go to the nearer; what is cut or behind the stop is not there; equality passes."""
    projected, tiles = layers(opacities, device, dtype)
    size = {"width": 16, "height": 16, "rule": rule}
    assert bool((median_depth(projected, tiles, **size) == depth).all())
    found, weights, counts = heaviest(projected, tiles, 2, **size)
    assert bool((found == torch.tensor(ids, device=device)).all()) and bool((counts == count).all())
    light, expected = 1.0, {-1: 0.0}
    for i, alpha in enumerate(min(o, rule.alpha_max) for o in opacities):
        expected[i] = alpha * light
        light *= 1 - alpha if alpha >= rule.alpha_cut else 1
    wanted = torch.tensor([expected[i] for i in ids], dtype=dtype, device=device)
    assert torch.allclose(weights, wanted.expand_as(weights))


def test_faint_gaussians_at_the_end_of_a_strip(device, dtype):
    """Sixty of them at the first and the last pixel of a row: the ellipse is narrow, and each halves nothing by itself."""
    projected, tiles = layers([0.02] * 120, device, dtype)
    projected[..., 2] = projected[..., 4] = 1.8
    projected[..., 10:] = 1.1
    projected[..., 0] = torch.where(torch.arange(120, device=device) % 2 == 0, 0.5, 15.5).to(dtype)
    projected[..., 1] = 7.5
    size = {"width": 16, "height": 16, "rule": EXACT}
    found = median_depth(projected, tiles, **size)[0]
    alpha = blend(projected, tiles, projected.new_zeros(1, 3), **size)[1][0]
    assert torch.equal(found > 0, alpha >= 0.5) and int((found > 0).sum()) == 2
    assert float(found[7, 0]) == 69 and float(found[7, 15]) == 70  # 0.98^34 > 1/2 > 0.98^35


def test_all_of_them_weigh_alpha(device, dtype):
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
    assert plain.heaviest_ids is plain.median_depth is None
    close("image", seen, plain.weight_maxima)


@pytest.mark.cuda
@pytest.mark.parametrize("tile_size", [8, 16])
def test_native_kernels_agree_with_the_generic_ones(tile_size):
    """The CUDA bodies in float32 take the generic kernels' Gaussians in float64, but for pixels that rounding decides."""
    device = torch.device("cuda", 0)
    gaussians, cam = cloud(3000, device=device), camera(203, 131, cameras=2, dtype=torch.float32, device=device)
    depth, found, _ = walked(gaussians, cam, EXACT, 5, tile_size)
    double = type(gaussians)(**{n: t.double() for n, t in gaussians.tensors().items()})
    doubles = dataclasses.replace(cam, viewmat=cam.viewmat.double(), K=cam.K.double())
    other_depth, (ids, weights, counts), _ = walked(double, doubles, EXACT, 5, tile_size)
    near = (depth.double() - other_depth).abs() <= 1e-5 * other_depth
    assert bool(depth.any()) and float((~near).double().mean()) <= 1e-3
    assert float((found[0] != ids).double().mean()) <= 2e-3 and float((found[2] != counts).double().mean()) <= 2e-3
    assert float((found[1].double() - weights).abs().max()) < 1e-2 and bool(found[1].any())
    assert all(torch.equal(a, b) for a, b in zip(found, walked(gaussians, cam, EXACT, 5, tile_size)[1]))
