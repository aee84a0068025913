"""Fusion of depth maps against numpy, and against a plane whose distances are known."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.gaussians import camera as torch_camera
from tests.reference import tsdf as reference
from warpgs.errors import UsageError
from warpgs.kernels.tsdf import face_cosines, gather_colors, integrate
from warpgs.scene import Camera

SIZE = (40, 31)
BOUND = {torch.float32: 2e-4, torch.float64: 1e-10}


def empty(shape, dtype, device):
    return [torch.zeros(shape, dtype=dtype, device=device) for _ in range(2)]


def cameras(count=2):
    batch = torch_camera(*SIZE, cameras=count)
    roll = np.array([[np.cos(0.2), -np.sin(0.2), 0, 0], [np.sin(0.2), np.cos(0.2), 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    return [Camera(roll @ v.numpy(), K.numpy(), *SIZE) for v, K in zip(batch.viewmat, batch.K)]


def maps(seed=0):
    """Return a depth map with holes and open sky, the first with a step, the other smooth; random weights; an image."""
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[: SIZE[1], : SIZE[0]]
    depth = 3.0 + 0.02 * rng.random((SIZE[1], SIZE[0]))
    depth += 0.1 * rng.random(depth.shape) if seed else 0.01 * column - 0.02 * row + np.where(column > 22, 1.5, 0)
    depth[rng.random(depth.shape) < 0.05] = 0
    depth[:4] = np.inf
    weights = np.where(rng.random(depth.shape) < 0.1, 0, rng.random(depth.shape))
    return depth, np.where(depth > 0, weights, 0), rng.random((SIZE[1], SIZE[0], 3))


def tensors(arrays, dtype, device):
    """Return tensors of arrays, with more numbers of the same kind behind their end, which nothing must read."""
    longer = [np.concatenate([a, 3.1 + a[:2] * 0]) for a in (np.where(np.isfinite(a), a, 1e9) for a in arrays)]
    found = [torch.as_tensor(a, dtype=dtype, device=device) for a in longer]
    return [torch.where(t == 1e9, torch.inf, t)[: len(a)] for t, a in zip(found, arrays)]


def test_distances_and_weights_equal_numpy(device, dtype):
    """Two views one after the other, with steps, holes, sky and weights of 0; few points lie where rounding decides."""
    views = [(c, *maps(i)[:2]) for i, c in enumerate(cameras())]
    origin, voxel, shape, truncation = (-1.61, -1.23, 1.93), 0.1103, (30, 22, 33), 0.35
    grid = empty(shape, dtype, device)
    for c, *arrays in views:
        integrate(*grid, origin, voxel, truncation, c, *tensors(arrays, dtype, device))
    distances, weights = reference.integrated(origin, voxel, shape, truncation, views)
    seen = weights > 0
    assert 0.2 < seen.mean() < 0.9 and (distances[seen] < 0).mean() > 0.05 and (distances == 1).any()
    off = np.abs(grid[0].cpu().numpy() - distances)[seen] > BOUND[dtype]
    off_weights = np.abs(grid[1].cpu().numpy() - weights) > BOUND[dtype]
    limit = 2e-3 if dtype is torch.float32 else 0
    assert off.mean() <= limit and off_weights.mean() <= limit
    assert not bool(grid[0][~torch.as_tensor(seen, device=device)].any()) or dtype is torch.float32


def test_colors_equal_numpy(device, dtype):
    views = [(c, *maps(i)) for i, c in enumerate(cameras())]
    points = np.random.default_rng(5).uniform((-2, -2, -1), (2, 2, 6), (4000, 3))
    sums, weights = (torch.zeros(4000, *rest, dtype=dtype, device=device) for rest in ((3,), ()))
    for c, depth, pixel_weights, image in views:
        gather_colors(
            *tensors([points], dtype, device), 0.3, c, *tensors([depth, pixel_weights, image], dtype, device), sums, weights
        )
    wanted_sums, wanted = reference.gathered(points, 0.3, views)
    assert 0.02 < (wanted > 0).mean() < 0.5
    limit = 2e-3 if dtype is torch.float32 else 0
    assert (np.abs(weights.cpu().numpy() - wanted) > BOUND[dtype]).mean() <= limit
    assert (np.abs(sums.cpu().numpy() - wanted_sums) > BOUND[dtype]).mean() <= limit


def test_borders_and_steps(device, dtype):
    """Positions and differences that are exact: the left and upper border belong to the image, the others do not."""
    c = Camera(np.eye(4), np.array([[8.0, 0, 4], [0, 8, 4], [0, 0, 1]]), 8, 8)
    depth, one = tensors([np.full((8, 8), 2.0), np.ones((8, 8))], dtype, device)
    image = one[..., None].expand(8, 8, 3).contiguous()
    at = [(-0.5, 0), (0.5, 0), (0, -0.5), (0, 0.5), (0, 0)]
    points = [(2 * x, 2 * y, 2.0) for x, y in at] + [(0, 0, 1.5), (0, 0, 2.5), (0, 0, 1.75)]
    sums, weights = torch.zeros(8, 3, dtype=dtype, device=device), torch.zeros(8, dtype=dtype, device=device)
    gather_colors(torch.tensor(points, dtype=dtype, device=device), 0.5, c, depth, one, image, sums, weights)
    assert weights.tolist() == [1, 0, 1, 0, 1, 0, 0, 1] and torch.equal(sums, weights[:, None].expand(8, 3))
    grid = empty((3, 3, 2), dtype, device)
    integrate(*grid, (-1.0, -1.0, 2.0), 1.0, 1.0, c, depth, one)
    inside = [[1, 1, 0], [1, 1, 0], [0, 0, 0]]  # at depth 2; at depth 3, the truncation behind, the whole grid is
    assert grid[1][:, :, 0].tolist() == inside and bool((grid[1][:, :, 1] == 1).all())
    assert bool((grid[0][:, :, 1] == -1).all()) and not bool(grid[0][:, :, 0].any())
    # a point between pixels of two depths has that of its pixel from the truncation on, and what lies between below
    depth = np.full((8, 8), 2.0)
    depth[4:] = 2.5
    found = []
    for truncation in (0.5, 0.5001):
        grid = empty((1, 1, 1), dtype, device)
        integrate(*grid, (0.0, 0.0, 1.9), 0.1, truncation, c, *tensors([depth, np.ones((8, 8))], dtype, device))
        found.append(float(grid[0]) * truncation)
    assert found == pytest.approx([0.5, 0.35], abs=1e-3)


def test_cosines_equal_numpy_and_those_of_a_plane(device, dtype):
    """Of maps with steps, holes and sky, and of a single pixel."""
    for i, c in enumerate(cameras()):
        depth = maps(i)[0]
        depth[10:15, 12] = depth[20, 5:9] = 0  # a column and a row of holes
        found = face_cosines(*tensors([depth], dtype, device), c).cpu().numpy()
        assert np.abs(found - reference.faced(depth, c)).max() < BOUND[dtype]
    alone = face_cosines(*tensors([np.full((1, 1), 2.0)], dtype, device), dataclasses.replace(c, width=1, height=1))
    assert float(alone) == pytest.approx(float(reference.faced(np.full((1, 1), 2.0), c)[0, 0]), abs=1e-5)
    # but for the curve of its depth from one pixel to the next; a step does not bend it
    c, normal = cameras()[1], np.array([0.5, 0.3, -1.0])
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), -1) + 0.5
    rays = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], -1) @ np.linalg.inv(c.K).T
    depth = -2.5 / (rays @ normal)
    wanted = np.abs(rays @ normal) / np.linalg.norm(normal) / np.linalg.norm(rays, axis=-1)
    depth[:, 30:] += 2
    found = face_cosines(*tensors([depth], torch.float64, device), c).cpu().numpy()
    assert np.abs(found - wanted)[:, :30].max() < 0.02
    with pytest.raises(UsageError, match="pinhole"):
        face_cosines(torch.ones(SIZE[1], SIZE[0]), dataclasses.replace(cameras(1)[0], model="fisheye"))
