"""The coarse start: one Gaussian per pixel with geometrically consistent depth, and wider ones where depth is not confirmed.

It is the paper's first level ("initialized using the method proposed in" NexusGS, Zheng et al. 2025). Sources, merging and
filling were measured in docs/decisions/007-coarse-start.md.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from warpgs import geometry
from warpgs.pipeline.metrics.region import fitted_region
from warpgs.priors.completion import complete
from warpgs.scene import Camera, PointCloud, View, ViewDepth

NOTHING = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
"""No points."""
FREE_SPACE = 0.95
"""A point that fills a gap occludes the surface of another view if the point's depth there is below this fraction of that
view's depth."""
NEAR_FRACTION, FAR_FRACTION = 1 / 1.3, 3.0
"""Factors of the 2nd and the 98th percentile of known depths: the planes of a sweep lie between the two products. Few of the
planes are at distant surfaces, many at near ones."""
MIN_KNOWN = 10
"""Fewest known points of a view from which its range of depths is taken."""


def joined(clouds: Sequence[PointCloud]) -> PointCloud:
    """Return the points of several clouds as one, without tracks."""
    return PointCloud(np.concatenate([c.points for c in clouds]), np.concatenate([c.colors for c in clouds]))


def depth_bounds(view: View, known: np.ndarray, default: tuple[float, float]) -> tuple[float, float]:
    """Return the range of depths [u] to search in a view, from known points [N, 3], or ``default`` if the view has too few."""
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
    """Return a mask [N], True if a point [N, 3] occludes the depths [H, W] (0 if unknown) of a view other than ``without``."""
    hides = np.zeros(len(points), bool)
    for j, (view, depth) in enumerate(zip(views, depths)):
        if j != without:
            seen, rows, columns, z = geometry.seen_pixels(view.camera, points)
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


@dataclass(frozen=True)
class KnownPoints:
    """Points of a reconstruction that at least two views saw."""

    cloud: PointCloud
    """Points and colours, N of them."""
    widths: np.ndarray
    """Width of a pixel at the depth of each point in the nearest view that saw it [u], shape [N]."""
    pixels: list[tuple[np.ndarray, np.ndarray, np.ndarray]]
    """Rows, columns and z-depths [u] of the points that each view saw, the farthest first; shape [S] each."""

    @staticmethod
    def of(points: PointCloud, views: Sequence[View]) -> KnownPoints:
        """Return the points with at least two of the views in their tracks; none if tracks are unknown."""
        names = {v.name for v in views}
        keep = [t is not None and len(names & t) >= 2 for t in points.tracks or ()] or [False] * len(points)
        chosen, tracks = np.nonzero(keep)[0], [t for t, k in zip(points.tracks or (), keep) if k]
        cloud = PointCloud(points.points[chosen], points.colors[chosen])
        widths, pixels = np.full(len(cloud), np.inf), []
        for view in views:
            tracked = np.array([view.name in t for t in tracks], bool)
            own = np.nonzero(tracked)[0]
            seen, rows, columns, z = geometry.seen_pixels(view.camera, cloud.points[own])
            widths[own[seen]] = np.minimum(widths[own[seen]], z / focal_length(view.camera))
            order = np.argsort(-z, kind="stable")  # of two in one pixel the nearer is written last
            pixels.append((rows[order], columns[order], z[order]))
        inside = np.isfinite(widths)
        return KnownPoints(PointCloud(cloud.points[inside], cloud.colors[inside]), widths[inside], pixels)

    def with_depths(self, i: int, depth: np.ndarray, sure: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return depth and mask of view ``i``, both [H, W], with the depths of these points where the mask was False."""
        rows, columns, z = self.pixels[i]
        new = ~sure[rows, columns]
        depth, more = depth.copy(), sure.copy()
        depth[rows[new], columns[new]], more[rows[new], columns[new]] = z[new], True
        return depth, more


def coarse_points(
    views: Sequence[View], depths: Sequence[ViewDepth], *, merge_px: float, fill_px: float, source: str,
    known: PointCloud = NOTHING,
) -> tuple[PointCloud, list[str]]:  # fmt: skip
    """Return the points of the coarse start, and notes on them.

    Args:
        views: Training views.
        depths: Geometrically consistent depth of each view, confirmed by other views.
        merge_px: Width of the cells in which consistent points are merged into one [px]; 0 keeps every pixel.
        fill_px: Width of the cells of filled points, where no depth is consistent [px]; 0 for no filled points. `complete`
            gives the depths of filled points. No filled point is in space that another view sees through, or in the cell of a
            consistent point. Views without estimated depth get no filled points, to bound the work for each view.
        source: Name of the source in the notes, such as sweep or flow.
        known: Points of a reconstruction. A point is used if at least two of the views see it and no depth is consistent there;
            depth around such points is interpolated from them.

    Returns:
        The cloud: consistent points first, then points of the reconstruction, then filled points. And notes: one per view
        ("image001.png: 71 % of pixels by flow, 20 % filled") and one on the merged cloud.
    """
    regions = [fitted_region(v) for v in views]
    consistent = [d.valid if r is None else d.valid & r for d, (r, _) in zip(depths, regions)]
    seen = KnownPoints.of(known, views)
    completed = {
        i: complete(*seen.with_depths(i, depths[i].depth, consistent[i]), view.image)
        for i, view in enumerate(views)
        if fill_px > 0 and depths[i].searched
    }
    searched = [views[i] for i in completed], list(completed.values())
    found, filled_in, notes = [], [], []
    for i, (view, depth, sure, (region, name)) in enumerate(zip(views, depths, consistent, regions)):
        found.append(_lift(view, depth.depth, sure))
        total = sure.size if region is None else region.sum()
        text = f"{view.name}: {_fraction(sure.sum(), total)} of {'pixels' if region is None else f'the {name}'} by {source}"
        if i in completed:
            free = ~sure & (completed[i] > 0) if region is None else ~sure & region & (completed[i] > 0)
            points, colors, widths = _lift(view, completed[i], free)
            keep = ~in_free_space(points, *searched, list(completed).index(i))
            filled_in.append((points[keep], colors[keep], widths[keep]))
            text += f", {_fraction(keep.sum(), total)} filled"
        notes.append("; ".join((text, *depth.notes)))
    points, colors, widths = (np.concatenate(a) for a in zip(*found))
    cloud = merge(points, colors, merge_cells(points, merge_px * widths) if merge_px > 0 else np.arange(len(points)))
    pixels, added, filled = len(points), NOTHING, NOTHING
    if merge_px > 0:
        own = (seen.cloud.points, seen.cloud.colors, seen.widths)
        added, new = _elsewhere(points, widths, *own, merge_px)
        points, widths = np.concatenate([points, own[0][new]]), np.concatenate([widths, own[2][new]])
    if filled_in:
        filled, _ = _elsewhere(points, widths, *(np.concatenate(a) for a in zip(*filled_in)), fill_px)
    more = f"{len(added):,} from the reconstruction, " if len(added) else ""
    notes.append(f"{len(cloud):,} points from {pixels:,} pixels by {source}, {more}{len(filled):,} filled in")
    return joined((cloud, added, filled)), notes


def _elsewhere(
    points: np.ndarray, widths: np.ndarray, more: np.ndarray, colors: np.ndarray, more_widths: np.ndarray, cell: float
) -> tuple[PointCloud, np.ndarray]:
    """Merge points ``more`` [M, 3] in cells without ``points`` [N, 3]; return the merged points and a mask of used ones [M].

    ``widths`` [N] and ``more_widths`` [M] are widths of a pixel at each point [u]; ``cell`` is the width of a cell [px].
    """
    cells = merge_cells(np.concatenate([points, more]), cell * np.concatenate([widths, more_widths]))
    cells, taken = cells[len(points) :], cells[: len(points)]
    alone = ~np.isin(cells, taken)
    return merge(more[alone], colors[alone], cells[alone]), alone


def _fraction(part: int, whole: int) -> str:
    return f"{100 * part / max(1, whole):.0f} %"
