"""Nearest neighbours, sizes at which Gaussians reach no camera, and sizes of a pixel."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from tests.reference.neighbours import log_pixel, log_reach, mean_square_distances_reference
from tests.scenes import ring
from warpgs.kernels.neighbours import SMALLEST, camera_reach, mean_square_distances, pixel_size
from warpgs.pipeline.model.limits import camera_rows
from warpgs.scene import Camera


@pytest.mark.parametrize("count", [0, 1, 2, 3, 4, 33, 1500])
@pytest.mark.parametrize("k", [1, 3, 8])
def test_equal_all_pairs(device, dtype, count, k):
    generator = torch.Generator().manual_seed(count)
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64).to(dtype)
    found = mean_square_distances(points.to(device), k).cpu()
    wanted = mean_square_distances_reference(points.double(), k) if count else torch.zeros(0, dtype=torch.float64)
    assert found.shape == (count,)
    assert torch.allclose(found.double(), wanted, rtol=1e-5 if dtype == torch.float32 else 1e-12, atol=0)


@pytest.mark.parametrize("count", [1024, 1025, 32_769, 50_000])
def test_every_level_of_boxes_is_searched(device, count):
    """One, two and three levels of boxes, and sets that end within a box of each, against a k-d tree."""
    points = np.random.default_rng(count).normal(size=(count, 3)) ** 3  # dense in the middle, sparse far out
    found = mean_square_distances(torch.as_tensor(points, device=device), 3).cpu().numpy()
    distances, _ = cKDTree(points).query(points, k=4)
    np.testing.assert_allclose(found, (distances[:, 1:] ** 2).mean(1), rtol=1e-12)


def test_clusters_lines_and_duplicates(device):
    """Shapes that a space-filling curve handles badly are still exact; coincident points have distance 0."""
    generator = torch.Generator().manual_seed(5)
    line = torch.zeros(300, 3, dtype=torch.float64)
    line[:, 0] = torch.rand(300, generator=generator, dtype=torch.float64) * 1e3
    cluster = torch.randn(300, 3, generator=generator, dtype=torch.float64) * 1e-6 + 1e3
    same = torch.full((10, 3), -4.0, dtype=torch.float64)
    points = torch.cat([line, cluster, same])
    found = mean_square_distances(points.to(device), 3).cpu()
    assert torch.allclose(found, mean_square_distances_reference(points, 3), rtol=1e-9, atol=0)
    assert not bool(found[-10:].any())
    assert not bool(mean_square_distances(same.to(device), 3).any())


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="non-finite"):
        mean_square_distances(torch.tensor([[0.0, 0, 0], [float("nan"), 0, 0]]))
    with pytest.raises(ValueError, match="points"):
        mean_square_distances(torch.zeros(4, 2))
    for k in (0, 9):
        with pytest.raises(ValueError, match=f"k must be 1 to 8, not {k}"):
            mean_square_distances(torch.zeros(4, 3), k)


# Sizes at which Gaussians reach no camera, against distances in float64.


@pytest.mark.parametrize("cameras", [1, 3, 32])
def test_it_is_the_fraction_of_the_distance_to_the_nearest(device, cameras):
    generator = torch.Generator().manual_seed(cameras)
    means = torch.randn(1000, 3, generator=generator) * torch.logspace(-3, 6, 1000)[:, None]
    centers = torch.randn(cameras, 3, generator=generator)
    exact = torch.from_numpy(log_reach(means.numpy(), centers.numpy(), 1 / 3, SMALLEST))
    found = camera_reach(means.to(device), centers.to(device), 1 / 3)
    assert found.dtype == torch.float32 and torch.allclose(found.cpu().double(), exact, rtol=1e-6, atol=1e-5)


# Sizes of a pixel at Gaussians, against angles and depths in float64.


def rows(count: int, fisheye: float = 0.3) -> torch.Tensor:
    """Cameras about the origin that look anywhere; some are fisheyes, of which a few see more than half the space."""
    generator = np.random.default_rng(count)
    axes = generator.standard_normal((count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    wide = generator.random(count) < fisheye
    cosines = np.where(wide, generator.uniform(-1, 0.5, count), generator.uniform(0.5, 0.95, count))
    focal = generator.uniform(50, 500, count)
    columns = [generator.standard_normal((count, 3)), axes, focal[:, None], cosines[:, None], wide[:, None]]
    return torch.from_numpy(np.concatenate(columns, 1)).float()


@pytest.mark.parametrize("cameras", [1, 3, 40])
def test_it_is_the_smallest_pixel_of_those_that_see_it(device, cameras):
    """Near and far ones, within a rounding of float32; a mean on the rim of a cone may be seen or not."""
    generator = torch.Generator().manual_seed(cameras)
    means = torch.randn(2000, 3, generator=generator) * torch.logspace(-2, 4, 2000)[:, None]
    given = rows(cameras)
    exact = torch.from_numpy(log_pixel(means.numpy(), given.numpy(), 0.4, SMALLEST))
    found = pixel_size(means.to(device), given.to(device), 0.4).cpu().double()
    same = torch.isclose(found, exact, rtol=1e-5, atol=1e-5)
    assert found.dtype == torch.float64 and float(same.double().mean()) > 0.998
    seen = exact > math.log(2 * SMALLEST)
    assert bool(seen.any()) and (cameras == 40 or not bool(seen.all()))


def test_a_row_says_what_a_camera_sees(device):
    """Depth over focal length for a pinhole, for points in its image alone; distance for a fisheye; nothing without centre."""
    K = np.array([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]])
    pinhole = Camera(np.eye(4), K, 80, 60)
    means = torch.tensor([[0.0, 0, 5], [1.9, 1.4, 5], [4.0, 0, 5], [0, 0, -5]])
    rim = Camera(np.eye(4), K, 80, 60, "fisheye", np.zeros(4))
    for camera, wanted in (
        (pinhole, [0.05, 0.05, None, None]),
        (rim, [0.05, math.sqrt(1.9**2 + 1.4**2 + 25) / 100, None, None]),
        (Camera(np.eye(4), K, 80, 60, "orthographic"), [None] * 4),
    ):
        found = pixel_size(means.to(device), camera_rows([camera], device), 1.0).cpu()
        for size, expected in zip(found.exp().tolist(), wanted, strict=True):
            assert size == pytest.approx(SMALLEST if expected is None else expected, rel=1e-5)
    assert camera_rows([pinhole, *ring(3)], device).shape == (4, 9)


def test_sizes_at_a_camera_and_without_gaussians(device):
    center = torch.tensor([[1.0, 2.0, 3.0]], device=device)
    assert float(camera_reach(center, center, 0.5)) == pytest.approx(math.log(SMALLEST))
    assert camera_reach(center[:0], center, 0.5).shape == (0,)
    given = rows(1).to(device)
    assert float(pixel_size(given[:, :3].contiguous(), given, 0.5)) == pytest.approx(math.log(SMALLEST))
    assert pixel_size(given[:0, :3], given, 0.5).shape == (0,)
    broken = torch.full((1, 3), math.nan, device=device)
    assert float(pixel_size(broken, given, 0.5)) == pytest.approx(math.log(SMALLEST))
