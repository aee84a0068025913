"""Neighbours that see the same from another side, and few views that see what all see."""

import numpy as np

from warpgs.geometry import look_at
from warpgs.priors.sweep import matching_views, shared_sight, spread_views
from warpgs.scene import Camera

K = np.array([[100.0, 0, 40], [0, 100, 30], [0, 0, 1]])
UP = np.array([0.0, -1.0, 0.0])


def ring(angles, radius: float = 4.0, look: float = 1.0) -> list[Camera]:
    """Return cameras on a circle, which look at its centre, or away from it for ``look`` = -1."""
    centers = [radius * np.array([np.sin(a), 0, -np.cos(a)]) for a in np.radians(angles)]
    return [Camera(look_at(c, c - look * c, UP), K, 80, 60) for c in centers]


def test_neighbours_see_the_same_from_another_side():
    """Neither a camera in the same place, nor the nearest one that looks away, is preferred to one a few degrees aside."""
    cameras = [*ring([0, 0.05, 8, 100]), *ring([2], look=-1)]
    sight = shared_sight(cameras, [(3, 5)] * 5)
    assert matching_views(sight, cameras, 0, 4, range(5))[0] == 2
    assert not {3, 4} & set(matching_views(sight, cameras, 0, 4, range(5)))
    overlap, matching = sight
    assert overlap[0, 1] > 0.99 and matching[0, 1] < 0.01 < 0.8 < matching[0, 2]
    assert (np.diag(matching) == 0).all() and (overlap[0, 3:] == 0).all()


def test_views_that_share_nothing_take_the_nearest():
    """Where sampled points find nothing shared, the nearest cameras among those allowed are taken."""
    cameras = ring([0, 90, 180, 200])
    sight = shared_sight(cameras, [(0.5, 1)] * 4)
    assert not sight[1].any()
    assert matching_views(sight, cameras, 0, 2, range(4)) == [1, 3] and matching_views(sight, cameras, 0, 2, [2, 3]) == [3, 2]


def test_few_views_cover_all():
    """Of two dense groups and one lone view, every one gets a view; few views are all taken, and none twice."""
    cameras = ring([0, 1, 2, 3, 4, 120, 121, 122, 240])
    sight = shared_sight(cameras, [(3, 5)] * 9)
    taken = spread_views(sight, 3)
    assert len(taken) == 3 and taken[0] in range(5) and taken[1] in (5, 6, 7) and taken[2] == 8
    arc = ring(range(31), look=1)
    assert np.diff(spread_views(shared_sight(arc, [(3, 5)] * 31), 4)).min() > 4  # although all see nearly the same
    same = shared_sight(ring([0] * 4), [(3, 5)] * 4)
    assert spread_views(same, 3) == [0, 1, 2]
    assert spread_views(sight, 9) == list(range(9)) and len(spread_views(sight, 8)) == 8
