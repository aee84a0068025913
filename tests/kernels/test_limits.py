"""Adam, neighbours and SSIM at their limits: the last element, the smallest gradient, the narrowest image."""

import math

import pytest
import torch

from tests.reference.adam import adam_reference
from tests.reference.ssim import ssim_reference
from tests.tolerances import close
from warpgs.kernels import ssim as ssim_module
from warpgs.kernels.neighbours import mean_square_distances, morton_codes
from warpgs.kernels.ssim import differences, ssim
from warpgs.kernels.update import adam_step


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


def test_adam_refuses_each_layout_that_it_cannot_update():
    """Parameter and both moments; one element is fine, and so are rows one long."""
    odd, even = torch.zeros(3, 4).T, torch.zeros(4, 3)
    for place in (0, 2, 3):
        given = [even.clone() for _ in range(4)]
        given[place] = odd
        with pytest.raises(ValueError, match="contiguous"):
            adam_step(*given, lr=0.1, step=1)
    one = torch.zeros(1)
    adam_step(one, torch.ones(1), torch.zeros(1), torch.zeros(1), lr=0.1, step=1)
    assert abs(float(one) + 0.1) < 1e-6
    for head, moved in ((0, [-0.1, -0.1]), (1, [-0.2, -0.1])):
        row = torch.zeros(1, 2)
        adam_step(row, torch.ones(1, 2), row * 0, row * 0, lr=0.1, step=1, head_lr=0.2, head=head)
        assert torch.allclose(row, torch.tensor([moved]))


def test_morton_codes_interleave_the_bits():
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


def test_neighbours_are_three_unless_said_and_at_most_eight():
    """The default, the most, one more, and two points."""
    points = torch.rand(70, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.equal(mean_square_distances(points), mean_square_distances(points, 3))
    assert not torch.equal(mean_square_distances(points, 8), mean_square_distances(points, 7))
    with pytest.raises(ValueError, match="k must be 1 to 8, not 9"):
        mean_square_distances(points, 9)
    two = torch.tensor([[0.0, 0, 0], [3.0, 0, 4.0]])
    assert mean_square_distances(two, 1).tolist() == [25.0, 25.0]


def test_groups_of_boxes_are_exact(device):
    """More points than a group holds, in clusters that prune most of them."""
    generator = torch.Generator().manual_seed(3)
    points = torch.randn(2100, 3, generator=generator, dtype=torch.float64)
    points[::2] *= 1e-3
    points[::3] += 5.0
    found = mean_square_distances(points.to(device), 4).cpu()
    distances = torch.cdist(points, points).square().fill_diagonal_(math.inf)
    assert torch.allclose(found, distances.topk(4, largest=False).values.mean(1), rtol=1e-7)


@pytest.mark.parametrize("width", [1, 5, 6, 7])
def test_narrow_pictures_equal_the_same_beside_black(device, width):
    """Columns of zeros beside an image change nothing, since the window finds zeros there; padding is not returned."""
    generator = torch.Generator().manual_seed(width)
    a, b = torch.rand(2, 9, width, 3, generator=generator, dtype=torch.float64).to(device).unbind()
    wide = [torch.nn.functional.pad(t, (0, 0, 0, 20 - width)) for t in (a, b)]
    map_, wanted = ssim(a, b), ssim(*wide)[:, :width]
    assert torch.allclose(map_, wanted, atol=1e-14)
    sums = differences(a, b)
    assert torch.allclose(sums, torch.stack([(1 - wanted).sum(), (a - b).abs().sum()]), atol=1e-12)


@pytest.mark.parametrize("count", [1, 15, 16, 17, 33, 4096, 4097])
def test_adam_takes_every_element(device, dtype, count):
    """One more than a step of lanes or a segment of tasks is not left out."""
    param, grad = torch.zeros(count, 1, dtype=dtype, device=device), torch.ones(count, 1, dtype=dtype, device=device)
    adam_step(param, grad, param.clone(), param.clone(), lr=0.5, step=1)
    assert torch.allclose(param, torch.full_like(param, -0.5))


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


@pytest.mark.parametrize(("height", "width"), [(16, 16), (15, 32), (32, 17), (17, 33), (8, 11)])
def test_pictures_that_fill_the_blocks(device, dtype, height, width):
    """Whole blocks, and one row or column more or less than that, in a batch: map, sums and both gradients."""
    generator = torch.Generator().manual_seed(height)
    a, b = torch.rand(2, 2, height, width, 3, generator=generator, dtype=torch.float64).unbind()
    weights = torch.rand(a.shape, generator=generator, dtype=torch.float64)
    leaf64, leaf = a.clone().requires_grad_(), a.to(device, dtype).requires_grad_()
    wanted = torch.stack([ssim_reference(x, y) for x, y in zip(leaf64, b)])
    found = ssim(leaf, b.to(leaf))
    close("ssim", found, wanted)
    sums = differences(leaf, b.to(leaf))
    both = torch.stack([(1 - wanted).sum(), (leaf64 - b).abs().sum()])
    close("ssim", sums, both)
    maps = (found * weights.to(leaf)).sum(), (wanted * weights).sum()
    for ours, theirs in (maps, (0.3 * sums[0] + 2 * sums[1], 0.3 * both[0] + 2 * both[1])):
        (mine,), (other,) = torch.autograd.grad(ours, leaf), torch.autograd.grad(theirs, leaf64, retain_graph=True)
        close("gradient", mine, other)
