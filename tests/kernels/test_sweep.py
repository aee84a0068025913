"""The plane sweep: matching costs, costs of paths, and the best plane."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.priors.rigs import rig, still_life
from tests.reference import sweep as plane_costs
from tests.reference.sweep import best_inverse, scanline_costs as defined
from warpgs.geometry import back_project, seen_pixels
from warpgs.kernels.sweep import (
    LARGEST,
    best_inverses,
    cell_means,
    cell_runs,
    focal_length,
    given,
    lifted,
    occluding,
    scanline_costs,
)
from warpgs.priors.sweep import UNIT, matching_costs_cpu
from warpgs.scene import Camera, View


@pytest.mark.parametrize("size", [(7, 160), (160, 5), (1, 1), (40, 70)])
def test_costs_are_those_of_opencv(size):
    """Costs differ from those of OpenCV's warps and blurs by rounding, in images of any size, at borders, and with masks."""
    height, width = size
    views = []
    for v in still_life()[0]:
        c = v.camera
        views.append(View(v.name, Camera(c.viewmat, c.K, width, height), np.resize(v.image[40:], (height, width, 3))))
    views[2] = still_life()[0][2]  # of another size
    views[2] = replace(views[2], mask=np.random.default_rng(0).random((12, 16)).repeat(10, 0).repeat(10, 1) < 0.7)
    inverses = np.linspace(1 / 12, 1 / 2, 21)
    found = matching_costs_cpu(views[1], [views[0], views[2]], inverses, 7).numpy()
    wanted = plane_costs.matching_costs(views[1], [views[0], views[2]], inverses, 7).transpose(1, 2, 0)
    off = np.abs(found[..., :21] / UNIT - wanted)
    # a pixel at the very border is inside for one and outside for the other
    assert found.shape == (height, width, 32) and np.quantile(off, 0.995) < 0.01 and off.mean() < 2e-3
    assert (found[..., 21:] == UNIT).all()


def test_best_planes_are_those_of_numpy():
    inverses = np.linspace(0.1, 0.5, 9)
    costs = np.random.default_rng(2).integers(0, 9, (6, 5, 16)).astype(np.int16)
    assert np.array_equal(best_inverses(torch.from_numpy(costs), inverses), best_inverse(costs[..., :9], inverses))


def problem(shape: tuple[int, int, int], seed: int = 0, largest: int = 4096):
    g = np.random.default_rng(seed)
    height, width, _ = shape
    limits = [g.integers(0, 2000, s).astype(np.int32) for s in ((height - 1, width), (height, width - 1))]
    return g.integers(0, largest + 1, shape).astype(np.int16), *limits


def computed(device, costs, down, across, small) -> np.ndarray:
    on_device = (torch.from_numpy(np.ascontiguousarray(a)).to(device) for a in (costs, down, across))
    return scanline_costs(*on_device, small).cpu().numpy()


@pytest.mark.parametrize("shape", [(1, 7, 3), (7, 1, 3), (3, 4, 1), (40, 33, 17), (1, 1, 4), (5, 4, 70)])
def test_equal_to_the_definition(device, shape):
    costs, down, across = problem(shape)
    wanted = defined(costs, down, across, 123)
    assert np.array_equal(computed(device, costs, down, across, 123), wanted)
    turned, *limits = (torch.from_numpy(a).to(device) for a in (np.ascontiguousarray(costs.transpose(2, 0, 1)), down, across))
    assert np.array_equal(scanline_costs(turned.permute(1, 2, 0), *limits, 123).cpu().numpy(), wanted)


def test_the_dearest_costs_fit(device):
    """Costs and penalties of `LARGEST` together, the best plane another in every pixel: still below 2^15."""
    cost, penalty = 4096, LARGEST - 4096
    costs = np.full((6, 6, 8), cost, np.int16)
    y, x = np.indices((6, 6))
    costs[y, x, (3 * y + 5 * x) % 8] = 0
    limits = np.full((5, 6), penalty, np.int32), np.full((6, 5), penalty, np.int32)
    found = computed(device, costs, *limits, penalty)
    assert np.array_equal(found, defined(costs, *limits, penalty)) and found.min() >= 0 and found.max() > 3 * 2**13


def test_lifted_and_occluding_points_are_those_of_geometry():
    """Lenses with skew, too; points behind a camera and outside of its image occlude nothing."""
    first, second, third = rig()
    second.K[0, 1] = 3.0
    generator = np.random.default_rng(5)
    depths = np.where(generator.uniform(size=(48, 64)) < 0.2, generator.uniform(2, 6, (48, 64)), 0).astype(np.float32)
    pixels, at = lifted(second, depths), np.flatnonzero(depths)
    runs, colors = np.stack([at, at + 1], 1), generator.uniform(size=(64 * 48, 3)).astype(np.float32)
    lone, own = cell_means(len(at), [(pixels, colors, runs, np.arange(len(at)))])
    wanted = back_project(second, np.stack([at % 64, at // 64], 1) + 0.5, depths.ravel()[at].astype(float))
    assert np.allclose(lone, wanted, rtol=1e-14, atol=1e-14) and np.array_equal(own, colors[at].astype(float))
    points = np.concatenate([lone, generator.uniform(-9, 9, (500, 3))])
    maps = [generator.uniform(0, 8, (48, 64)).astype(np.float32) for _ in range(2)]
    wanted = np.zeros(len(points), bool)
    for camera, depth in zip((second, third), maps):
        seen, rows, columns, z = seen_pixels(camera, points)
        wanted[seen] |= z < 0.9 * depth[rows, columns]
    row, none = (given(p, np.ones(len(p))) for p in (points, points[:0]))
    (hides,), inside = occluding((second, third), maps, row, 0.9), occluding((second, third), maps, pixels, 0.9)
    assert np.array_equal(hides, wanted) and 0.1 < wanted.mean() < 0.9
    assert np.array_equal(inside.ravel()[at], wanted[: len(at)]) and inside[depths == 0].all()
    assert not occluding((), (), row, 0.9).any() and occluding((first,), maps[:1], none, 0.9).shape == (1, 0)
    assert np.array_equal(occluding((), (), pixels, 0.9), depths == 0)


def test_runs_of_points_in_a_cell_are_those_of_a_dense_grid():
    """At all levels, across gaps and borders of rows; the second call fills in what the first one counts."""
    camera, generator = rig()[1], np.random.default_rng(6)
    depths = (np.exp2(generator.uniform(-2, 4, (48, 8))).repeat(8, 1) * (generator.uniform(size=(48, 64)) < 0.9)).astype(
        np.float32
    )
    pixels, at = lifted(camera, depths), np.flatnonzero(depths)
    rows, _ = cell_runs(pixels, 3.0, np.zeros((48, 9), np.int64), (0,) * 4, (0,) * 4)
    found = [cell_runs(pixels, 3.0, rows, (-5,) * 4, weights)[1] for weights in np.eye(4, dtype=int)]
    begins, ends = found[0][:, :2].T
    points = back_project(camera, np.stack([at % 64, at // 64], 1) + 0.5, depths.ravel()[at].astype(float))
    level = np.round(np.log2(3.0 * depths.ravel()[at].astype(float) / focal_length(camera)))
    cells = np.column_stack([level, np.floor(points / np.exp2(level)[:, None])])
    changes = (np.diff(cells, axis=0) != 0).any(1) | (np.diff(at) > 1) | (np.diff(at // 64) > 0)
    first = np.concatenate([[0], 1 + np.flatnonzero(changes)])
    assert np.array_equal(begins, at[first]) and np.array_equal(ends, at[np.append(first[1:], len(at)) - 1] + 1)
    assert np.array_equal(np.stack([own[:, 2] for own in found], 1) - 5, cells[first]) and len(set(level)) > 5
    assert rows[:, 0].sum() == len(first) and np.array_equal(rows[:, 1:5].min(0), cells.min(0))
    assert np.array_equal(rows[:, 5:].max(0), cells.max(0)) and 1.05 < len(at) / len(first) < 4
