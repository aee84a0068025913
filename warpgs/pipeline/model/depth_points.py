"""The coarse start: one Gaussian per pixel with geometrically consistent depth, coarser ones where no other view confirms any.

The paper's first level ("initialized using the method proposed in" NexusGS, Zheng et al. 2025). Sources, merging and filling
were measured in docs/decisions/007-coarse-start.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from warpgs import geometry
from warpgs.pipeline.metrics.region import fitted_region
from warpgs.priors.completion import complete
from warpgs.scene import Camera, PointCloud, View, ViewDepth

FREE_SPACE = 0.95
"""A filled point nearer to another view than this fraction of the depth found there would hide what that view sees."""
NEAR_FRACTION, FAR_FRACTION = 1 / 1.3, 3.0
"""Multiples of the 2nd and of the 98th percentile of the depths of known points between which planes lie: what is far takes few
planes, what is near many."""
MIN_KNOWN = 10
"""Known points that a view must hold to bound its depths."""


def depth_bounds(view: View, known: np.ndarray, default: tuple[float, float]) -> tuple[float, float]:
    """Return the range of depths [u] to search in a view, from known points [N, 3], or ``default`` where it holds too few."""
    _, z = geometry.project_points(view.camera, known)
    z = z[geometry.in_image(view.camera, known)]
    if len(z) < MIN_KNOWN:
        return default
    low, high = np.percentile(z, [2, 98])
    return NEAR_FRACTION * float(low), FAR_FRACTION * float(high)


def merge_cells(points: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Return the number of the grid cell of each point [N, 3], int64 [N].

    Cells are as wide as ``widths`` [N] [u], rounded to a power of two. Points of unequal width (far and near ones) lie on grids
    of unequal fineness, so every cell is a few pixels wide.
    """
    level = np.round(np.log2(widths)).astype(np.int64)
    cells = np.column_stack([level, np.floor(points / np.exp2(level)[:, None]).astype(np.int64)])
    if len(cells):
        cells -= cells.min(0)
        sides = [int(s) for s in cells.max(0) + 1]
        if math.prod(sides) < 2**62:  # one number for all four sorts much faster than rows do, and in the same order
            return np.unique(np.ravel_multi_index(cells.T, sides), return_inverse=True)[1].ravel()
    return np.unique(cells, axis=0, return_inverse=True)[1].ravel()


def merge(points: np.ndarray, colors: np.ndarray, cells: np.ndarray) -> PointCloud:
    """Return the mean point and colour of every cell, in the order of the cells' numbers.

    Args:
        points: Positions [u], shape [N, 3].
        colors: Colours in [0, 1], shape [N, 3].
        cells: Number of each point's cell, int64, shape [N].
    """
    _, cells, counts = np.unique(cells, return_inverse=True, return_counts=True)
    counts = counts[:, None]

    def mean(values: np.ndarray) -> np.ndarray:
        return np.stack([np.bincount(cells, v, len(counts)) for v in values.T.astype(float)], 1) / counts

    return PointCloud(mean(points), mean(colors).astype(np.float32))


def in_free_space(points: np.ndarray, views: Sequence[View], depths: Sequence[np.ndarray], without: int) -> np.ndarray:
    """Return a mask [N], True where a point [N, 3] lies before the depths [H, W] (0: none) of a view other than ``without``."""
    hides = np.zeros(len(points), bool)
    for j, (view, depth) in enumerate(zip(views, depths)):
        if j == without:
            continue
        seen = np.nonzero(geometry.in_image(view.camera, points))[0]
        pixels, z = geometry.project_points(view.camera, points[seen])
        columns, rows = np.floor(pixels).astype(int).T
        hides[seen] |= z < FREE_SPACE * depth[rows, columns]
    return hides


def _lift(view: View, depth: np.ndarray, where: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return world points [N, 3] [u], colours [N, 3] and pixel footprints [N] [u] of the pixels of a mask ``where`` [H, W]."""
    rows, columns = np.nonzero(where)
    z = depth[rows, columns].astype(float)
    points = geometry.back_project(view.camera, np.stack([columns, rows], 1) + 0.5, z)
    return points, view.image[rows, columns], z / focal_length(view.camera)


def focal_length(camera: Camera) -> float:
    """Return the geometric mean of both focal lengths [px]."""
    return float(np.sqrt(camera.K[0, 0] * camera.K[1, 1]))


def coarse_points(
    views: Sequence[View], depths: Sequence[ViewDepth], *, merge_px: float, fill_px: float, source: str
) -> tuple[PointCloud, list[str]]:
    """Return the points of the coarse start, and notes on them.

    Args:
        views: Training views.
        depths: Geometrically consistent depth of each, confirmed by other views.
        merge_px: Width of the cells in which consistent points become one [px]; 0 keeps every pixel.
        fill_px: Width of the cells of points where no depth is consistent [px]; 0 leaves those places empty. Their depths are
            those of `complete`; none lies in space that another view looks through, nor beside a consistent point.
        source: Name of the source in the notes, sweep or flow.

    Returns:
        The cloud, consistent points first, empty where no depth is valid; and notes: one per view ("image001.png: 71 % of
        pixels by flow, 20 % filled") and one on the merged cloud.
    """
    regions = [fitted_region(v) for v in views]
    consistent = [d.valid if r is None else d.valid & r for d, (r, _) in zip(depths, regions)]
    completed = [complete(d.depth, s, v.image) for v, d, s in zip(views, depths, consistent)] if fill_px > 0 else []
    found, filled_in, notes = [], [], []
    for i, (view, depth, sure, (region, name)) in enumerate(zip(views, depths, consistent, regions)):
        found.append(_lift(view, depth.depth, sure))
        total = sure.size if region is None else region.sum()
        text = f"{view.name}: {_fraction(sure.sum(), total)} of {'pixels' if region is None else f'the {name}'} by {source}"
        if fill_px > 0:
            free = ~sure & (completed[i] > 0) if region is None else ~sure & region & (completed[i] > 0)
            points, colors, widths = _lift(view, completed[i], free)
            keep = ~in_free_space(points, views, completed, i)
            filled_in.append((points[keep], colors[keep], widths[keep]))
            text += f", {_fraction(keep.sum(), total)} filled"
        notes.append("; ".join((text, *depth.notes)))
    points, colors, widths = (np.concatenate(a) for a in zip(*found))
    cloud = merge(points, colors, merge_cells(points, merge_px * widths) if merge_px > 0 else np.arange(len(points)))
    filled = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    if fill_px > 0:
        more, more_colors, more_widths = (np.concatenate(a) for a in zip(*filled_in))
        cells = merge_cells(np.concatenate([points, more]), fill_px * np.concatenate([widths, more_widths]))
        alone = ~np.isin(cells[len(points) :], cells[: len(points)])
        filled = merge(more[alone], more_colors[alone], cells[len(points) :][alone])
    notes.append(f"{len(cloud):,} points of {len(points):,} pixels by {source}, and {len(filled):,} filled")
    return PointCloud(np.concatenate([cloud.points, filled.points]), np.concatenate([cloud.colors, filled.colors])), notes


def _fraction(part: int, whole: int) -> str:
    return f"{100 * part / max(1, whole):.0f} %"
