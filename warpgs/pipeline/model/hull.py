"""The visual hull: the largest object that explains all silhouettes (Laurentini 1994), carved from an octree.

If views are far apart, a sweep finds few depths, but the alpha channel of each view shows which space is empty.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpgs import geometry
from warpgs.pipeline.metrics.region import fitted_region
from warpgs.pipeline.model.depth_points import focal_length, merge, merge_cells
from warpgs.scene import Camera, PointCloud, View

MARGIN = 1.5
"""A point is in the empty region of a view if the nearest opaque pixel is at least this far away [px]."""
FINEST = 1.5
"""Largest width of the finest cells, as the median over the views [px]."""
PROJECTIONS = 2**25
"""Largest number of projections of cells into views at one level of the octree; they take a few seconds."""
MAX_LEVELS = 20
"""Largest number of levels of the octree: the finest cells are then a millionth as wide as the first one."""
TOLERANT = 12
"""Number of views per tolerated error: from this many views on, two must find a cell empty to remove it; from twice as many on,
three."""
SEEN = 0.9
"""Least fraction of the views that must have a cell in their image: space that few views look into cannot be carved."""
OPAQUE_COLOR = 0.9
"""Least opacity of a pixel whose colour is that of the object alone."""
LEAST_VIEWS = 2
"""Fewest views that must see a cell, because unseen cells are inside the object or outside the photographs."""
LIKE = 0.15
"""The colours of a cell are similar if their standard deviation over views is at most this, in the channel that differs
most."""
BEHIND_CELLS = 3.0
"""A cell is hidden if it is farther than this behind the first cell at its pixel, in widths of a cell."""


class Silhouette:
    """The opaque pixels of a view, and their number in any rectangle."""

    def __init__(self, view: View):
        """Sum up the pixels of `fitted_region`, or all pixels if a view has no such region."""
        region, _ = fitted_region(view)
        opaque = np.ones(view.image.shape[:2], bool) if region is None else region
        self.view, self.size = view, np.array([view.camera.width, view.camera.height])
        self.sums = np.zeros((opaque.shape[0] + 1, opaque.shape[1] + 1), np.int64)
        self.sums[1:, 1:] = opaque.cumsum(0, dtype=np.int64).cumsum(1)
        border = np.concatenate([opaque[0], opaque[-1], opaque[:, 0], opaque[:, -1]])
        self.cut = bool(border.any())
        """True if the object reaches the border of the image, so that it may extend beyond it."""

    def look(self, points: np.ndarray, radius: np.ndarray | float, pixels: float = 0.0) -> tuple[np.ndarray, ...]:
        """Return three masks [N] for balls around points [N, 3]: all pixels empty; all pixels opaque; the ball in view.

        Args:
            points: Centres of the balls [u].
            radius: Radius of each ball, shape [N], or one radius for all [u].
            pixels: Distance that is added to each radius in the image [px].
        """
        at, z = geometry.project_points(self.view.camera, points)
        before = z > radius  # the camera is not in the ball, and the ball not behind it
        reach = pixels + focal_length(self.view.camera) * radius / np.where(before, z - radius, 1)
        at = np.where(before[:, None], at, 0)
        low, high = np.floor(at - reach[:, None]), np.floor(at + reach[:, None]) + 1
        inside = (low >= 0).all(1) & (high <= self.size).all(1)
        (left, top), (right, bottom) = (np.clip(e, 0, self.size).astype(np.int64).T for e in (low, high))
        count = self.sums[bottom, right] - self.sums[top, right] - self.sums[bottom, left] + self.sums[top, left]
        area = (right - left) * (bottom - top)
        empty = before & (count == 0) & (inside | (not self.cut))
        there = np.where(before, area > 0, z > -radius)  # a ball around the camera may be in the image
        return empty, before & inside & (count == area), there


def silhouettes(views: Sequence[View]) -> list[Silhouette]:
    """Return the silhouettes of the views with an alpha channel."""
    return [Silhouette(v) for v in views if v.alpha is not None]


def in_empty_region(shapes: Sequence[Silhouette], points: np.ndarray) -> np.ndarray:
    """Return a mask [N]: points [N, 3] at least `MARGIN` px from opaque pixels in more views than `TOLERANT` allows."""
    votes = sum((s.look(points, 0.0, MARGIN)[0].astype(int) for s in shapes), np.zeros(len(points), int))
    return votes > len(shapes) // TOLERANT


def carve(shapes: Sequence[Silhouette]) -> tuple[np.ndarray, float]:
    """Return the centres [N, 3] [u] of the finest cells on the surface of the hull, and their width [u].

    A cell is empty if more views than `TOLERANT` allows show nothing there, and inside if all views that see it show only the
    object. Other cells are divided until they are `FINEST` px wide in the views, or `PROJECTIONS` is reached.

    Args:
        shapes: At least two silhouettes.
    """
    cameras = [s.view.camera for s in shapes]
    focus = geometry.focus_point(cameras)
    half = max(float(np.linalg.norm(c.center - focus)) for c in cameras) or 1.0
    cells = focus[None]
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
    for _ in range(MAX_LEVELS):
        cells = _surface((cells[:, None] + 0.5 * half * corners).reshape(-1, 3), 0.5 * half, shapes)
        half *= 0.5
        if not len(cells) or 2 * half <= FINEST * _footprint(cameras, cells) or 8 * len(cells) * len(shapes) > PROJECTIONS:
            break
    return cells, 2 * half


def _footprint(cameras: Sequence[Camera], points: np.ndarray) -> float:
    """Return the width of a pixel at points [N, 3] in front of the cameras, the median over points and cameras [u]."""
    widths = np.stack([geometry.project_points(c, points)[1] / focal_length(c) for c in cameras])
    return float(np.median(widths[widths > 0])) if (widths > 0).any() else 0.0


def _surface(cells: np.ndarray, half: float, shapes: Sequence[Silhouette]) -> np.ndarray:
    """Return the cells [N, 3] that are neither empty nor inside; ``half`` is half the width of a cell [u]."""
    empty, inside, seen = (np.zeros(len(cells), int) for _ in range(3))
    at = np.arange(len(cells))
    for k, shape in enumerate(shapes):
        nothing, full, there = shape.look(cells[at], 3**0.5 * half)
        empty[at] += nothing
        inside[at] += full | ~there
        seen[at] += there
        at = at[empty[at] <= len(shapes) // TOLERANT]
        if k + 1 == len(shapes):
            break
    kept = (seen[at] >= max(2.0, SEEN * len(shapes))) & (inside[at] < len(shapes))
    return cells[at[kept]]


def _seen_colors(shapes: Sequence[Silhouette], cells: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean colours [N, 3] in which views see cells of a ``width`` [u], and the cells that are kept, bool [N].

    A cell is kept if at least `LEAST_VIEWS` views see it at an opaque pixel, unoccluded by other cells, and in similar colours;
    other cells may be empty parts of the hull.
    """
    total, squares, counts = np.zeros((len(cells), 3)), np.zeros((len(cells), 3)), np.zeros(len(cells), int)
    for shape in shapes:
        view = shape.view
        there, rows, columns, z = geometry.seen_pixels(view.camera, cells)
        # blocks as wide as two cells: no hole between the cells of a surface
        block = max(1, int(np.ceil(2 * width / _footprint([view.camera], cells))))
        first = np.full((view.camera.height // block + 1, view.camera.width // block + 1), np.inf)
        np.minimum.at(first, (rows // block, columns // block), z)
        free = z <= first[rows // block, columns // block] + BEHIND_CELLS * width
        sure = free & (view.alpha[rows, columns] >= OPAQUE_COLOR)
        seen, colors = there[sure], view.image[rows[sure], columns[sure]].astype(float)
        total[seen] += colors
        squares[seen] += colors**2
        counts[seen] += 1
    mean = total / np.maximum(counts, 1)[:, None]
    variance = squares / np.maximum(counts, 1)[:, None] - mean**2
    return mean, (counts >= LEAST_VIEWS) & (variance.max(1) <= LIKE**2)


def hull_points(views: Sequence[View], merge_px: float) -> tuple[PointCloud, str]:
    """Return points on the surface of the visual hull with the colours of the views that see them, and a sentence on them.

    Args:
        views: Training views; those with an alpha channel carve.
        merge_px: Width of the cells in which points are merged into one [px]; 0 merges none.

    Returns:
        The cloud, empty if fewer than two views have an alpha channel or the silhouettes do not overlap.
    """
    shapes = silhouettes(views)
    nothing = PointCloud(np.zeros((0, 3)), np.zeros((0, 3), np.float32))
    if len(shapes) < 2:
        return nothing, f"no hull: {len(shapes)} of {len(views)} views have an alpha channel; at least two are needed"
    cells, width = carve(shapes)
    if not len(cells):
        return nothing, "no hull: the silhouettes do not overlap in space; check that the poses belong to the images"
    colors, kept = _seen_colors(shapes, cells, width)
    total, cells, colors = len(cells), cells[kept], colors[kept]
    wide = max(width, merge_px * _footprint([s.view.camera for s in shapes], cells))
    cloud = merge(cells, colors, merge_cells(cells, np.full(len(cells), wide)))
    return cloud, f"{len(cloud):,} points on the hull of {len(shapes)} silhouettes, from {len(cells):,} of {total:,} cells"
