"""Random initial points: where cameras look, around matched points if there are any, and on the object that views show."""

from __future__ import annotations

import numpy as np
import torch

from warpgs import geometry
from warpgs.errors import DataError
from warpgs.pipeline.metrics.region import fitted_region
from warpgs.priors.matches import triangulate_matches
from warpgs.scene import PointCloud, View

OBJECTS = ("foreground", "object")
"""Names of the regions of an object (`fitted_region`): object on black, and object that an alpha channel cuts out."""
MIN_MATCHES = 10
"""Fewest matched points of a view that give depths to its random points."""
NEIGHBORS = 5
"""Number of nearest matched points from which a random pixel takes its depth."""
PAIRS = 2**20
"""Largest number of distances in memory at a time while neighbours are searched."""
DEPTH_SPREAD = 0.1
"""Standard deviation of the logarithm of depth around a matched point."""


def camera_depths(views: list[View]) -> tuple[float, float]:
    """Return the default near and far depth [u]: 0.1 and 10 times the distance to the cameras' focus point.

    Cameras in one place with one direction have no focus point; then the distance is 1 u.
    """
    focus = geometry.focus_point([v.camera for v in views])
    distance = float(np.median([np.linalg.norm(v.camera.center - focus) for v in views]))
    distance = distance if distance > 1e-3 else 1.0
    return 0.1 * distance, 10 * distance


def nearest(points: np.ndarray, queries: np.ndarray, count: int) -> np.ndarray:
    """Return the rows of the ``count`` points [P, 2] nearest to each query [Q, 2], the nearest first, int64 [Q, count]."""
    known, asked = torch.from_numpy(points), torch.from_numpy(queries)
    found = []
    # every pair, some rows at a time: a few hundred points take less time than importing a library of search trees
    for rows in asked.split(max(1, PAIRS // max(1, len(known)))):
        squares = sum((rows[:, i, None] - known[None, :, i]) ** 2 for i in range(2))
        found.append(squares.topk(count, largest=False).indices)
    return torch.cat(found).numpy()


class _Depths:
    """Random depths for pixels of one view: near the depths of nearby matched points, else between the default bounds."""

    def __init__(self, view: View, matched: PointCloud, bounds: tuple[float, float]):
        seen = geometry.in_image(view.camera, matched.points)
        pixels, self.known = geometry.project_points(view.camera, matched.points)
        self.pixels, self.known, self.bounds = pixels[seen], self.known[seen], bounds
        self.has_matches = len(self.known) >= MIN_MATCHES

    def sample(self, pixels: np.ndarray, wanted: int, generator: np.random.Generator) -> np.ndarray:
        """Return depths [u] of the first ``wanted`` pixels, shape [wanted].

        Random numbers are sampled for all pixels [N, 2], so that a depth does not depend on how many are wanted.
        """
        count = len(pixels)
        if not self.has_matches:
            near, far = self.bounds
            return 1 / generator.uniform(1 / far, 1 / near, size=count)[:wanted]
        which, spread = generator.integers(NEIGHBORS, size=count), generator.normal(0, DEPTH_SPREAD, count)
        ids = nearest(self.pixels, pixels[:wanted], NEIGHBORS)
        return self.known[ids[np.arange(wanted), which[:wanted]]] * np.exp(spread[:wanted])


def empty_votes(views: list[View], regions: list[tuple[np.ndarray | None, str]], points: np.ndarray) -> np.ndarray:
    """Count the views in which each point [N, 3] falls on the empty background, int [N]: 0 within the visual hull."""
    votes = np.zeros(len(points), int)
    for view, (region, name) in zip(views, regions):
        if name not in OBJECTS:
            continue
        seen, rows, columns, _ = geometry.seen_pixels(view.camera, points)
        votes[seen] += ~region[rows, columns]
    return votes


def random_points(views: list[View], count: int, generator: np.random.Generator) -> tuple[PointCloud, str]:
    """Return points behind random pixels of the training views with the pixels' colours, and a sentence on how they were made.

    A view with at least 10 triangulated SIFT matches takes each depth from one of the 5 matches nearest to the pixel, spread by
    a tenth (docs/decisions/003-random-start.md). Any other view samples inverse depths uniformly, and prefers points that a
    second view sees. If views show an object on black, or have an alpha channel, points start on the object. Several candidates
    are made, and those that fall on empty pixels in the fewest views are taken, to avoid empty space.

    Raises:
        DataError: Masks leave no pixel of any training view.
    """
    regions = [fitted_region(v) for v in views]
    matched = triangulate_matches(views)
    bounds = camera_depths(views)
    sources = [_Depths(v, matched, bounds) for v in views]
    points, colors = [], []
    for i, (view, source) in enumerate(zip(views, sources)):
        wanted = (i + 1) * count // len(views) - i * count // len(views)
        free = np.ones(view.image.shape[:2], bool) if regions[i][0] is None else regions[i][0]
        rows, columns = np.nonzero(free)
        if len(rows) == 0:
            continue
        chosen = generator.integers(len(rows), size=8 * wanted)
        rows, columns = rows[chosen], columns[chosen]
        pixels = np.stack([columns, rows], 1) + 0.5
        elsewhere = not source.has_matches and len(views) > 1
        # where all are equally good, the first are taken, and the others need no depth
        useful = len(pixels) if elsewhere or any(name in OBJECTS for _, name in regions) else wanted
        candidates = geometry.back_project(view.camera, pixels[:useful], source.sample(pixels, useful, generator))
        worse = empty_votes(views, regions, candidates)
        if elsewhere:
            worse += sum(geometry.in_image(v.camera, candidates).astype(int) for v in views) < 2
        order = np.argsort(worse, kind="stable")
        candidates, rows, columns = candidates[order], rows[order], columns[order]
        points.append(candidates[:wanted])
        colors.append(view.image[rows[:wanted], columns[:wanted]])
    if not points:
        raise DataError(
            "no random start: all pixels of the training views are masked out or transparent; check --mask-keeps and the alpha "
            "channel of the images"
        )
    with_matches = sum(s.has_matches for s in sources)
    how = f"{count:,} random points, {with_matches} of {len(views)} views with depths from {len(matched):,} matched points"
    objects, cut_out = (sum(name == of for _, name in regions) for of in OBJECTS)
    if objects:
        how += f", on the object ({objects} views show it on black)"
    if cut_out:
        how += f", in the opaque areas of {cut_out} views"
    return PointCloud(np.concatenate(points), np.concatenate(colors)), how
