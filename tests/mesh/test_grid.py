"""The grid holds the surfaces, leaves far ones out, and is refused before it is made where memory does not hold it."""

import numpy as np
import pytest
import torch

from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.mesh import fuse
from warpgs.mesh.fuse import GridPlan, MeshOptions, check_memory, find_box, plan_grid

CPU = torch.device("cpu")


def points(count=20_000):
    """Return a box of points with a few per cent a hundred times as far away."""
    rng = np.random.default_rng(0)
    x = rng.uniform((-1, 0, 2), (1, 0.5, 6), (count, 3))
    x[: count // 50] *= 100
    return x


def test_the_box_cuts_what_is_far_behind():
    """Outliers go, and no more than a two-hundredth of the rest."""
    low, high = find_box(points())
    assert (low > [-3.6, -0.1, 1.9]).all() and (low <= [-0.98, 0.01, 2.04]).all()
    assert (high < [3.6, 1.2, 11.2]).all() and (high >= [0.98, 0.49, 5.9]).all()


def test_a_voxel_is_what_is_asked_for():
    """By its side, by their number, or by default no smaller than half of what a pixel shows."""
    x, pixel = points(), np.full(20_000, 1e-4)
    longest = float(np.ptp(find_box(x), axis=0).max())
    assert plan_grid(x, pixel, voxel=0.05).voxel == 0.05
    assert plan_grid(x, pixel, resolution=100).voxel == longest / 100
    assert plan_grid(x, pixel).voxel == longest / 256 and plan_grid(x, np.full(20_000, 0.2)).voxel == 0.1
    plan = plan_grid(x, pixel, voxel=0.05)
    first, last = np.array(plan.origin), np.array(plan.origin) + 0.05 * (np.array(plan.shape) - 1)
    low, high = find_box(x)
    assert (low - first >= 4 * 0.05 - 1e-9).all() and (last - high >= 4 * 0.05 - 1e-9).all()
    assert plan.points == np.prod(plan.shape) and 0.97 < plan.inside < 1 and plan.truncation == 0.2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"voxel": 0.0}, "above 0"), ({"voxel": float("nan")}, "above 0"), ({"voxel": 1e-9}, "at least a millionth"),
        ({"voxel": 1.0, "resolution": 9}, "one of them"), ({"resolution": 7}, "8 to 4096"), ({"resolution": 4097}, "8 to 4096"),
    ],
)  # fmt: skip
def test_what_makes_no_grid_is_refused(options, words):
    with pytest.raises(UsageError, match=words):
        plan_grid(points(), np.full(20_000, 1e-4), MeshOptions(**options).voxel)


def test_no_surface_is_said():
    with pytest.raises(DataError, match="no training view shows a surface"):
        plan_grid(np.zeros((0, 3)), np.zeros(0))


def test_a_grid_that_does_not_fit_is_refused(monkeypatch):
    """Before anything is allocated; the message has both sizes and the remedy."""
    plan = GridPlan((0, 0, 0), 1.0, (1000, 1000, 100), 1.0)
    monkeypatch.setattr(fuse, "available_bytes", lambda _: 3 * 10**9)
    assert check_memory(plan, CPU) == "2.0 GiB"
    monkeypatch.setattr(fuse, "available_bytes", lambda _: 2 * 10**9)
    with pytest.raises(ResourceError, match=r"2\.0 GiB of memory on cpu, more than 80 % of the free 1\.9 GiB; give a larger"):
        check_memory(plan, CPU)
    monkeypatch.setattr(fuse, "available_bytes", lambda _: 10**15)
    with pytest.raises(ResourceError, match="kernels can index"):
        check_memory(GridPlan((0, 0, 0), 1.0, (1300, 1300, 1300), 1.0), CPU)
