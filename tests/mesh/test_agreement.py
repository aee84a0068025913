"""Depth that one view alone shows is kept where no other view looks, and left out where another one sees something else."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from warpgs.mesh import views
from warpgs.mesh.views import SurfaceView, agreed, depth_map, neighbours
from warpgs.scene import Camera

WIDTH, HEIGHT = 48, 32
K = np.array([[40.0, 0, 24], [0, 40, 16], [0, 0, 1]])


def wall(x: float, depth: float = 4.0) -> SurfaceView:
    """Return what a camera at x sees of a wall across its axis."""
    viewmat = np.eye(4)
    viewmat[0, 3] = -x
    z = torch.full((HEIGHT, WIDTH), depth)
    return SurfaceView(Camera(viewmat, K, WIDTH, HEIGHT), z, torch.ones_like(z), torch.zeros(HEIGHT, WIDTH, 3))


def test_depth_that_another_view_confirms_stays():
    """Depths within 2 % are confirmed, and empty pixels stay empty."""
    view = wall(0.0)
    view.depth[:4] = torch.inf
    for depth, kept in ((4.0, True), (4.07, True), (4.09, False), (3.9, False)):
        found = agreed(view, [depth_map(wall(0.5, depth), 2)])
        assert bool((found.depth[4:, 8:] > 0).all()) == kept and bool((found.weights[4:, 8:] > 0).all()) == kept
        assert torch.equal(found.depth[:4], view.depth[:4]) and torch.equal(found.weights[:4], view.weights[:4])


def test_one_of_several_confirms():
    """One view that agrees is enough; where only the other one looks, the depth goes."""
    found = agreed(wall(0.0), [depth_map(wall(x, d), 3) for x, d in ((0.5, 6.0), (-0.5, 4.0))])
    assert bool((found.depth[:, :40] == 4).all()) and not bool(found.depth[:, -3:].any())


def test_what_no_other_view_looks_at_stays():
    """Nothing speaks against a depth outside of all other images, before empty pixels, and with one view alone."""
    view = wall(0.0)
    found = agreed(view, [depth_map(wall(2.4, 9.0), 2)])
    beside = round(40 * 2.4 / 4)  # the columns that the other image shows begin here
    assert bool((found.depth[:, : beside - 1] == 4).all()) and not bool(found.depth[:, beside:].any())
    empty = replace(wall(0.5), depth=torch.zeros(HEIGHT, WIDTH))
    for others in ([], [depth_map(empty, 2)]):
        assert torch.equal(agreed(view, others).depth, view.depth)


def test_thinned_maps_say_the_same(monkeypatch):
    """Keep every third depth of every third row of a slanted wall."""
    view, other = wall(0.0), wall(0.3)
    for v in (view, other):
        x = (torch.arange(WIDTH) + 0.5 - 24) / 40
        v.depth[:] = (4 + 0.1 * float(v.camera.center[0])) / (1 - 0.1 * x)  # z = 4 + x / 10
    monkeypatch.setattr(views, "MAX_PIXELS", 2 * WIDTH * HEIGHT / 7)
    thin = depth_map(other, 2)
    assert thin.step == 3 and thin.depth.shape == (11, 16) and torch.equal(thin.depth, other.depth[1::3, 1::3])
    assert torch.equal(agreed(view, [thin]).depth, view.depth)
    assert not bool(agreed(replace(view, depth=view.depth * 1.1), [thin]).depth[:, 8:].any())


def test_neighbours_share_sight(monkeypatch):
    """The nearest views with another angle come first, at most so many."""
    maps = [depth_map(wall(x), 5) for x in (0.0, 0.5, 1.0, 1.5, 90.0)]
    monkeypatch.setattr(views, "NEIGHBOURS", 2)
    assert neighbours(maps)[0] == [1, 2] and sorted(neighbours(maps)[2]) == [1, 3]
    assert neighbours(maps[:1]) == [[]]


def test_a_view_without_a_surface():
    """Sky alone confirms nothing and questions nothing."""
    sky = replace(wall(0.5), depth=torch.full((HEIGHT, WIDTH), torch.inf))
    maps = [depth_map(v, 2) for v in (wall(0.0), sky)]
    assert neighbours(maps) == [[1], [0]] and torch.equal(agreed(wall(0.0), maps[1:]).depth, wall(0.0).depth)
    assert torch.equal(agreed(sky, maps[:1]).depth, sky.depth) and maps[1].bounds == pytest.approx((1.0, 1.01))
