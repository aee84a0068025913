"""Binning: every tile that a Gaussian contributes to is listed, in depth order, within the budget."""

import pytest
import torch
import warp as wp

from bench.lib.kernel_calls import bin_tiles, blend, contributions, project
from tests.gaussians import SMOOTH, camera, cloud
from tests.reference.project import project_reference
from tests.reference.tiles import touched_reference
from warpgs.constants import RULES
from warpgs.kernels import launch
from warpgs.kernels.tiles import (
    EACH,
    InstanceMemory,
    make_find_ranges,
    make_kernels,
    running_counts,
    split_sum,
    sum_bits,
    sum_entries,
)

EXACT = RULES["exact"]
SIZES = [(1, 1), (1, 17), (17, 1), (15, 15), (16, 16), (17, 17), (33, 47), (97, 129)]


def binned(gaussians, cam, rule=EXACT, tile_size=16, degree=1, **options):
    size = {"width": cam.width, "height": cam.height}
    projected, counts = project(
        *gaussians.tensors().values(), cam.viewmat, cam.K, **size, degree=degree, rule=rule, tile_size=tile_size
    )
    return projected, counts, bin_tiles(projected, counts, **size, tile_size=tile_size, rule=rule, **options)


def listed(tiles, camera_count, per_camera):
    result = [set() for _ in range(camera_count * per_camera)]
    for tile, (begin, end) in enumerate(tiles.ranges.tolist()):
        for i in tiles.gaussian_ids[begin:end].tolist():
            result[i].add(tile)
    return result


@pytest.mark.parametrize(("width", "height"), SIZES)
@pytest.mark.parametrize("tile_size", [8, 16])
def test_every_drawn_tile_is_listed(device, width, height, tile_size):
    """The lists are a superset of what a look at every pixel finds, and at most slightly larger."""
    gaussians, cam = cloud(150, torch.float64, device), camera(width, height, cameras=2, device=device)
    _, counts, tiles = binned(gaussians, cam, tile_size=tile_size)
    tensors = [t.cpu() for t in gaussians.tensors().values()]
    means, covs, _, depths, opacities = project_reference(
        *tensors, cam.viewmat.cpu(), cam.K.cpu(), width=width, height=height, degree=1, low_pass=EXACT.low_pass
    )
    columns, rows = -(-width // tile_size), -(-height // tile_size)
    found = listed(tiles, 2, 150)
    needed_total = 0
    for c in range(2):
        touched = touched_reference(means[c], covs[c], opacities, width, height, tile_size, EXACT.alpha_cut)
        for i, needed in enumerate(touched):
            if depths[c, i] >= EXACT.near:
                wanted = {c * columns * rows + row * columns + column for row, column in needed}
                assert wanted <= found[c * 150 + i]
                needed_total += len(wanted)
    assert sum(map(len, found)) == int(counts.sum()) == len(tiles.gaussian_ids)
    assert sum(map(len, found)) <= 1.1 * needed_total + 30


@pytest.mark.parametrize("extra", [1, 3, 40])
def test_tiles_that_are_counted_and_not_found_are_no_tiles(device, extra):
    """A count above what a Gaussian touches, as rounding may give, leaves marked slots and the same lists."""
    gaussians, cam = cloud(60, device=device), camera(96, 80, 1, torch.float32, device)
    size = {"width": 96, "height": 80, "rule": EXACT}
    projected, counts = project(*gaussians.tensors().values(), cam.viewmat, cam.K, degree=1, **size)
    wanted = bin_tiles(projected, counts, **size)
    more = torch.where((counts > 0) & (torch.arange(60, device=device) % 3 == 0), counts + extra, counts)
    tiles = bin_tiles(projected, more, **size)
    length, added = int(wanted.total), int((more - counts).sum())
    assert added > 0 and int(tiles.total) == length + added
    assert torch.equal(tiles.ranges, wanted.ranges) and torch.equal(tiles.gaussian_ids[:length], wanted.gaussian_ids)
    assert bool((tiles.tile_ids[length:] == len(tiles.ranges)).all())
    assert torch.equal(tiles.slots.sort().values, torch.arange(length + added, dtype=torch.int32, device=device))


def test_every_tile_is_listed_without_a_cut(device):
    gaussians, cam = cloud(5, torch.float32, device), camera(40, 40, cameras=1, dtype=torch.float32, device=device)
    _, _, tiles = binned(gaussians, cam, SMOOTH)
    assert tiles.ranges.cpu().tolist() == [[5 * i, 5 * i + 5] for i in range(9)]


def test_lists_without_slots_are_the_same(device):
    gaussians, cam = cloud(300, torch.float32, device), camera(64, 48, cameras=2, dtype=torch.float32, device=device)
    projected, _, tiles = binned(gaussians, cam)
    bare = binned(gaussians, cam, slotted=False)[2]
    assert len(bare.slots) == 0 and torch.equal(bare.ranges, tiles.ranges)
    assert torch.equal(bare.gaussian_ids, tiles.gaussian_ids)
    size = {"width": cam.width, "height": cam.height, "rule": EXACT}
    backgrounds = torch.rand(2, 3, device=device)
    for one, other in zip(blend(projected, bare, backgrounds, **size), blend(projected, tiles, backgrounds, **size)):
        assert torch.equal(one, other)
    with pytest.raises(ValueError, match="tiles with slots"):
        blend(projected.requires_grad_(), bare, backgrounds, **size)
    with pytest.raises(ValueError, match="tiles with slots"):
        contributions(projected, bare, **size)


def test_room_for_visible_gaussians_changes_no_list(device):
    """As many as there are, more, and all; with less, what is written stays inside."""
    gaussians, cam = cloud(300, torch.float32, device), camera(64, 48, cameras=2, dtype=torch.float32, device=device)
    gaussians.means[::3, 2] = -4.0  # behind the cameras
    projected, counts, wanted = binned(gaussians, cam)
    seen, total = int((counts > 0).sum()), int(counts.sum())
    assert 300 < seen < 550
    sums = running_counts(counts.view(-1), wp.float32)
    assert split_sum(int(sums[-1]), counts.numel()) == (seen, total)
    for room, spare in ((seen, 9), (seen + 1, 3000), (550, 0), (600, 9), (seen - 1, 9), (1, 9)):
        overflow = torch.zeros(1, dtype=torch.int32, device=device)
        memory = InstanceMemory(capacity=total + spare, overflow=overflow, visible=(sums, room))
        made = bin_tiles(projected, counts, width=64, height=48, rule=EXACT, memory=memory)
        assert made.visible == room and int(made.total) <= total
        assert bool((made.tile_ids[int(made.total) :] == len(made.ranges)).all())  # the rest is no tile's
        if room >= seen:
            assert torch.equal(made.ranges, wanted.ranges) and int(made.total) == total
            assert torch.equal(made.gaussian_ids[:total], wanted.gaussian_ids) and torch.equal(made.slots[:total], wanted.slots)
            assert torch.equal(made.starts[counts.view(-1) > 0], wanted.starts[counts.view(-1) > 0])
    # two numbers in one sum, against numbers counted apart, where the instances exceed 2^37
    counts = torch.tensor([0, 2**31 - 1, 1, 0, 5] * 70, dtype=torch.int32, device=device)
    seen, total = int((counts > 0).sum()), int(counts.sum(dtype=torch.int64))
    assert total > 2**37
    assert split_sum(int(running_counts(counts, wp.float32)[-1]), len(counts)) == (seen, total)


@pytest.mark.parametrize("slotted", [True, False])
@pytest.mark.parametrize("count", [1, 4, 5, 1030])
def test_ranges_by_four_instances_a_thread(device, count, slotted):
    """Ranges and Gaussian numbers of sorted keys, against a search; the last keys are no tile's."""
    generator, no_tile = torch.Generator().manual_seed(count), 60
    keys = torch.randint(no_tile + 5, (count,), generator=generator).clamp(max=no_tile).sort().values.int().to(device)
    slots, owners = (torch.randperm(count, generator=generator).int().to(device) for _ in range(2))
    tiles = torch.arange(no_tile, dtype=torch.int32, device=device)
    begin, end = torch.searchsorted(keys, tiles).int(), torch.searchsorted(keys, tiles, right=True).int()
    for native in (True, False):
        each = EACH if native else 1
        ids, ranges = torch.full((count,), -1, dtype=torch.int32, device=device), torch.zeros_like(tiles)[:, None].repeat(1, 2)
        ints = [keys, slots, owners, ids, ranges]
        launch.launch(make_find_ranges(slotted, native), -(-count // each), [*ints[:3], count, no_tile, *ints[3:]], device)
        empty = begin == end
        assert torch.equal(ranges[~empty], torch.stack([begin, end], 1)[~empty]) and not ranges[empty].any()
        inside = keys < no_tile
        assert torch.equal(ids[inside], owners[slots.long()][inside] if slotted else torch.full_like(ids, -1)[inside])
        assert not ids[~inside].any()


@pytest.mark.parametrize("count", [1, 31, 129, 1024, 5000])
def test_visible_ones_come_first_and_in_order(device, count):
    """Keys and numbers of the visible Gaussians, then of the others as far as there is room."""
    generator = torch.Generator().manual_seed(count)
    counts = (torch.randint(3, (count,), generator=generator).int() * 7).to(device)
    projected = torch.rand(count, 12, generator=generator).to(device)
    kernels, native = make_kernels(wp.float32, counts.is_cuda), counts.is_cuda
    sums = running_counts(counts, wp.float32)
    seen = int((counts > 0).sum())
    order = torch.cat([torch.nonzero(counts > 0)[:, 0], torch.nonzero(counts == 0)[:, 0]])
    wanted = torch.where(counts[order] > 0, projected[order, 9], torch.inf)
    for limit in (count, seen, seen // 2):
        keys, ids = torch.zeros(count, device=device), torch.full((count,), -1, dtype=torch.int32, device=device)
        inputs = [projected, counts, sums]
        inputs += [sum_bits(count), limit, keys, ids]
        launch.launch(kernels.visible_keys, sum_entries(count, native)[1], inputs, device)
        assert torch.equal(keys[:limit], wanted[:limit]) and torch.equal(ids[:limit].long(), order[:limit])
        assert not keys[limit:].any() and bool((ids[limit:] == -1).all())


@pytest.mark.cuda
def test_cuda_lists_are_those_of_the_cpu():
    """Gaussians of one tile beside some of a thousand, also over several batches of rows: slot for slot the CPU's lists."""
    gaussians, cam = cloud(500, torch.float32), camera(640, 720, cameras=2, dtype=torch.float32)
    gaussians.log_scales[::7] += 3.0
    projected, counts, _ = binned(gaussians, cam)
    assert int(counts.max()) > 1000
    size = {"width": cam.width, "height": cam.height, "rule": EXACT}
    for slotted in (True, False):
        found = bin_tiles(projected.cuda(), counts.cuda(), slotted=slotted, **size)
        wanted = bin_tiles(projected, counts, slotted=slotted, **size)
        listed_ones = counts.view(-1) > 0  # the others have no start
        assert torch.equal(found.starts.cpu()[listed_ones], wanted.starts[listed_ones])
        for name in ("ranges", "gaussian_ids", "slots", "counts", "tile_ids", "total"):
            assert torch.equal(getattr(found, name).cpu(), getattr(wanted, name))
