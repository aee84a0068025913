"""Kernels at their limits: the last element, byte and slot, values equal to a cut-off, memory full of NaN."""

import dataclasses
import math

import pytest
import torch

from bench.lib import kernel_calls as calls
from bench.lib.kernel_calls import adam_step
from tests.gaussians import camera, cloud, leaves
from tests.kernels.test_guard_bytes import Guarded
from tests.kernels.test_project import facing, run
from tests.kernels.test_tiles import binned
from tests.kernels.test_walk import layers
from tests.reference.update import adam_reference
from tests.tolerances import close
from warpgs.constants import RULES
from warpgs.errors import ResourceError
from warpgs.kernels import tiles
from warpgs.scene import Gaussians


@pytest.mark.parametrize("size", [1e-15, 1e-14])
def test_adam_adds_its_epsilon_to_the_root(device, dtype, size):
    """Gradients as small as it is move as torch moves them; the decay rates are those of the paper."""
    generator = torch.Generator().manual_seed(0)
    param = torch.zeros(37, 3, dtype=torch.float64)
    grads = [torch.randn(37, 3, generator=generator, dtype=torch.float64) * size for _ in range(4)]
    found, mean, square = (param.clone().to(device, dtype) for _ in range(3))
    for step, grad in enumerate(grads, 1):
        adam_step(found, grad.to(device, dtype), mean, square, lr=0.01, step=step)
    wanted = adam_reference(param, grads, 0.01)
    near = 2e-4 if dtype == torch.float32 else 1e-12
    assert torch.allclose(found.cpu().double(), wanted, rtol=near, atol=near * 1e-2)


# Lists and blending at their limits: the last byte, the last slot, an alpha or transmittance equal to a cut-off.

EXACT = RULES["exact"]


def test_one_running_sum_holds_both_numbers():
    for count in (1, 2, 3, 4095, 4096, 2_794_625, 2**23, 2**31 - 1):
        unit = 2 ** tiles.sum_bits(count)
        assert unit > tiles.MAX_INSTANCES and count * unit + unit - 1 < 2**63
        assert tiles.split_sum(count * unit + unit - 1, count) == (count, unit - 1)
    assert tiles.sums_fit(2_794_625, 240 * 135)  # 3840 x 2160 px
    assert tiles.sums_fit(2**23, 2**16 - 1) and not tiles.sums_fit(2**23, 2**16)


def test_budget_is_met_to_the_byte(monkeypatch):
    """As many instances as fit are allowed, one more is not; without a limit, four fifths of the free memory, if many."""
    cpu = torch.device("cpu")
    for total, limit in ((1000, 148_000), (2**30 - 1, 2**60)):
        tiles._check_total(total, cpu, limit)
    for total, limit, words in (
        (1001, 148_000, r"1,001 .* need 145 KiB, and the limit is 145 KiB"),
        (2**30, 2**60, r"the limit is 1,073,741,823 instances\. Check"),
        (2**30, None, r"the limit is 1,073,741,823 instances\. Check"),
        (2**30 - 1, 2**30, r"need 148\.0 GiB, and the limit is 1\.0 GiB"),
    ):
        with pytest.raises(ResourceError, match=words):
            tiles._check_total(total, cpu, limit)
    monkeypatch.setattr("warpgs.device.installed_bytes", lambda _: 20 * 148_000)
    monkeypatch.setattr("warpgs.device.available_bytes", lambda _: 5 * 37_000)
    tiles._check_total(1000, cpu, None)
    with pytest.raises(ResourceError):
        tiles._check_total(1001, cpu, None)


def one_a_tile(device, columns=3, rows=3):
    gaussians, cam = facing(columns * rows, device=device, size=16 * columns)
    K = cam.K[0]
    for i in range(columns * rows):
        pixel = torch.tensor([16.0 * (i % columns) + 8.5, 16.0 * (i // columns) + 8.5], device=device)
        gaussians.means[i, :2] = (pixel - K[:2, 2]) / torch.stack([K[0, 0], K[1, 1]])
        gaussians.means[i, 2] = 1.0
    return gaussians, cam


def test_tiles_of_one_instance_each_with_a_count_too_small_and_little_capacity(device, monkeypatch):
    """Every instance begins and ends a tile; one that was not counted takes no other's slot."""
    gaussians, cam = one_a_tile(device)
    projected, counts, made = binned(gaussians, cam)
    assert made.size == 16 and made.ranges.tolist() == [[i, i + 1] for i in range(9)]
    assert made.gaussian_ids.tolist() == list(range(9)) and made.total.tolist() == [9]
    with monkeypatch.context() as patch:  # visible Gaussians and instances are counted apart
        patch.setattr(tiles, "sums_fit", lambda *_: False)
        assert torch.equal(binned(gaussians, cam)[2].slots, made.slots)
    fewer = counts.clone()
    fewer[0, 3] -= 1
    made = calls.bin_tiles(projected, fewer, width=48, height=48, rule=EXACT)
    assert made.gaussian_ids.tolist() == [0, 1, 2, 4, 5, 6, 7, 8] and made.ranges[3].tolist() in ([0, 0], [3, 3])
    # an exact capacity is no overflow; one less is, and the cut lists fit
    gaussians.log_scales.add_(2.2)  # several tiles each
    projected, counts = run(gaussians, cam)
    total = int(counts.sum())
    assert int(counts.min()) > 2
    for capacity in (total, total - 1, total // 2):
        overflow = torch.zeros(1, dtype=torch.int32, device=device)
        memory = tiles.InstanceMemory(capacity=capacity, overflow=overflow)
        made = calls.bin_tiles(projected, counts.clone(), width=48, height=48, rule=EXACT, memory=memory)
        assert int(overflow) == (capacity < total)
        assert int(made.counts.sum()) == capacity and len(made.gaussian_ids) == capacity


def plain(opacities, device, dtype, rule, side=16):
    """Flat white layers, one behind another, over one tile; needs their gradient."""
    projected, made = layers(opacities, device, dtype)
    projected[..., 6:9] = 1.0
    projected.requires_grad_()
    size = {"width": side, "height": side, "rule": rule}
    images = calls.blend(projected, made, projected.new_zeros(1, 3), **size)
    return projected, images, calls.contributions(projected, made, **size)


@pytest.mark.parametrize(("inclusive", "weights"), [(True, [0.5, 0.25, 0.125, 0, 0]), (False, [0.5, 0.25, 0, 0, 0])])
def test_a_transmittance_equal_to_the_stop(device, dtype, inclusive, weights):
    """At the stop itself, to the bit, a pixel is still open, and the next layer is the last or is not blended."""
    rule = dataclasses.replace(EXACT, transmittance_stop=0.25, inclusive_stop=inclusive)
    projected, (rgb, alpha, depth), (sums, maxima) = plain([0.5] * 5, device, dtype, rule)
    assert bool((alpha == sum(weights)).all()) and bool((rgb == sum(weights)).all())
    mean = sum(w * z for w, z in zip(weights, range(1, 6))) / sum(weights)
    assert float((depth.detach() - mean).abs().max()) < 1e-6
    assert maxima.tolist() == [weights] and sums.tolist() == [[256 * w for w in weights]]
    (gradient,) = torch.autograd.grad(rgb[..., 0].sum(), projected)
    assert torch.allclose(gradient[0, :, 6].cpu().double(), 256 * torch.tensor(weights, dtype=torch.float64), rtol=1e-6, atol=0)


def needles(count, device):
    gaussians = cloud(count, torch.float32, device)
    generator = torch.Generator().manual_seed(4)
    gaussians.log_scales[:] = torch.rand(count, 3, generator=generator) * 5.5 - 6.5
    gaussians.logit_opacities[:] = torch.rand(count, generator=generator) * 9 - 5
    return gaussians


@pytest.mark.parametrize("rule", ["exact", "gsplat-1.5", "inria"])
def test_all_three_passes_draw_the_same_pixels(device, dtype, rule):
    """A colour's gradient is its Gaussian's contribution, and colours times contributions add up to the image."""
    gaussians, cam = needles(400, device), camera(70, 50, cameras=1, dtype=dtype, device=device)
    gaussians.log_scales[:100] = -2.9  # about 3 sigma times 10 px to the edge of a square, which alpha passes by a row
    gaussians = Gaussians(**{n: t.to(dtype) for n, t in gaussians.tensors().items()})
    size = {"width": 70, "height": 50, "rule": RULES[rule]}
    projected, _, made = binned(gaussians, cam, RULES[rule])
    record = projected.detach().requires_grad_()
    rgb, _, _ = calls.blend(record, made, torch.zeros(1, 3, dtype=dtype, device=device), **size)
    (gradient,) = torch.autograd.grad(rgb[..., 0].sum(), record)
    sums, _ = calls.contributions(projected, made, **size)
    near = 1e-4 if dtype == torch.float32 else 1e-12
    assert float((gradient[..., 6] - sums).abs().max()) <= near * float(sums.max())
    shown = (sums.double() * projected[..., 6].double()).sum()
    assert abs(float(rgb[..., 0].detach().double().sum() - shown)) <= near * float(shown)


@pytest.mark.cuda
@pytest.mark.parametrize("tile_size", [8, 16])
@pytest.mark.parametrize("rule", ["exact", "gsplat-1.5", "inria"])
def test_blocks_that_are_left_out_draw_nothing(rule, tile_size):
    """CUDA skips blocks of 8 x 4 pixels where the CPU skips strips: except for alphas at the cut the images agree."""
    rule = dataclasses.replace(RULES[rule], transmittance_stop=0.0)
    found = []
    for device in ("cpu", "cuda:0"):
        gaussians, cam = needles(1500, device), camera(150, 110, cameras=2, dtype=torch.float32, device=device)
        size = {"width": 150, "height": 110, "rule": rule}
        projected, _, made = binned(gaussians, cam, rule, tile_size=tile_size)
        record = projected.detach().requires_grad_()
        rgb, alpha, depth = calls.blend(record, made, torch.zeros(2, 3, device=device), **size)
        fractions = calls.contributions(projected, made, **size)
        (gradient,) = torch.autograd.grad((rgb.sum(-1) + alpha + depth).sum(), record, retain_graph=True)
        (of_rgb,) = torch.autograd.grad(rgb.square().sum(), record)
        found.append([t.detach().cpu().double() for t in (rgb, alpha, *fractions, gradient[..., :10], of_rgb[..., :10])])
    for name, a, b in zip(("rgb", "alpha", "sums", "maxima", "gradient", "gradient of rgb"), *found, strict=True):
        off = (a - b).abs() > 2e-3 * (1 + b.abs())
        assert float(off.double().mean()) < (2e-3 if name.startswith("gradient") else 3e-4), name


# Gradients at their limits, in memory full of NaN: rows that are stored in part, lists of no tile, sums of nothing.

STORED = (1, 3, 4, 5, 8, 9, 16, 20, 25, 28)
ROWS = [(degree, stored) for degree in range(5) for stored in STORED if stored >= (degree + 1) ** 2]


@pytest.mark.parametrize(("degree", "stored"), ROWS)
def test_coefficients_that_are_stored_and_not_used(device, degree, stored):
    """Zero gradients for them, although they are NaN as all memory, and in rows of any length the gradients of what is used."""
    results = []
    for kind, where in ((torch.float32, device), (torch.float64, torch.device("cpu"))):
        g = cloud(150, kind, where, degree=5)
        g.sh[:, (degree + 1) ** 2 :] = math.nan
        g = leaves(dataclasses.replace(g, sh=g.sh[:, :stored].contiguous()))
        cam = camera(40, 30, cameras=2, dtype=kind, device=where)
        with Guarded(2**30):
            projected, counts = run(g, cam, degree=degree)
            upstream = torch.linspace(-1, 1, projected.numel(), dtype=kind, device=where).view(projected.shape)
            found = torch.autograd.grad((projected[..., 6:9] * upstream[..., 6:9]).sum(), [g.sh, g.means])
        used = (degree + 1) ** 2
        assert int((counts > 0).sum()) > 100
        assert not bool(found[0][:, used:].any()) and not bool(found[0][(counts == 0).all(0)].any())
        results.append((projected[..., 6:9], *found))
    for single, double in zip(*results, strict=True):
        close("gradient", single, double)


def of_records(projected, made, rule, only_rgb, deterministic=True, **size):
    record = projected.detach().requires_grad_()
    black = torch.zeros(len(projected), 3, dtype=projected.dtype, device=projected.device)
    with Guarded(2**30):
        rgb, alpha, depth = calls.blend(record, made, black, rule=rule, deterministic=deterministic, **size)
        loss = rgb.sum() if only_rgb else rgb.sum() + (alpha * depth).sum()
        return torch.autograd.grad(loss, record)[0]


@pytest.mark.parametrize("extra", [1, 3, 40])
def test_slots_of_no_tile_add_nothing(device, dtype, extra):
    size = {"width": 96, "height": 80}
    gaussians, cam = cloud(61, dtype, device), camera(**size, cameras=1, dtype=dtype, device=device)
    projected, counts = run(gaussians, cam)
    more = torch.where((counts > 0) & (torch.arange(61, device=device) % 6 == 0), counts + extra, counts)
    assert int((more - counts).sum()) % 2 == 1 or extra == 40
    found = [
        of_records(projected, calls.bin_tiles(projected, c, rule=EXACT, **size), EXACT, False, **size) for c in (counts, more)
    ]
    off = float((found[0] - found[1]).norm()) / float(found[0].norm())
    assert torch.equal(*found) if extra < 40 else off <= 1e-6  # a longer list is summed by a warp, in another order


def test_layers_at_cuts_without_alpha_and_over_a_single_pixel(device, dtype):
    """An alpha at the cut is blended; at the largest alpha the opacity still has its gradient, above it has none."""
    rule = dataclasses.replace(EXACT, alpha_cut=2.0**-8, alpha_max=0.5)
    projected, (_, alpha, _), (_, maxima) = plain([2.0**-8, 2.0**-9, 0.5, 0.75], device, dtype, rule)
    first, second = 2.0**-8, (1 - 2.0**-8) * 0.5
    assert maxima.tolist() == [[first, 0.0, second, second / 2]]
    (gradient,) = torch.autograd.grad(alpha.sum(), projected)
    opened = gradient[0, :, 5] != 0
    assert opened.tolist() == [True, False, True, False]
    # every other one is below the cut, among them the first of each batch of 32
    with Guarded(2**30):
        projected, (rgb, _, _), (sums, maxima) = plain([0.001, 0.02] * 50, device, dtype, EXACT)
        (gradient,) = torch.autograd.grad(rgb.sum(), projected)
    assert not bool(gradient[0, ::2].any()) and not bool(sums[0, ::2].any()) and not bool(maxima[0, ::2].any())
    assert bool((gradient[0, 1::2, 5:9] > 0).all()) and bool((sums[0, 1::2] > 0).all())
    # more layers than are taken at a time; a first layer that crosses the stop
    projected, (_, alpha, _), _ = plain([0.01] * 100, device, dtype, EXACT, side=1)
    assert abs(float(alpha.detach()) - (1 - 0.99**100)) < (1e-5 if dtype == torch.float32 else 1e-12)
    assert bool((torch.autograd.grad(alpha.sum(), projected)[0][0, :, 5] > 0).all())
    assert plain([0.25, 0.5, 0.5], device, dtype, EXACT, side=3)[2][0].tolist() == [[9 * 0.25, 9 * 0.375, 9 * 0.1875]]
    rule = dataclasses.replace(EXACT, transmittance_stop=0.6, inclusive_stop=False)
    projected, (rgb, alpha, depth), (sums, _) = plain([0.5, 0.1], device, dtype, rule)
    assert not bool(alpha.any()) and not bool(sums.any())
    assert not bool(torch.autograd.grad(rgb.sum() + alpha.sum() + depth.sum(), projected)[0].any())
