"""Tours: camera paths through the training views, in the order of their names or from neighbour to neighbour."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from warpgs.geometry import matmul
from warpgs.pipeline.films.keyframes import Keyframe
from warpgs.scene import Camera

MAX_DETOUR = 1.5
"""Longest accepted tour in the order of names, as a multiple of the length of the tour from neighbour to neighbour."""
MAX_IMPROVED = 200
"""Largest number of views for which every pair of legs is checked; longer tours are smooth enough without the check."""


def _distances(cameras: list[Camera]) -> list[list[float]]:
    """Return how far apart cameras are, N x N: distance in units of their extent, plus the angle between their poses [rad]."""
    centers, rotations = np.array([c.center for c in cameras]), np.array([c.viewmat[:3, :3] for c in cameras]).reshape(-1, 9)
    apart = np.sqrt(((centers[:, None] - centers[None]) ** 2).sum(-1))
    cosines = np.clip((matmul(rotations, rotations.T) - 1) / 2, -1, 1)
    distances: list[list[float]] = (apart / max(float(apart.max()), 1e-12) + np.arccos(cosines) + 1e-6).tolist()
    return distances


def _neighbour_tour(distances: list[list[float]]) -> list[int]:
    """Return an order of N cameras, each followed by the nearest unvisited one; then crossings are removed (2-opt)."""
    count = len(distances)
    order, left = [0], set(range(1, count))
    while left:
        order.append(min(left, key=lambda j: (distances[order[-1]][j], j)))
        left.remove(order[-1])
    improved = count <= MAX_IMPROVED
    while improved:
        improved = False
        for i in range(count - 1):
            for j in range(i + 1, count):
                before = distances[order[i - 1]][order[i]] if i else 0.0
                after = distances[order[j]][order[j + 1]] if j + 1 < count else 0.0
                new_before = distances[order[i - 1]][order[j]] if i else 0.0
                new_after = distances[order[i]][order[j + 1]] if j + 1 < count else 0.0
                if new_before + new_after < before + after - 1e-9:
                    order[i : j + 1] = order[i : j + 1][::-1]
                    improved = True
    return order


@dataclass(frozen=True)
class Tour:
    """A path through training views."""

    keyframes: list[Keyframe]
    closed: bool
    by_name: bool
    """True if the views are passed in the order of their names."""


def tour_of(cameras: list[Camera], reaches: list[float], seconds: float, most: int) -> Tour:
    """Return a path through training views at an even pace.

    The views are passed in the order of their names if this path is not much longer than one from neighbour to neighbour: then
    the names probably follow the order of capture. The path is closed if its ends are neighbours.

    Args:
        cameras: Cameras of the views by name, at least one; pinholes.
        reaches: Distance along each optical axis to the point that the camera looks at [u]; 0 if unknown.
        seconds: Duration of the path [s].
        most: Largest number of views on the path; if there are more, evenly spaced views are taken.
    """
    distances = _distances(cameras)
    named, near = list(range(len(cameras))), _neighbour_tour(distances)
    lengths = [float(sum(distances[a][b] for a, b in itertools.pairwise(o))) for o in (named, near)]
    by_name = lengths[0] <= MAX_DETOUR * lengths[1]
    order = named if by_name else near
    if len(order) > most:
        order = [order[i] for i in np.unique(np.linspace(0, len(order) - 1, max(most, 2)).round().astype(int))]
    legs = [distances[a][b] for a, b in itertools.pairwise(order)]
    closed = len(order) > 3 and distances[order[-1]][order[0]] < 2 * max(legs)
    if closed:
        legs.append(distances[order[-1]][order[0]])
        order = [*order, order[0]]
    times = np.concatenate([[0.0], np.cumsum(legs)])
    times = times * (seconds / times[-1]) if len(order) > 1 else times
    keyframes = [Keyframe(cameras[i], float(t), reaches[i]) for i, t in zip(order, times)]
    return Tour(keyframes, closed, by_name)
