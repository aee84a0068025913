"""Binning and sorting at the limits of their numbers, and pictures of extreme sizes (docs/numerics.md)."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from bench.lib.kernel_calls import bin_tiles, project
from tests.gaussians import camera, cloud
from warpgs.constants import RULES
from warpgs.errors import ResourceError
from warpgs.kernels import launch
from warpgs.kernels.tiles import InstanceMemory
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians

EXACT = RULES["exact"]
FOCAL = 1e4
"""So long [px] that a Gaussian at the edge of any picture here is as round as one in the middle."""


def spots(pixels: list[tuple[float, float]], sigma: float, device) -> Gaussians:
    at = torch.tensor(pixels, dtype=torch.float64)
    count = len(at)
    quats = torch.zeros(count, 4, dtype=torch.float64)
    quats[:, 0] = 1
    tensors = {
        "means": torch.cat([at / FOCAL, torch.ones(count, 1, dtype=torch.float64)], 1),
        "quats": quats,
        "log_scales": torch.full((count, 3), float(np.log(sigma / FOCAL)), dtype=torch.float64),
        "logit_opacities": torch.full((count,), 2.0, dtype=torch.float64),
        "sh": torch.ones(count, 1, 3, dtype=torch.float64),
    }
    return Gaussians(**{n: t.to(device, torch.float32) for n, t in tensors.items()})


def plain(width: int, height: int, device) -> Camera:
    """A camera at the origin whose principal point is the picture's corner."""
    K = torch.tensor([[FOCAL, 0, 0], [0, FOCAL, 0], [0, 0, 1.0]], device=device)
    return Camera(torch.eye(4, device=device), K, width, height)


def binned(gaussians: Gaussians, cam: Camera, rule=EXACT, tile_size: int = 16, **options):
    size = {"width": cam.width, "height": cam.height, "tile_size": tile_size, "rule": rule}
    projected, counts = project(*gaussians.tensors().values(), cam.viewmat[None], cam.K[None], degree=0, **size)
    return projected, counts, bin_tiles(projected, counts, **size, **options)


@pytest.mark.slow
def test_full_screen_gaussians_at_4k_are_listed(device):
    """The same with memory enough (2 GB): every tile lists all 3000, in order."""
    gaussians = spots([(1920.0, 1080.0)] * 3000, 4000.0, device)
    _, counts, tiles = binned(gaussians, plain(3840, 2160, device), memory=InstanceMemory(2**40))
    assert int(counts.sum()) == len(tiles.slots) == 97_200_000
    lengths = tiles.ranges[:, 1] - tiles.ranges[:, 0]
    assert bool((lengths == 3000).all())
    ids = tiles.gaussian_ids.view(-1, 3000)
    assert bool((ids == torch.arange(3000, dtype=torch.int32, device=device)).all())


def test_counts_and_sizes_beyond_their_bits_are_refused(device):
    """140,000 Gaussians over all tiles of 8K, more instances than a packed sum holds: their number is right in the error."""
    projected = torch.zeros(1, 140_000, 12, device=device)
    counts = torch.full((1, 140_000), 518_400, dtype=torch.int32, device=device)
    with pytest.raises(ResourceError, match=r"72,576,000,000 .Gaussian, tile. instances need 9.8 TiB"):
        bin_tiles(projected, counts, width=7680, height=4320, tile_size=8, rule=EXACT)
    # an axis, a launch and a number of tiles that would wrap around
    huge = torch.zeros(1, device=device).expand(2**31)
    with pytest.raises(ResourceError, match=r"2,147,483,648 entries.* fewer Gaussians"):
        launch.as_array(huge, None, 1)
    with pytest.raises(ResourceError, match=r"2,147,483,648 entries"):
        launch.launch(None, 2**31, [], device)
    launch._check_size(2**31 - 1)
    projected, counts = torch.zeros(1, 0, 12, device=device), torch.zeros(1, 0, dtype=torch.int32, device=device)
    with pytest.raises(ResourceError, match="have too many tiles; render fewer at once"):
        bin_tiles(projected, counts, width=8 * 2**16, height=8 * 2**15, tile_size=8, rule=EXACT)


def test_a_refused_size_leaves_a_recorded_launch_as_it_was():
    """A recorded launch that was refused an argument takes the next one whole, at the same address and of the same size too."""
    recorded, packed = launch._Recorded.__new__(launch._Recorded), SimpleNamespace(ndim=1, data=0, shape=[0])
    recorded.command = SimpleNamespace(bounds=SimpleNamespace(size=1), params=[None, None, packed], set_dim=lambda _: None)
    recorded.known, recorded.dtypes, recorded.device = [None], [torch.float32], SimpleNamespace(is_cuda=False)
    recorded.declared = [(None, 1)]
    small, other = torch.zeros(5), torch.zeros(6)
    recorded._patch(1, [small])
    with pytest.raises(ResourceError, match="2,147,483,648 entries"):
        recorded._patch(1, [other[:1].expand(2**31)])
    recorded._patch(1, [small])
    assert packed.data == small.data_ptr() and packed.shape == [5]


@pytest.mark.parametrize("tiles", [1, 2, 3, 127, 128, 129, 257])
def test_tile_numbers_of_every_bit_length(device, tiles):
    """A row of tiles, one Gaussian in each: each tile lists its own, the first and the last tile too."""
    gaussians = spots([(8.0 + 16 * i, 8.0) for i in range(tiles)], 1.0, device)
    _, counts, lists = binned(gaussians, plain(16 * tiles, 16, device))
    assert bool((counts == 1).all())
    assert torch.equal(lists.gaussian_ids.cpu(), torch.arange(tiles, dtype=torch.int32))
    assert lists.ranges.tolist() == [[i, i + 1] for i in range(tiles)]


def test_depths_are_sorted_as_numpy_sorts_them(device, dtype):
    """Depths one rounding apart, in float64 too, in the order of a stable sort; the near plane is positive, so all bits are."""
    count = 5000
    generator = torch.Generator().manual_seed(0)
    gaussians = spots([(8.0, 8.0)] * count, 1.0, device)
    step = torch.finfo(dtype).eps
    depths = (1 + step * torch.randint(0, 64, (count,), generator=generator).to(dtype)).to(device)
    tensors = {n: t.to(dtype) for n, t in gaussians.tensors().items()}
    tensors["means"] = tensors["means"].clone()
    tensors["means"][:, 2] = depths
    cam = plain(16, 16, device)
    cam = dataclasses.replace(cam, viewmat=cam.viewmat.to(dtype), K=cam.K.to(dtype))
    _, _, lists = binned(Gaussians(**tensors), cam)
    assert np.array_equal(lists.gaussian_ids.cpu().numpy(), np.argsort(depths.cpu().numpy(), kind="stable"))


def test_emitted_equals_counted(device):
    """A million random Gaussians, 1e-7 to 1e4 px large, on and off the picture: no slot is left over, none is missing."""
    total, generator = 0, torch.Generator().manual_seed(1)
    for _ in range(4):
        count = 250_000

        def rand(*shape):
            return torch.rand(*shape, generator=generator)

        size = torch.pow(10.0, rand(count, 1) ** 4 * 9 - 7)
        tensors = {
            "means": (rand(count, 3) - 0.5) * torch.tensor([6.0, 5.0, 2.0]) + torch.tensor([0.0, 0.0, 3.0]),
            "quats": rand(count, 4) - 0.5,
            "log_scales": torch.log(size * (0.01 + rand(count, 3)) / 100),
            "logit_opacities": 8 * rand(count) - 6,
            "sh": rand(count, 1, 3),
        }
        gaussians = Gaussians(**{n: t.to(device) for n, t in tensors.items()})
        cam = camera(97, 65, dtype=torch.float32, device=device)
        _, counts, lists = binned(gaussians, cam)
        tiles = len(lists.ranges)
        assert len(lists.slots) == int(counts.sum())
        lengths = lists.ranges[:, 1] - lists.ranges[:, 0]
        # what was counted and not found again carries the number past the last tile; on one device both are one function
        unfound = int((lists.tile_ids == tiles).sum())
        assert int(lengths.sum()) + unfound == len(lists.slots) and unfound <= len(lists.slots) // 10**5
        seen = torch.bincount(lists.gaussian_ids[: int(lengths.sum())].long(), minlength=count)
        assert int((seen - counts[0]).abs().sum()) == unfound
        total += int(counts.sum())
    assert total > 200_000


def test_70_000_cameras_of_one_pixel(device):
    """More than a second grid axis would take: each draws its own pixel, the same as alone."""
    count = 70_000
    gaussians = spots([(0.5, 0.5)], 0.5, device)
    cam = plain(1, 1, device)
    shift = torch.linspace(-1.0, 1.0, count, device=device) / FOCAL
    viewmats = torch.eye(4, device=device).repeat(count, 1, 1)
    viewmats[:, 0, 3] = shift
    batch = rasterize(gaussians, Camera(viewmats, cam.K.repeat(count, 1, 1), 1, 1))
    assert batch.rgb.shape == (count, 1, 1, 3)
    for i in (0, 1, 65_535, 65_536, count - 1):
        alone = rasterize(gaussians, dataclasses.replace(cam, viewmat=viewmats[i]))
        assert torch.equal(alone.rgb, batch.rgb[i]) and float(alone.alpha) > 0
    assert len(batch.alpha.unique()) > 1000


SIZES = [(1, 1), (1, 17), (16, 16), (33, 47), (257, 257), (1, 8192), (8192, 1)]


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_pictures_of_any_size_are_crops_of_a_larger_one(device, width, height):
    """Same intrinsics, larger picture: the same pixels. Bit for bit but for the clamp of the Jacobian, which is kept off."""
    gaussians = cloud(200, device=device)
    gaussians.means[:, :2] *= 0.3  # far inside the grown frustum of both pictures
    focal = 40.0
    K = torch.tensor([[focal, 0, 0.5 * width], [0, focal, 0.5 * height], [0, 0, 1]], device=device)
    large = 16 * (-(-width // 16) + 3), 16 * (-(-height // 16) + 2)
    near = torch.eye(4, device=device)
    if min(width, height) < 16:  # a picture so thin has hardly a frustum: look at Gaussians on its axis
        gaussians.means[:, :2] *= 0.01
    small = rasterize(gaussians, Camera(near, K, width, height))
    whole = rasterize(gaussians, Camera(near, K, *large))
    assert float(small.alpha.max()) > 0.1
    for name in ("rgb", "alpha", "depth"):
        assert torch.equal(getattr(small, name), getattr(whole, name)[:height, :width]), name
