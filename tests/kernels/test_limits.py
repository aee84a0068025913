"""Kernels at their limits: the last element, byte and slot, values equal to a cut-off, memory full of NaN."""

import dataclasses
import math

import pytest
import torch

from bench.lib import kernel_calls as calls
from bench.lib.kernel_calls import adam_step
from tests.gaussians import SMOOTH, camera, cloud, leaves
from tests.kernels.test_project import facing, run
from tests.numerics.test_extreme_compositing import Filled
from tests.reference.blend import blend_reference
from tests.reference.update import adam_reference
from tests.tolerances import close
from warpgs.constants import RULES
from warpgs.errors import ResourceError
from warpgs.kernels import ssim as ssim_module, tiles
from warpgs.kernels.neighbours import mean_square_distances, morton_codes
from warpgs.kernels.ssim import differences, ssim
from warpgs.scene import Gaussians

# Adam, neighbours and SSIM at their limits: the last element, the smallest gradient, the narrowest image.


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


def test_adam_updates_the_smallest_tensors():
    """One element, and rows one long."""
    one = torch.zeros(1)
    adam_step(one, torch.ones(1), torch.zeros(1), torch.zeros(1), lr=0.1, step=1)
    assert abs(float(one) + 0.1) < 1e-6
    for head, moved in ((0, [-0.1, -0.1]), (1, [-0.2, -0.1])):
        row = torch.zeros(1, 2)
        adam_step(row, torch.ones(1, 2), row * 0, row * 0, lr=0.1, step=1, head_lr=0.2, head=head)
        assert torch.allclose(row, torch.tensor([moved]))


def test_morton_codes_interleave_the_bits_and_neighbours_are_three():
    """Bit b of x, y and z are bits 3 b, 3 b + 1 and 3 b + 2; the box takes 2^21 cells a side."""
    cells = torch.randint(0, 2**21, (500, 3), generator=torch.Generator().manual_seed(0))
    cells[0], cells[1] = 0, 2**21 - 1
    side = 2.0**21 - 1
    points = (cells.double() + 0.25).clamp_max(side) * 3 - 7
    points[0] = -7.0
    wanted = torch.zeros(500, dtype=torch.int64)
    for b in range(21):
        for axis in range(3):
            wanted |= ((cells[:, axis] >> b) & 1) << (3 * b + axis)
    assert torch.equal(morton_codes(points), wanted)
    points = torch.rand(70, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.equal(mean_square_distances(points), mean_square_distances(points, 3))
    assert not torch.equal(mean_square_distances(points, 8), mean_square_distances(points, 7))
    two = torch.tensor([[0.0, 0, 0], [3.0, 0, 4.0]])
    assert mean_square_distances(two, 1).tolist() == [25.0, 25.0]


@pytest.mark.parametrize(("width", "ways"), [(5, 0), (6, 1), (40, 1)])
def test_sums_take_one_pass_where_a_row_fills_a_step(monkeypatch, width, ways):
    """Elsewhere the map is added up."""
    taken = []
    inner = ssim_module._Ssim.apply
    monkeypatch.setattr(ssim_module._Ssim, "apply", lambda *a: taken.extend([1] * a[2]) or inner(*a))
    a, b = torch.rand(2, 7, width, 3, generator=torch.Generator().manual_seed(0)).unbind()
    sums = differences(a, b)
    assert len(taken) == ways
    assert torch.allclose(sums, torch.stack([(1 - ssim(a, b)).sum(), (a - b).abs().sum()]), rtol=1e-5)


def test_a_pixel_reaches_five_pixels(device):
    """A change of one changes the map around it alone, and so does an upstream gradient: each pixel of an image in turn."""
    side = 38  # three blocks each way
    a, b = torch.rand(2, side, side, 3, generator=torch.Generator().manual_seed(0)).to(device).unbind()
    rows, columns = (t.flatten() for t in torch.meshgrid(*[torch.arange(side)] * 2, indexing="ij"))
    far = ((rows[:, None] - rows).abs() > 5) | ((columns[:, None] - columns).abs() > 5)  # [touched, seen]
    wanted = ssim(a, b)
    for few in torch.arange(side * side).chunk(8):
        many = a.expand(len(few), -1, -1, -1).clone()
        many.view(len(few), -1, 3)[torch.arange(len(few)), few] += 50
        changed = (ssim(many, b.expand_as(many)) != wanted).view(len(few), -1, 3).any(-1).cpu()
        assert not bool((changed & far[few]).any()) and bool(changed[torch.arange(len(few)), few].all())
        found = ssim(many.requires_grad_(), b.expand_as(many)).view(len(few), -1, 3)[torch.arange(len(few)), few]
        (gradient,) = torch.autograd.grad(found.sum(), many)
        assert not bool((gradient.view(len(few), -1, 3) != 0).any(-1).cpu()[far[few]].any())


# Lists and blending at their limits: the last byte, the last slot, an alpha or transmittance equal to a cut-off.

EXACT = RULES["exact"]


def test_one_running_sum_holds_both_numbers():
    """The largest sum of each number of Gaussians stays below 2^63, and every number of instances that is allowed fits."""
    for count in (1, 2, 3, 4095, 4096, 2_794_625, 2**23, 2**31 - 1):
        unit = 2 ** tiles.sum_bits(count)
        assert unit > tiles.MAX_INSTANCES and count * unit + unit - 1 < 2**63
        assert tiles.split_sum(count * unit + unit - 1, count) == (count, unit - 1)
    assert tiles.sums_fit(2_794_625, 240 * 135)  # 3840 x 2160 px
    assert tiles.sums_fit(2**23, 2**16 - 1) and not tiles.sums_fit(2**23, 2**16)


def test_budget_is_met_to_the_byte(monkeypatch):
    """As many instances as fit are allowed, one more is not; so are 2^30 - 1, and no more."""
    cpu = torch.device("cpu")
    tiles._check_total(1000, 1, cpu, 1, 148_000)
    with pytest.raises(ResourceError, match=r"1001 of 7 tiles .* 1,001 .* need 145 KiB, and the limit is 145 KiB"):
        tiles._check_total(1001, 1, cpu, 7, 148_000)
    tiles._check_total(2**30 - 1, 2**30 - 1, cpu, 1, 2**60)
    with pytest.raises(ResourceError, match=r"the limit is 1,073,741,823 instances\. Many"):
        tiles._check_total(2**30, 1, cpu, 1, 2**60)
    with pytest.raises(ResourceError, match=r"the limit is 1,073,741,823 instances\. Many"):
        tiles._check_total(2**30, 1, cpu, 1, None)
    with pytest.raises(ResourceError, match=r"need 148\.0 GiB, and the limit is 1\.0 GiB"):
        tiles._check_total(2**30 - 1, 1, cpu, 1, 2**30)
    # from a twentieth of the machine on four fifths of what is free is the limit
    cpu = torch.device("cpu")
    asked = []
    monkeypatch.setattr("warpgs.device.installed_bytes", lambda _: 20 * 148_000)
    monkeypatch.setattr("warpgs.device.available_bytes", lambda _: asked.append(1) or 5 * 37_000)
    tiles._check_total(999, 1, cpu, 1, None)
    assert not asked
    tiles._check_total(1000, 1, cpu, 1, None)
    assert asked
    with pytest.raises(ResourceError):
        tiles._check_total(1001, 1, cpu, 1, None)
    asked.clear()
    monkeypatch.setattr("warpgs.device.installed_bytes", lambda _: 2**60)
    tiles._check_total(2**30 - 1, 1, cpu, 1, None)
    assert not asked


@pytest.mark.parametrize("fits", [True, False])
def test_counted_apart_where_one_sum_might_not_hold_both(monkeypatch, fits):
    """Instances are counted apart from as many (Gaussian, tile) pairs on as a sum can hold."""
    projected, counts = torch.zeros(2, 5, 12), torch.ones(2, 5, dtype=torch.int32)  # 10 Gaussians, 6 tiles

    def stop(word):
        def work(*_, **__):
            raise InterruptedError(word)

        return work

    monkeypatch.setattr(tiles, "sums_fit", lambda count, per_camera: fits and (count, per_camera) == (10, 6))
    monkeypatch.setattr(tiles, "_check_total", stop("apart"))
    monkeypatch.setattr(tiles.launch, "launch", stop("together"))
    with pytest.raises(InterruptedError, match="together" if fits else "apart"):
        calls.bin_tiles(projected, counts, width=48, height=30, rule=EXACT)


def binned(gaussians, cam, rule=EXACT, **options):
    """Return projected Gaussians, their counts and their tiles."""
    projected, counts = run(gaussians, cam, rule, **options)
    return projected, counts, calls.bin_tiles(projected, counts, width=cam.width, height=cam.height, rule=rule, **options)


def one_a_tile(device, columns=3, rows=3):
    """A Gaussian of 1 px in the middle of each tile of 16 px."""
    gaussians, cam = facing(columns * rows, device=device, size=16 * columns)
    K = cam.K[0]
    for i in range(columns * rows):
        pixel = torch.tensor([16.0 * (i % columns) + 8.5, 16.0 * (i // columns) + 8.5], device=device)
        gaussians.means[i, :2] = (pixel - K[:2, 2]) / torch.stack([K[0, 0], K[1, 1]])
        gaussians.means[i, 2] = 1.0
    return gaussians, cam


def test_nothing_has_no_length(device):
    """No Gaussians, and none that is seen: every list is empty and the total is 0."""
    for gaussians in (cloud(0, device=device), cloud(3, device=device)):
        cam = camera(40, 30, cameras=1, dtype=torch.float32, device=device)
        gaussians.means[:, 2] = -4.0
        _, _, made = binned(gaussians, cam)
        assert [len(t) for t in (made.gaussian_ids, made.slots, made.tile_ids)] == [0, 0, 0]
        assert len(made.starts) == len(made.counts) == len(gaussians.means) and made.total.tolist() == [0]


def test_tiles_of_one_instance_each_with_wrong_counts_and_little_capacity(device):
    """Every instance begins and ends a tile; the default tile is 16 px."""
    gaussians, cam = one_a_tile(device)
    projected, counts, made = binned(gaussians, cam)
    assert made.size == 16 and made.ranges.tolist() == [[i, i + 1] for i in range(9)]
    assert made.gaussian_ids.tolist() == list(range(9)) and made.total.tolist() == [9]
    assert torch.equal(counts, run(gaussians, cam, tile_size=16)[1])
    single = calls.bin_tiles(projected[:, 4:5], counts[:, 4:5], width=48, height=48, rule=EXACT)
    assert single.total.tolist() == [1] and single.ranges[4].tolist() == [0, 1] and single.gaussian_ids.tolist() == [0]
    # one counted too many belongs to no tile, one too few is left out; nobody else's slots are touched
    more, fewer = counts.clone(), counts.clone()
    more[0, 3] += 1
    fewer[0, 3] -= 1
    size = {"width": 48, "height": 48, "rule": EXACT}
    made = calls.bin_tiles(projected, more, **size)
    assert made.ranges.tolist() == [[i, i + 1] for i in range(9)] and made.tile_ids.tolist() == list(range(10))
    assert sorted(made.slots.tolist()) == list(range(10)) and made.gaussian_ids.tolist()[:9] == list(range(9))
    made = calls.bin_tiles(projected, fewer, **size)
    assert made.gaussian_ids.tolist() == [0, 1, 2, 4, 5, 6, 7, 8] and made.ranges[3].tolist() in ([0, 0], [3, 3])
    # an exact capacity is no overflow; one less is, and the cut lists fit
    gaussians.log_scales.add_(2.2)  # several tiles each
    projected, counts = run(gaussians, cam)
    total = int(counts.sum())
    assert int(counts.min()) > 2
    for capacity in (total, total - 1, total - 2, total // 2):
        mine, overflow = counts.clone(), torch.zeros(1, dtype=torch.int32, device=device)
        memory = tiles.InstanceMemory(capacity=capacity, overflow=overflow)
        made = calls.bin_tiles(projected, mine, width=48, height=48, rule=EXACT, memory=memory)
        assert int(overflow) == (capacity < total)
        assert int(made.counts.sum()) == capacity and len(made.gaussian_ids) == capacity


def plain(opacities, device, dtype, rule, side=16):
    """Flat layers, one behind another, whose alpha is the opacity to the bit, over one tile; needs their gradient."""
    count = len(opacities)
    projected = torch.zeros(1, count, 12, dtype=dtype)
    projected[0, :, 5] = torch.tensor(opacities, dtype=dtype)
    projected[0, :, 6:9] = 1.0
    projected[0, :, 9] = torch.arange(1, count + 1)
    projected[0, :, 10:] = 100.0
    projected = projected.to(device).requires_grad_()
    numbers = torch.arange(count, dtype=torch.int32, device=device)
    ranges = torch.tensor([[0, count]], dtype=torch.int32, device=device)
    made = tiles.Tiles(
        16, ranges, numbers, numbers, numbers, torch.ones_like(numbers), numbers * 0, torch.tensor([count], device=device)
    )
    black = torch.zeros(1, 3, dtype=dtype, device=device)
    images = calls.blend(projected, made, black, width=side, height=side, rule=rule)
    fractions = calls.contributions(projected, made, width=side, height=side, rule=rule)
    return projected, images, fractions


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


@pytest.mark.parametrize("rule", ["gsplat-1.5", "inria"])
def test_nothing_is_drawn_behind_a_stop(device, dtype, rule):
    """A layer that would take transmittance below the stop ends the pixel, also for fainter ones behind it."""
    opacities = [0.98, 0.98, 0.9, 0.01, 0.5, 0.005]
    projected, (rgb, alpha, _), (_, maxima) = plain(opacities, device, dtype, RULES[rule])
    # the reference has no flat layers: 10^12 px wide ones are as good
    count = len(opacities)
    columns = torch.tensor(opacities, dtype=torch.float64), torch.ones(count, 3), torch.arange(1.0, count + 1)
    wide = torch.full((count, 2), 8.0, dtype=torch.float64), torch.eye(2, dtype=torch.float64).expand(count, 2, 2) * 1e24
    wanted = blend_reference(*wide, *(t.double() for t in columns), torch.zeros(3).double(), 16, 16, RULES[rule])
    assert (wanted[3].sum((1, 2)) > 0).tolist() == [True, True, False, False, False, False]
    close("image", rgb[0], wanted[0])
    close("image", alpha[0], wanted[1])
    close("gradient", maxima[0], wanted[3].amax((1, 2)))
    (gradient,) = torch.autograd.grad(rgb[..., 0].sum(), projected)
    close("gradient", gradient[0, :, 6], wanted[3].sum((1, 2)))


def needles(count, device):
    """Long and round Gaussians of many sizes and opacities, from a fraction of a pixel to the whole image."""
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


@pytest.mark.cuda
@pytest.mark.parametrize("tile_size", [8, 16])
def test_blocks_at_needles_far_longer_than_the_picture(tile_size):
    """Needles with half widths up to 70,000 px: the same pixels are covered as on the CPU, which leaves out no block."""
    found = []
    for device in ("cpu", "cuda:0"):
        gaussians, cam = needles(300, device), camera(150, 110, cameras=2, dtype=torch.float32, device=device)
        gaussians.log_scales[:] = torch.tensor([6.5, -4.0, -4.0])
        gaussians.logit_opacities[:] = -4.0
        projected, _, made = binned(gaussians, cam, tile_size=tile_size)
        assert int((projected[..., 10] > 2e4).sum()) > 100  # half widths
        black = torch.zeros(2, 3, device=device)
        found.append(calls.blend(projected, made, black, width=150, height=110, rule=EXACT)[1].cpu())
    off = (found[0] - found[1]).abs() > 2e-3
    assert int((found[0] > 0).sum()) > 1000 and int(off.sum()) <= 3


@pytest.mark.cuda
@pytest.mark.parametrize("tile_size", [8, 16])
def test_lists_are_those_of_the_cpu(tile_size):
    """Gaussians of no tile, of a few, of 32 and of hundreds; windows, cameras and a capacity."""
    found = []
    for device in ("cpu", "cuda:0"):
        gaussians, cam = needles(700, device), camera(300, 210, cameras=2, dtype=torch.float32, device=device)
        gaussians = Gaussians(**{n: t.double() for n, t in gaussians.tensors().items()})
        cam = dataclasses.replace(cam, viewmat=cam.viewmat.double(), K=cam.K.double())
        for x, y, width, height in ((0, 0, 300, 210), (48, 32, 200, 160)):
            projected, counts = run(gaussians, cam, window=(x, y, width, height), tile_size=tile_size)
            how = {"width": width, "height": height, "rule": EXACT, "tile_size": tile_size, "origin": (x, y)}
            made = calls.bin_tiles(projected, counts, **how)
            overflow = torch.zeros(1, dtype=torch.int32, device=device)
            memory = tiles.InstanceMemory(capacity=len(made.slots) + 50, overflow=overflow)
            spare = calls.bin_tiles(projected, counts, **how, memory=memory)
            assert int(counts.max()) > 100 and {31, 32, 33} & set(counts.view(-1).tolist())
            for m in (made, spare):
                count = int(m.total)
                found.append([m.ranges, m.gaussian_ids[:count], m.tile_ids[:count], m.counts, m.total])
    half = len(found) // 2
    for a, b in zip(found[:half], found[half:], strict=True):
        assert all(torch.equal(s.cpu(), t.cpu()) for s, t in zip(a, b, strict=True))


# Gradients at their limits, in memory full of NaN: rows that are stored in part, lists of no tile, sums of nothing.

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
        rgb, alpha, depth = calls.blend(record, made, black, rule=rule, deterministic=deterministic, **size)
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
        projected, counts, made = binned(g, view, SMOOTH if only_rgb else EXACT, tile_size=8)
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
    with Filled(math.nan, 0):
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


def test_depth_where_every_weight_is_zero(device, dtype):
    """Without a cut a Gaussian is listed everywhere, and far away its weight is 0: depth 0, and gradients are numbers."""
    size = {"width": 64, "height": 64}
    gaussians, cam = facing(2, dtype, device, size=64)
    projected, _, made = binned(gaussians, cam, SMOOTH)
    record = projected.detach().requires_grad_()
    black = torch.zeros(1, 3, dtype=dtype, device=device)
    depth = calls.blend(record, made, black, rule=SMOOTH, **size)[2]
    empty = depth == 0
    assert bool(empty.any()) or (dtype, device.type) == (torch.float32, "cpu")  # whose exponential does not reach 0
    (gradient,) = torch.autograd.grad(depth[empty].sum() + depth[0, 8, 8], record)
    assert bool(torch.isfinite(gradient).all()) and abs(float(gradient[0, :, 9].sum()) - 1) < 1e-5


@pytest.mark.parametrize("count", [255, 256, 257])
def test_as_many_gaussians_as_a_block_has_threads(device, count):
    """With one more or fewer, too, each is listed and has its gradient."""
    gaussians, cam = facing(count, device=device)
    gaussians.logit_opacities[:] = -4.0
    size = {"width": 16, "height": 16}
    projected, _, made = binned(gaussians, cam)
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
    both = calls.bin_tiles(projected, counts, **size)
    assert both.total.tolist() == [101] and (both.ranges[:, 1] - both.ranges[:, 0]).tolist() == [2] + [1] * 99
    alone = calls.bin_tiles(projected[:, :1], counts[:, :1], **size)
    assert alone.ranges.tolist() == [[i, i + 1] for i in range(100)]
    short = calls.bin_tiles(projected, counts - torch.tensor([[1, 0]], dtype=torch.int32, device=device), **size)
    assert sorted(short.gaussian_ids.tolist()) == [0] * 99 + [1] and short.tile_ids.tolist() == [0, *range(99)]
    tall = dataclasses.replace(cam, width=16, height=640)
    projected, counts, made = binned(Gaussians(**{n: t[:1] for n, t in gaussians.tensors().items()}), tall)
    assert counts.tolist() == [[40]] and made.ranges.tolist() == [[i, i + 1] for i in range(40)]
