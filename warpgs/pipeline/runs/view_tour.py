"""Tours: camera paths through the training views, in an order that makes sense."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from warpgs.pipeline.runs.keyframes import Keyframe
from warpgs.scene import Camera

MAX_DETOUR = 1.5
"""Largest length of a tour by name, as a multiple of one from neighbour to neighbour, that is still taken."""


def _distances(cameras: list[Camera]) -> np.ndarray:
    """Return how far apart cameras are, [N, N]: distance in units of their extent, plus the angle between their axes [rad]."""
    centers, forwards = np.array([c.center for c in cameras]), np.array([c.viewmat[2, :3] for c in cameras])
    apart = np.sqrt(((centers[:, None] - centers[None]) ** 2).sum(-1))
    cosines = np.clip((forwards[:, None] * forwards[None]).sum(-1), -1, 1)
    return apart / max(float(apart.max()), 1e-12) + np.arccos(cosines) + 1e-6


def _neighbour_tour(distances: np.ndarray) -> list[int]:
    """Return an order of N cameras from each to the nearest one left, without crossings that reversing a stretch undoes."""
    count = len(distances)
    order, left = [0], set(range(1, count))
    while left:
        order.append(min(left, key=lambda j: (distances[order[-1], j], j)))
        left.remove(order[-1])
    improved = count < 400  # 2-opt looks at all pairs; a nearest-neighbour tour of many views is smooth enough
    while improved:
        improved = False
        for i in range(count - 1):
            for j in range(i + 1, count):
                before = distances[order[i - 1], order[i]] if i else 0.0
                after = distances[order[j], order[j + 1]] if j + 1 < count else 0.0
                new_before = distances[order[i - 1], order[j]] if i else 0.0
                new_after = distances[order[i], order[j + 1]] if j + 1 < count else 0.0
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
    """True where the views are passed in the order of their names."""


def tour_of(cameras: list[Camera], reaches: list[float], seconds: float, most: int) -> Tour:
    """Return a path through training views at an even pace.

    They are passed in the order of their names where that is the order they were taken in, that is where it is not much
    longer than going from neighbour to neighbour. The path is closed where its ends are neighbours.

    Args:
        cameras: Cameras of the views by name, at least one; pinholes.
        reaches: Distance along each optical axis to what the camera looks at [u]; 0 where that is not known.
        seconds: Duration of the path [s].
        most: Largest number of views passed through; of more, evenly spaced ones are taken.
    """
    distances = _distances(cameras)
    named, near = list(range(len(cameras))), _neighbour_tour(distances)
    lengths = [float(sum(distances[a, b] for a, b in itertools.pairwise(o))) for o in (named, near)]
    by_name = lengths[0] <= MAX_DETOUR * lengths[1]
    order = named if by_name else near
    if len(order) > most:
        order = [order[i] for i in np.unique(np.linspace(0, len(order) - 1, max(most, 2)).round().astype(int))]
    legs = [distances[a, b] for a, b in itertools.pairwise(order)]
    closed = len(order) > 3 and distances[order[-1], order[0]] < 2 * max(legs)
    if closed:
        legs.append(distances[order[-1], order[0]])
        order = [*order, order[0]]
    times = np.concatenate([[0.0], np.cumsum(legs)])
    times = times * (seconds / times[-1]) if len(order) > 1 else times
    keyframes = [Keyframe(cameras[i], float(t), reaches[i]) for i, t in zip(order, times)]
    return Tour(keyframes, closed, by_name)
