"""Gradients at their limits, in memory full of NaN: rows that are stored in part, lists of no tile, sums of nothing."""

import dataclasses
import math

import pytest
import torch

from tests.gaussians import SMOOTH, camera, cloud, leaves
from tests.kernels.test_limits_blend import plain
from tests.kernels.test_limits_project import facing, run
from tests.numerics.test_extreme_compositing import Filled
from tests.tolerances import close
from warpgs.constants import RULES
from warpgs.kernels import blend, tiles
from warpgs.scene import Gaussians

EXACT = RULES["exact"]


STORED = (1, 3, 4, 5, 8, 9, 16, 20, 25, 28)
ROWS = [(degree, stored) for degree in range(5) for stored in STORED if stored >= (degree + 1) ** 2]


@pytest.mark.parametrize(("degree", "stored"), ROWS)
def test_coefficients_that_are_stored_and_not_used(device, degree, stored):
    """Zero gradients for them, whatever is in memory, and in rows of any length the gradients of what is used."""
    results = []
    for kind, where in ((torch.float32, device), (torch.float64, torch.device("cpu"))):
        g = cloud(150, kind, where, degree=5)
        g = leaves(dataclasses.replace(g, sh=g.sh[:, :stored].contiguous()))
        cam = camera(40, 30, cameras=2, dtype=kind, device=where)
        with Filled(math.nan, 1):
            projected, counts = run(g, cam, degree=degree)
            upstream = torch.linspace(-1, 1, projected.numel(), dtype=kind, device=where).view(projected.shape)
            found = torch.autograd.grad((projected[..., 6:9] * upstream[..., 6:9]).sum(), [g.sh, g.means])
        used = (degree + 1) ** 2
        assert not bool(found[0][:, used:].any()) and not bool(found[0][(counts == 0).all(0)].any())
        results.append((projected[..., 6:9], *found))
    for single, double in zip(*results, strict=True):
        close("gradient", single, double)


def of_records(projected, made, rule, only_rgb, deterministic=True, **size):
    """Return the gradient of the projected Gaussians, in fresh memory full of NaN."""
    record = projected.detach().requires_grad_()
    black = torch.zeros(len(projected), 3, dtype=projected.dtype, device=projected.device)
    with Filled(math.nan, 0):
        rgb, alpha, depth = blend.blend(record, made, black, rule=rule, deterministic=deterministic, **size)
        loss = rgb.sum() if only_rgb else rgb.sum() + (alpha * depth).sum()
        return torch.autograd.grad(loss, record)[0]


@pytest.mark.parametrize("deterministic", [True, False], ids=["ordered", "atomic"])
@pytest.mark.parametrize("only_rgb", [True, False])
def test_every_row_of_the_gradient_is_written(device, only_rgb, deterministic):
    """Gaussians of no tile, of one and of hundreds; without a loss of depth its column is zero, as half sides always are."""
    size = {"width": 200, "height": 100}
    gaussians, cam = cloud(300, device=device), camera(**size, cameras=1, dtype=torch.float32, device=device)
    gaussians.log_scales[::5] += 3.0
    gaussians.means[::7, 2] = -4.0
    results = []
    for kind in (torch.float32, torch.float64):
        g = Gaussians(**{n: t.to(kind) for n, t in gaussians.tensors().items()})
        view = dataclasses.replace(cam, viewmat=cam.viewmat.to(kind), K=cam.K.to(kind))
        projected, counts = run(g, view, SMOOTH if only_rgb else EXACT, tile_size=8)
        made = tiles.bin_tiles(projected, counts, rule=SMOOTH if only_rgb else EXACT, tile_size=8, **size)
        assert int(counts.max()) > 100 and int(counts.min()) == 0
        found = of_records(projected, made, SMOOTH if only_rgb else EXACT, only_rgb, deterministic, **size)
        assert bool(torch.isfinite(found).all()) and not bool(found[counts == 0].any())
        assert not bool(found[..., (9 if only_rgb else 10) :].any())
        results.append(found)
    if only_rgb:  # smooth: nothing is near a cut
        for column in range(9):
            assert float((results[0][..., column] - results[1][..., column]).norm()) <= 1e-4 * float(results[1].norm())


@pytest.mark.parametrize("extra", [1, 3, 40])
def test_slots_of_no_tile_add_nothing(device, dtype, extra):
    """Capacity that was counted and not needed does not change the gradients."""
    size = {"width": 96, "height": 80}
    gaussians, cam = cloud(61, dtype, device), camera(**size, cameras=1, dtype=dtype, device=device)
    projected, counts = run(gaussians, cam)
    more = torch.where((counts > 0) & (torch.arange(61, device=device) % 6 == 0), counts + extra, counts)
    assert int((more - counts).sum()) % 2 == 1 or extra == 40
    found = [
        of_records(projected, tiles.bin_tiles(projected, c, rule=EXACT, **size), EXACT, False, **size) for c in (counts, more)
    ]
    off = float((found[0] - found[1]).norm()) / float(found[0].norm())
    assert torch.equal(*found) if extra < 40 else off <= 1e-6  # a longer list is summed by a warp, in another order


def test_layers_that_draw_nothing_have_no_gradient(device, dtype):
    """Every other one is below the cut, among them the first of each batch of 32."""
    with Filled(math.nan, 0):
        projected, (rgb, _, _), (sums, maxima) = plain([0.001, 0.02] * 50, device, dtype, EXACT)
        (gradient,) = torch.autograd.grad(rgb.sum(), projected)
    assert not bool(gradient[0, ::2].any()) and not bool(sums[0, ::2].any()) and not bool(maxima[0, ::2].any())
    assert bool((gradient[0, 1::2, 5:9] > 0).all()) and bool((sums[0, 1::2] > 0).all())


def test_contributions_count_the_pixels_of_the_picture(device, dtype):
    """In a tile with more instances than a chunk, the first instance has its gradient, too."""
    _, _, (sums, _) = plain([0.25, 0.5, 0.5], device, dtype, EXACT, side=3)
    assert sums.tolist() == [[9 * 0.25, 9 * 0.375, 9 * 0.1875]]


def test_a_first_layer_behind_the_stop(device, dtype):
    """Where one layer already crosses the stop, nothing is blended, and nothing has a gradient."""
    rule = dataclasses.replace(EXACT, transmittance_stop=0.6, inclusive_stop=False)
    projected, (rgb, alpha, depth), (sums, _) = plain([0.5, 0.1], device, dtype, rule)
    assert not bool(alpha.any()) and not bool(sums.any())
    (gradient,) = torch.autograd.grad(rgb.sum() + alpha.sum() + depth.sum(), projected)
    assert not bool(gradient.any())


def test_depth_where_every_weight_is_zero(device, dtype):
    """Without a cut a Gaussian is listed everywhere, and far away its weight is 0: depth 0, and gradients are numbers."""
    size = {"width": 64, "height": 64}
    gaussians, cam = facing(2, dtype, device, size=64)
    projected, counts = run(gaussians, cam, SMOOTH)
    made = tiles.bin_tiles(projected, counts, rule=SMOOTH, **size)
    record = projected.detach().requires_grad_()
    black = torch.zeros(1, 3, dtype=dtype, device=device)
    depth = blend.blend(record, made, black, rule=SMOOTH, **size)[2]
    empty = depth == 0
    assert bool(empty.any()) or (dtype, device.type) == (torch.float32, "cpu")  # whose exponential does not reach 0
    (gradient,) = torch.autograd.grad(depth[empty].sum() + depth[0, 8, 8], record)
    assert bool(torch.isfinite(gradient).all()) and abs(float(gradient[0, :, 9].sum()) - 1) < 1e-5


@pytest.mark.parametrize("count", [255, 256, 257])
def test_as_many_gaussians_as_a_block_has_threads(device, count):
    """With one more or fewer, too, each is listed and has its gradient."""
    gaussians, cam = facing(count, device=device)
    gaussians.logit_opacities[:] = -4.0
    projected, counts = run(gaussians, cam)
    size = {"width": 16, "height": 16}
    made = tiles.bin_tiles(projected, counts, rule=EXACT, **size)
    assert made.gaussian_ids.tolist() == list(range(count)) and made.ranges.tolist() == [[0, count]]
    assert bool((of_records(projected, made, EXACT, True, **size)[0, :, 6] > 0).all())


def test_long_lists_are_written_by_a_warp(device, dtype):
    """One Gaussian alone of a hundred tiles; forty rows of them; one counted short, which takes no other's slot."""
    gaussians, cam = facing(2, dtype, device, size=160)
    gaussians.log_scales[0] += 6.0
    gaussians.means[1, 2] = 1.01
    projected, counts = run(gaussians, cam)
    assert counts.tolist() == [[100, 1]]
    size = {"width": 160, "height": 160, "rule": EXACT}
    alone = tiles.bin_tiles(projected[:, :1], counts[:, :1], **size)
    assert alone.ranges.tolist() == [[i, i + 1] for i in range(100)]
    short = tiles.bin_tiles(projected, counts - torch.tensor([[1, 0]], dtype=torch.int32, device=device), **size)
    assert sorted(short.gaussian_ids.tolist()) == [0] * 99 + [1] and short.tile_ids.tolist() == [0, *range(99)]
    tall = dataclasses.replace(cam, width=16, height=640)
    projected, counts = run(Gaussians(**{n: t[:1] for n, t in gaussians.tensors().items()}), tall)
    made = tiles.bin_tiles(projected, counts, width=16, height=640, rule=EXACT)
    assert counts.tolist() == [[40]] and made.ranges.tolist() == [[i, i + 1] for i in range(40)]
