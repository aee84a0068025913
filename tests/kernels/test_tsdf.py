"""Fusion of depth maps against numpy, and against a plane whose distances are known."""

import dataclasses

import numpy as np
import pytest
import torch

from tests.gaussians import camera as torch_camera
from tests.reference import tsdf as reference
from warpgs.errors import UsageError
from warpgs.geometry import back_project
from warpgs.kernels.tsdf import empty_grid, face_cosines, gather_colors, integrate
from warpgs.scene import Camera

SIZE = (40, 31)
BOUND = {torch.float32: 2e-4, torch.float64: 1e-10}


def cameras(count=2):
    """Return numpy cameras at the origin, each turned and shifted a little more."""
    batch = torch_camera(*SIZE, cameras=count)
    return [Camera(v.numpy(), K.numpy(), *SIZE) for v, K in zip(batch.viewmat, batch.K)]


def maps(seed=0):
    """Return a depth map with a step, holes and open sky, random weights with zeros, and an image."""
    rng = np.random.default_rng(seed)
    row, column = np.mgrid[: SIZE[1], : SIZE[0]]
    depth = 3.0 + 0.01 * column - 0.02 * row + np.where(column > 22, 1.5, 0) + 0.02 * rng.random((SIZE[1], SIZE[0]))
    depth[rng.random(depth.shape) < 0.05] = 0
    depth[:4] = np.inf
    weights = np.where(rng.random(depth.shape) < 0.1, 0, rng.random(depth.shape))
    return depth, np.where(depth > 0, weights, 0), rng.random((SIZE[1], SIZE[0], 3))


def tensors(arrays, dtype, device):
    return [torch.as_tensor(np.ascontiguousarray(a), dtype=dtype, device=device) for a in arrays]


def test_distances_and_weights_equal_numpy(device, dtype):
    """Two views one after the other, with steps, holes, sky and weights of 0; few points lie where rounding decides."""
    views = [(c, *maps(i)[:2]) for i, c in enumerate(cameras())]
    place = {"origin": (-1.61, -1.23, 1.93), "voxel": 0.1103, "shape": (30, 22, 33), "truncation": 0.35}
    grid = empty_grid(*place.values(), like=torch.empty(0, dtype=dtype, device=device))
    for c, *arrays in views:
        integrate(grid, c, *tensors(arrays, dtype, device))
    distances, weights = reference.integrated(*place.values(), views)
    seen = weights > 0
    assert 0.2 < seen.mean() < 0.9 and (distances[seen] < 0).mean() > 0.05 and (distances == 1).any()
    off = np.abs(grid.distances.cpu().numpy() - distances)[seen] > BOUND[dtype]
    off_weights = np.abs(grid.weights.cpu().numpy() - weights) > BOUND[dtype]
    limit = 2e-3 if dtype is torch.float32 else 0
    assert off.mean() <= limit and off_weights.mean() <= limit
    assert not bool(grid.distances[~torch.as_tensor(seen, device=device)].any()) or dtype is torch.float32


def test_colors_equal_numpy(device, dtype):
    """Points on, before and behind the surface, and beside the image; two views."""
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


def test_cosines_are_those_of_the_surface(device, dtype):
    """Of a slanted plane everywhere, of a bowl by a cross product; 1 in the sky, 0 in holes, and edges do not bend a plane."""
    c = cameras()[1]
    pixels = np.stack(np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1])), -1) + 0.5
    rays = np.concatenate([pixels, np.ones((*pixels.shape[:2], 1))], -1) @ np.linalg.inv(c.K).T
    normal = np.array([0.5, 0.3, -1.0])
    depth = -2.5 / (rays @ normal)
    wanted = np.abs(rays @ normal) / np.linalg.norm(normal) / np.linalg.norm(rays, axis=-1)
    found = face_cosines(*tensors([depth], dtype, device), c).cpu().numpy()
    assert np.abs(found - wanted).max() < 0.02  # differences of one pixel along a hyperbola
    holes = depth.copy()
    holes[5, 7], holes[9:12, 20], holes[:, 30:] = 0, np.inf, holes[:, 30:] + 2
    cosines = face_cosines(*tensors([holes], dtype, device), c).cpu().numpy()
    assert cosines[5, 7] == 0 and (cosines[9:12, 20] == 1).all()
    keep = (holes > 0) & np.isfinite(holes)
    keep[:, 30:] = False
    assert np.abs(cosines - wanted)[keep].max() < 0.03
    bowl = 3 + 0.001 * ((pixels - 17) ** 2).sum(-1)
    found = face_cosines(*tensors([bowl], dtype, device), c).cpu().numpy()
    assert np.abs(found - reference.faced(bowl[..., None] * rays))[1:-1, 1:-1].max() < 0.05
    alone = face_cosines(*tensors([np.full((1, 1), 2.0)], dtype, device), dataclasses.replace(c, width=1, height=1))
    assert 0.5 < float(alone) <= 1


def test_a_wall_is_found_where_it_is(device):
    """Between two points of the grid, to a thousandth of a voxel; far behind it nothing is known, before it all is empty."""
    c = cameras(1)[0]
    grid = empty_grid((-0.5, -0.4, 1.0), 0.1, (10, 8, 30), 0.3, torch.empty(0, device=device))
    depth, one = torch.full((SIZE[1], SIZE[0]), 2.137, device=device), torch.ones(SIZE[1], SIZE[0], device=device)
    integrate(grid, c, depth, one)
    distances, weights = grid.distances[5, 4].cpu(), grid.weights[5, 4].cpu()
    z = 1.0 + 0.1 * torch.arange(30)
    assert torch.equal(weights > 0, z <= 2.137 + 0.3) and bool((distances[z < 1.8] == 1).all())
    before, behind = float(distances[11]), float(distances[12])
    assert before > 0 > behind and abs(2.1 + 0.1 * before / (before - behind) - 2.137) < 1e-4
    middle = back_project(c, np.array([[20.0, 15.0]]), np.array([2.137]))
    sums, found = torch.zeros(1, 3, device=device), torch.zeros(1, device=device)
    red = one[..., None] * torch.tensor([1.0, 0, 0], device=device)
    gather_colors(torch.as_tensor(middle, dtype=torch.float32, device=device), 0.05, c, depth, one, red, sums, found)
    assert sums.tolist() == [[1, 0, 0]] and found.tolist() == [1]


def test_threads_give_the_same_bits(device):
    """Every grid point is its own."""
    depth, weights, _ = tensors(maps(), torch.float32, device)
    found, before = [], torch.get_num_threads()
    for threads in (1, 2):
        torch.set_num_threads(threads)
        grid = empty_grid((-1.6, -1.2, 1.9), 0.05, (60, 50, 66), 0.2, depth)
        for c in cameras():
            integrate(grid, c, depth, weights)
        found.append(grid)
    torch.set_num_threads(before)
    assert torch.equal(found[0].distances, found[1].distances) and torch.equal(found[0].weights, found[1].weights)


def test_bad_input_is_refused():
    """Another camera model, and shapes that disagree."""
    c, grid, depth = cameras(1)[0], empty_grid((0, 0, 0), 1, (2, 2, 2), 1, torch.empty(0)), torch.ones(SIZE[1], SIZE[0])
    with pytest.raises(UsageError, match="pinhole"):
        integrate(grid, dataclasses.replace(c, model="fisheye"), depth, depth)
    with pytest.raises(ValueError, match="pixel_weights"):
        integrate(grid, c, depth, depth[1:])
