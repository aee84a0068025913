"""First points from depth: from maps, beyond them, and on the visual hull."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from warpgs import geometry
from warpgs.kernels.sweep import Pixels, cell_means, cell_runs, focal_length, given, lifted, occluding
from warpgs.pipeline.metrics.scores import fitted_region
from warpgs.priors.networks import in_threads, single_threaded_opencv
from warpgs.priors.sweep import complete
from warpgs.scene import Camera, PointCloud, View, ViewDepth

# The coarse start: one Gaussian per pixel with geometrically consistent depth, and wider ones where depth is not
# confirmed.
#
# It is the paper's first level ("initialized using the method proposed in" NexusGS, Zheng et al. 2025). Sources,
# merging and filling were measured in docs/decisions/007-coarse-start.md.

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


Parts = Sequence[Pixels]
"""Pixels in parts, such as one for each view. Their points are never stored: first touches of memory take most of the time."""


def merge_cells(parts: Parts, cell: float) -> list[np.ndarray]:
    """Return the runs of points in one grid cell, int64 [R, 3]: where they begin and end, and the number of the cell.

    Numbers ascend with the place, and have gaps. Cells are ``cell`` times as wide as pixels, rounded to a power of two. Points
    of unequal width (far and near ones) lie on grids of unequal fineness, so every cell is a few pixels wide. With 0 each point
    has a cell.
    """
    if cell == 0:
        pixels = [np.flatnonzero(p.depths.numpy() > 0) for p in parts]
        ends = np.cumsum([*map(len, pixels)])
        return [np.stack([own, own + 1, np.arange(end - len(own), end)], 1) for own, end in zip(pixels, ends)]
    rows = in_threads(lambda p: cell_runs(p, cell, np.zeros((p.depths.shape[0], 9), np.int64), (0,) * 4, (0,) * 4)[0], parts)
    low, high = np.min([r[:, 1:5].min(0) for r in rows], 0), np.max([r[:, 5:].max(0) for r in rows], 0)
    sides = [int(s) for s in high - low + 1]

    def runs(weights: Sequence[int]) -> list[np.ndarray]:
        return in_threads(lambda p, r: cell_runs(p, cell, r, low, weights)[1], parts, rows)

    if math.prod(sides) < 2**62:  # one number for all four sorts much faster than rows do, and in the same order
        return runs([math.prod(sides[k:]) for k in range(1, 5)])
    found = [runs(weights) for weights in np.eye(4, dtype=int)]
    places = np.stack([np.concatenate(own)[:, 2] for own in found], 1)
    numbers = np.split(np.unique(places, axis=0, return_inverse=True)[1].ravel(), np.cumsum([*map(len, found[0])])[:-1])
    return [np.column_stack([own[:, :2], n]) for own, n in zip(found[0], numbers)]


def _ranks(runs: Sequence[np.ndarray]) -> tuple[int, list[np.ndarray]]:
    """Return how many numbers of cells there are, and the rank of each run's number, int64 [R]."""

    def distinct(numbers: np.ndarray) -> np.ndarray:
        numbers = np.sort(numbers, kind="stable")  # fast where parts are sorted
        return numbers[np.diff(numbers, prepend=-1) > 0]

    numbers = distinct(np.concatenate(in_threads(distinct, [own[:, 2] for own in runs])))
    return len(numbers), in_threads(lambda own: np.searchsorted(numbers, own[:, 2]), runs)


def merge(parts: Parts, colors: Sequence[np.ndarray], runs: Sequence[np.ndarray]) -> PointCloud:
    """Return the mean point [u] and colour of every cell, in the order of the cells' numbers; colours [..., 3] are float32."""
    count, ranks = _ranks(runs)
    places, shades = cell_means(count, zip(parts, [c.reshape(-1, 3) for c in colors], runs, ranks))
    return PointCloud(places, shades.astype(np.float32))


def in_free_space(pixels: Pixels, views: Sequence[View], depths: Sequence[np.ndarray], without: int) -> np.ndarray:
    """Return a mask [H, W], True if a point occludes the depths (0 if unknown) of a view other than ``without``, or is none."""
    others = [j for j in range(len(views)) if j != without]
    return occluding([views[j].camera for j in others], [depths[j] for j in others], pixels, FREE_SPACE)


def _tracked(points: PointCloud, views: Sequence[View]) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[Any]]:
    """Return the points that at least two views saw, [N, 3] [u], none without tracks; and what the views know of them.

    Colours [N, 3]; widths [N] of a pixel at each point in the nearest view that saw it [u]; rows, columns and z-depths [u] of
    the points that each view saw, the farthest first.
    """
    cloud = points.seen_by({v.name for v in views}, 2) if points.tracks else NOTHING
    widths, pixels = np.full(len(cloud), np.inf), []
    for view in views:
        own = np.flatnonzero([view.name in t for t in cloud.tracks or ()])
        seen, rows, columns, z = geometry.seen_pixels(view.camera, cloud.points[own])
        widths[own[seen]] = np.minimum(widths[own[seen]], z / focal_length(view.camera))
        order = np.argsort(-z, kind="stable")  # of two in one pixel the nearer is written last
        pixels.append((rows[order], columns[order], z[order]))
    inside = np.isfinite(widths)
    return cloud.points[inside], cloud.colors[inside], widths[inside], pixels


def coarse_points(
    views: Sequence[View], depths: Sequence[ViewDepth], *, merge_px: float, fill_px: float, source: str,
    known: PointCloud = NOTHING,
) -> tuple[PointCloud, list[str]]:  # fmt: skip
    """Return the points of the coarse start, and notes on them: one for each view, and one on the merged cloud.

    The cloud has first the pixels of the consistent ``depths``, merged in cells of ``merge_px`` [px] (0 keeps every pixel).
    Then points of the reconstruction ``known`` that at least two of the views see, where no depth is consistent. Last, filled
    points with the depths of `complete`, which interpolates from ``known``, too, in cells of ``fill_px`` [px] (0 for none). No
    filled point is in space that another view sees through, or in the cell of a consistent point. Views without estimated
    depth get no filled points, to bound the work for each view. ``source`` names the depths in the notes.
    """
    regions = [fitted_region(v) for v in views]
    consistent = [d.valid if r is None else d.valid & r for d, (r, _) in zip(depths, regions)]
    points, colors, widths, pixels_of = _tracked(known, views)
    searched = [i for i, d in enumerate(depths) if fill_px > 0 and d.searched]

    def completed(i: int) -> np.ndarray:
        depth, sure, (rows, columns, z) = depths[i].depth.copy(), consistent[i].copy(), pixels_of[i]
        new = ~sure[rows, columns]
        depth[rows[new], columns[new]], sure[rows[new], columns[new]] = z[new], True
        return complete(depth, sure, views[i].image)

    filled_depths = dict(zip(searched, in_threads(completed, searched)))

    def pixels_of_view(i: int) -> tuple[Pixels, Any, str]:
        view, sure, (region, name) = views[i], consistent[i], regions[i]
        counted = np.ones_like(sure) if region is None else region
        total = max(1, counted.sum())
        text = f"{view.name}: {100 * sure.sum() / total:.0f} % of {'pixels' if region is None else f'the {name}'} by {source}"
        more = None
        if i in filled_depths:
            more = lifted(view.camera, np.where(~sure & counted, filled_depths[i], 0))
            hidden = in_free_space(more, [views[k] for k in searched], list(filled_depths.values()), searched.index(i))
            more = lifted(view.camera, np.where(hidden, 0, filled_depths[i]))
            text += f", {100 * (~hidden).sum() / total:.0f} % filled"
        return lifted(view.camera, np.where(sure, depths[i].depth, 0)), more, "; ".join((text, *depths[i].notes))

    parts, filled_parts, notes = (list(a) for a in zip(*in_threads(pixels_of_view, range(len(views)))))
    cloud, added, filled = merge(parts, [v.image for v in views], merge_cells(parts, merge_px)), NOTHING, NOTHING
    if merge_px > 0 and len(points):
        added, (new,) = _elsewhere(parts, [given(points, widths)], [colors], merge_px)
        parts.append(given(points[new], widths[new]))
    if searched:
        filled, _ = _elsewhere(parts, [filled_parts[i] for i in searched], [views[i].image for i in searched], fill_px)
    more = f"{len(added):,} from the reconstruction, " if len(added) else ""
    pixels = sum(int(c.sum()) for c in consistent)
    notes.append(f"{len(cloud):,} points from {pixels:,} pixels by {source}, {more}{len(filled):,} filled in")
    return joined((cloud, added, filled)), notes


def _elsewhere(parts: Parts, more: Parts, colors: Sequence[np.ndarray], cell: float) -> tuple[PointCloud, list[np.ndarray]]:
    """Merge points of ``more`` parts in cells [px] without points of ``parts``; return them and masks of used points [M]."""
    runs = merge_cells([*parts, *more], cell)
    count, ranks = _ranks(runs)
    free = np.ones(count, bool)
    for rank in ranks[: len(parts)]:
        free[rank] = False
    runs, alone = runs[len(parts) :], [free[rank] for rank in ranks[len(parts) :]]
    left = [own[a] for own, a in zip(runs, alone)]
    return merge(more, colors, left), [np.repeat(a, own[:, 1] - own[:, 0]) for own, a in zip(runs, alone)]


# Extrapolated points where no view looks: beyond the images, and behind the near side of depth edges.
#
# With few cameras, renders of other views show large areas that no photograph shows. The points extrapolate into these
# areas: colour and depth of an image's border continue outwards, and a far surface continues a little behind the near
# one that occludes it (docs/decisions/026-extrapolated-points.md).

EXTRAPOLATED_OPACITY = 0.5
"""Initial opacity of an extrapolated Gaussian."""
BEYOND, BEYOND_PX = 0.25, 16
"""Width of the extrapolated frame around an image, as a fraction of the image width; and width of its cells, one point each
[px]."""
DEPTH_PX, COLOR_PX = 31, 6
"""Radius within which depth and colour at the image's border are averaged for the frame [px]."""
REACH, BEHIND_PX, BEHIND_COLOR_PX = 24, 8, 3
"""Distance by which a far surface is continued behind a near one; width of its cells, one point each; and radius within which
its colour is averaged [px]."""
STEP, EDGE = 1.02, 1.15
"""Ratios of the far to the near depth of two neighbouring pixels. Above the first ratio, a surface ends between them; above the
second, points are added behind the near one."""
SIDES = [(np.s_[1:], np.s_[:-1]), (np.s_[:-1], np.s_[1:]), (np.s_[:, 1:], np.s_[:, :-1]), (np.s_[:, :-1], np.s_[:, 1:])]
"""Pixels that have a neighbour on one of the four sides, and these neighbours."""


def extrapolated_points(views: Sequence[View], depths: Sequence[ViewDepth]) -> PointCloud:
    """Return extrapolated points: first points beyond the images of pinhole cameras, then points behind edges of depth.

    There are none if any view has a mask, an alpha channel or a black background, since the border of a masked region is not
    the border of the image. ``depths`` are the consistent depths of the views.
    """
    if not all_count(views):
        return NOTHING
    known = [i for i, d in enumerate(depths) if d.searched and d.valid.any()]
    filled = dict(zip(known, in_threads(lambda i: complete(depths[i].depth, depths[i].valid, views[i].image), known)))
    clouds = in_threads(lambda i: _beyond(views, i, filled[i]), [i for i in known if views[i].camera.model == "pinhole"])
    clouds += in_threads(lambda i: _behind(views, i, filled[i], [d.depth for d in depths]), known)
    return joined((NOTHING, *clouds))


def all_count(views: Sequence[View]) -> bool:
    """Return whether Gaussians may start behind all pixels of all views."""
    return all(fitted_region(v)[0] is None for v in views)


def _beyond(views: Sequence[View], i: int, depth: np.ndarray) -> PointCloud:
    """Return points around view ``i`` that no image shows; ``depth`` [H, W] is the view's z-depth [u], known everywhere."""
    view = views[i]
    height, width = depth.shape
    pad = int(BEYOND * width)
    down, across = (np.arange(BEYOND_PX // 2 - pad, n + pad, BEYOND_PX) for n in (height, width))
    inverse = _mean_around(1 / depth, DEPTH_PX, down, across)
    image = _mean_around(view.image, COLOR_PX, down, across)
    rows, columns = np.nonzero(((down < 0) | (down >= height))[:, None] | (across < 0) | (across >= width))
    pixels = np.stack([across[columns], down[rows]], 1) + 0.5
    points = geometry.back_project(view.camera, pixels, 1 / inverse[rows, columns].astype(float))
    unseen = ~np.any([geometry.in_image(v.camera, points) for v in views], axis=0)
    return PointCloud(points[unseen], image[rows, columns][unseen].astype(np.float32))


def _behind(views: Sequence[View], i: int, depth: np.ndarray, confirmed: Sequence[np.ndarray]) -> PointCloud:
    """Return points of far surfaces behind near ones in view ``i`` of z-depth [u], known everywhere, [H, W].

    None occludes ``confirmed`` depth of another view, 0 where there is none.
    """
    import cv2

    view = views[i]
    with single_threaded_opencv():
        depth = cv2.medianBlur(depth, 5)
    far, source = depth.copy(), np.arange(depth.size, dtype=np.int32).reshape(depth.shape)
    for _ in range(REACH):
        for here, beside in SIDES:
            ends = far[beside] > STEP * far[here]
            for values in (far, source):
                np.copyto(values[here], values[beside], where=ends)
    rows, columns = np.mgrid[BEHIND_PX // 2 : depth.shape[0] : BEHIND_PX, BEHIND_PX // 2 : depth.shape[1] : BEHIND_PX]
    hidden = far[rows, columns] > EDGE * depth[rows, columns]
    rows, columns = rows[hidden], columns[hidden]
    points = geometry.back_project(view.camera, np.stack([columns, rows], 1) + 0.5, far[rows, columns].astype(float))
    image = _mean_around(view.image, BEHIND_COLOR_PX, *map(np.arange, depth.shape)).reshape(-1, 3)
    keep = ~in_free_space(given(points, np.ones(len(points))), views, confirmed, i)[0]
    return PointCloud(points[keep], image[source[rows, columns]][keep].astype(np.float32))


def _mean_around(values: np.ndarray, reach: int, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Return the means over the squares of ``reach`` pixels to each side of rows [R] x columns [C], shape [R, C, ...].

    Border pixels are repeated outwards.
    """
    for axis, at in enumerate((rows, columns)):
        last = values.shape[axis] - 1
        values = sum(values.take((at + k).clip(0, last), axis) for k in range(-reach, reach + 1)) / (2 * reach + 1)
    return values


# The visual hull: the largest object that explains all silhouettes (Laurentini 1994), carved from an octree.
#
# If views are far apart, a sweep finds few depths, but the alpha channel of each view shows which space is empty.

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
        self.cut = bool(np.concatenate([opaque[0], opaque[-1], opaque[:, 0], opaque[:, -1]]).any())
        """True if the object reaches the border of the image, so that it may extend beyond it."""

    def look(self, points: np.ndarray, radius: np.ndarray | float, pixels: float = 0.0) -> tuple[np.ndarray, ...]:
        """Return three masks [N] for balls around points [N, 3]: all pixels empty; all pixels opaque; the ball in view.

        The ``radius`` of the balls [u] has shape [N], or is one for all; ``pixels`` are added to each radius in the image [px].
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
    for shape in shapes:
        nothing, full, there = shape.look(cells[at], 3**0.5 * half)
        empty[at] += nothing
        inside[at] += full | ~there
        seen[at] += there
        at = at[empty[at] <= len(shapes) // TOLERANT]
    return cells[at[(seen[at] >= max(2.0, SEEN * len(shapes))) & (inside[at] < len(shapes))]]


def _seen_colors(shapes: Sequence[Silhouette], cells: np.ndarray, width: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the mean colours [N, 3] in which views see cells of a ``width`` [u], and the cells that are kept, bool [N].

    A cell is kept if at least `LEAST_VIEWS` views see it at an opaque pixel, unoccluded by other cells, and in similar colours;
    other cells may be empty parts of the hull.
    """
    total, squares = np.zeros((2, len(cells), 3))
    counts = np.zeros(len(cells), int)
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
    counts = counts[:, None]
    mean = total / np.maximum(counts, 1)
    variance = squares / np.maximum(counts, 1) - mean**2
    return mean, (counts[:, 0] >= LEAST_VIEWS) & (variance.max(1) <= LIKE**2)


def hull_points(views: Sequence[View], merge_px: float) -> tuple[PointCloud, str]:
    """Return points on the surface of the visual hull with the colours of the views that see them, and a sentence on them.

    Views with an alpha channel carve; without two of them, or if the silhouettes do not overlap, there are no points. Points
    are merged in cells of ``merge_px`` [px]; 0 merges none.
    """
    if len(shapes := silhouettes(views)) < 2:
        return NOTHING, f"no hull: {len(shapes)} of {len(views)} views have an alpha channel; at least two are needed"
    cells, width = carve(shapes)
    if not len(cells):
        return NOTHING, "no hull: the silhouettes do not overlap in space; check that the poses belong to the images"
    colors, kept = _seen_colors(shapes, cells, width)
    total, cells, colors = len(cells), cells[kept], colors[kept]
    wide = max(width, merge_px * _footprint([s.view.camera for s in shapes], cells))
    places, shades = (given(p, np.full(len(cells), wide)) for p in (cells, colors))
    runs = merge_cells([places], 1.0)
    cloud, shades = (merge([p], [np.float32(colors)], runs) for p in (places, shades))
    cloud = PointCloud(cloud.points, np.float32(shades.points))
    return cloud, f"{len(cloud):,} points on the hull of {len(shapes)} silhouettes, from {len(cells):,} of {total:,} cells"
