"""Costs, paths and best planes of a depth sweep in numpy and OpenCV, with threads over views and planes."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from warpgs.priors.sweep_planes import (
    NEUTRAL_COST,
    NOISE,
    PLANES_AT_ONCE,
    UNIT,
    SweepConfig,
    gray_of,
    plane_homography,
    step_limits,
)
from warpgs.scene import View


def matching_costs(view: View, others: Sequence[View], inverses: np.ndarray, window: int) -> np.ndarray:
    """Return the disagreement of views at D inverse depths [1/u], in [0, 1], float32, shape [D, H, W].

    The cost of one other view is 0.5 (1 - correlation). Their mean and their smallest count one half each: a view that does
    not see the point counts, but cannot outvote one that does.
    """
    import cv2

    size, box = (view.camera.width, view.camera.height), (window, window)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    own, *grays = [gray_of(v) for v in (view, *others)]
    mean = cv2.blur(own, box)
    variance = np.maximum(cv2.blur(own * own, box) - mean * mean, 0) + NOISE
    planes = np.empty((len(inverses), *own.shape), np.float32)
    # every step writes into one of these: to make arrays anew takes as long as to fill them
    warped, product, m, v, cost, least = (np.empty_like(own) for _ in range(6))
    outside = np.empty(own.shape, bool)
    for inverse, total in zip(inverses, planes):
        total.fill(0)
        least.fill(np.inf)
        for other, gray in zip(others, grays):
            H = plane_homography(view.camera, other.camera, inverse)
            cv2.warpPerspective(gray, H, size, warped, flags=flags, borderMode=cv2.BORDER_CONSTANT, borderValue=-1)
            cv2.blur(warped, box, m)
            cv2.blur(np.multiply(warped, warped, out=product), box, v)
            v -= np.multiply(m, m, out=product)
            np.maximum(v, 0, out=v)
            v += NOISE
            v *= variance
            np.sqrt(v, out=v)
            cv2.blur(np.multiply(own, warped, out=product), box, cost)
            cost -= np.multiply(mean, m, out=product)
            cost /= v
            cost *= -0.5
            cost += 0.5
            np.logical_not(np.greater_equal(warped, 0, out=outside), out=outside)
            np.copyto(cost, NEUTRAL_COST, where=outside)
            total += cost
            np.minimum(least, cost, out=least)
        total *= 0.5 / len(others)
        least *= 0.5
        total += least
    return planes


def path_costs(costs: np.ndarray, image: np.ndarray, small_step: float, large_step: float, *, down: bool) -> np.ndarray:
    """Return the sum of the semi-global path costs from above and below, or from left and right.

    Args:
        costs: Matching costs in units of 1 / `UNIT`, int16, shape [H, W, D].
        image: Colours in [0, 1] whose edges allow jumps, shape [H, W, 3].
        small_step: Penalty for a change of one plane.
        large_step: Penalty for any other change, times exp(-step of the image / EDGE).
        down: Paths run along columns; else along rows.

    Returns:
        Sums in units of 1 / `UNIT`, int16, shape [H, W, D].
    """
    total = np.zeros_like(costs)
    c, t, colors = (a if down else a.swapaxes(0, 1) for a in (costs, total, image))
    bounds, small = step_limits(colors, small_step, large_step), np.int16(round(small_step * UNIT))
    for order, edge in ((range(len(c)), -1), (range(len(c) - 1, -1, -1), 0)):
        path = None
        for k in order:
            if path is None:
                path = c[k].copy()
            else:
                lowest = path.min(1, keepdims=True)
                step = np.minimum(path, lowest + bounds[k + edge, :, None])
                path += small
                np.minimum(step[:, 1:], path[:, :-1], out=step[:, 1:])
                np.minimum(step[:, :-1], path[:, 1:], out=step[:, :-1])
                step -= lowest
                step += c[k]
                path = step
            t[k] += path
    return total


def best_inverse(costs: np.ndarray, inverses: np.ndarray) -> np.ndarray:
    """Return the inverse depth [1/u], shape [H, W], of least cost [H, W, D], refined by the parabola through three costs."""
    k = np.clip(costs.argmin(2), 1, len(inverses) - 2)
    left, middle, right = (np.take_along_axis(costs, (k + o)[..., None], 2)[..., 0].astype(float) for o in (-1, 0, 1))
    bend = left - 2 * middle + right
    offset = np.where(bend > 1e-9, 0.5 * (left - right) / np.maximum(bend, 1e-9), 0).clip(-1, 1)
    return inverses[0] + (k + offset) * (inverses[1] - inverses[0])


def inverse_depths(
    views: Sequence[View],
    others: dict[int, list[View]],
    planes: dict[int, np.ndarray],
    config: SweepConfig,
    pool: ThreadPoolExecutor,
) -> list[np.ndarray]:
    """Return inverse depths of the views that have planes; the threads of ``pool`` divide the planes, then the paths.

    Args:
        views: All views.
        others: For each view to sweep, by index, the views to compare it with; at least one.
        planes: Inverse depths [1/u] of its planes, ascending, shape [D].
        config: Window, penalties.
        pool: Threads.

    Returns:
        Inverse depths [1/u], float64, shape [H, W], in the order of ``planes``.
    """
    costs = {i: np.empty((*views[i].image.shape[:2], len(p)), np.int16) for i, p in planes.items()}

    def match(part: tuple[int, int]) -> None:
        i, first = part
        chosen = slice(first, first + PLANES_AT_ONCE)
        found = matching_costs(views[i], others[i], planes[i][chosen], config.window)
        np.rint(np.clip(found, 0, 1, out=found) * np.float32(UNIT), out=found)  # rounding may leave a cost below 0
        costs[i][..., chosen] = found.transpose(1, 2, 0)

    def paths(way: tuple[int, bool]) -> np.ndarray:
        i, down = way
        return path_costs(costs[i], views[i].image, config.small_step, config.large_step, down=down)

    def best(i: int) -> np.ndarray:
        total = summed[i, True]
        total += summed[i, False]
        return best_inverse(total, planes[i])

    ways = [(i, down) for i in planes for down in (True, False)]
    # numpy and OpenCV let other threads run meanwhile
    list(pool.map(match, [(i, first) for i in planes for first in range(0, len(planes[i]), PLANES_AT_ONCE)]))
    summed = dict(zip(ways, pool.map(paths, ways)))
    return list(pool.map(best, planes))
