"""Sparse points from SIFT matches between views with known poses."""

from __future__ import annotations

import itertools
from typing import NamedTuple

import numpy as np

from warpgs import geometry
from warpgs.scene import PointCloud, View

RATIO = 0.8
"""Largest ratio of the distances to the best and to the second match (Lowe's test)."""
MAX_ERROR = 2.0
"""Largest reprojection error in either view [px]."""
MIN_ANGLE = 1.0
"""Smallest angle between the two rays [deg]; below it depth is noise."""
MAX_PAIRS = 30
"""Largest number of pairs of views that are matched, nearest first."""


class Features(NamedTuple):
    """SIFT features of one view."""

    pixels: np.ndarray
    """Positions [px], pixel centres at +0.5, shape [N, 2]."""
    descriptors: np.ndarray | None
    """Descriptors, integers from 0 to 255, uint8, shape [N, 128]; None without features."""


def sift_features(view: View, max_pixels: int | None = None, most: int = 0) -> Features:
    """Find the SIFT features of a view (Lowe 2004) within its mask.

    Args:
        view: The view.
        max_pixels: Number of pixels to which a larger image is reduced first; None for the full size.
        most: Largest number of features, those of highest contrast; 0 for all.
    """
    import cv2

    gray = cv2.cvtColor((view.image * 255).round().astype(np.uint8), cv2.COLOR_RGB2GRAY)
    mask = None if view.mask is None else view.mask.astype(np.uint8) * 255
    scale = np.ones(2)
    if max_pixels is not None and gray.size > max_pixels:
        height, width = gray.shape
        shrink = (max_pixels / gray.size) ** 0.5
        size = (max(1, int(width * shrink)), max(1, int(height * shrink)))
        scale = np.array([width, height]) / size
        gray = cv2.resize(gray, size, interpolation=cv2.INTER_AREA)
        mask = None if mask is None else cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST)
    keypoints, descriptors = cv2.SIFT_create(nfeatures=most).detectAndCompute(gray, mask)
    # OpenCV's pixel centres are at whole numbers
    pixels = (np.array([k.pt for k in keypoints]).reshape(-1, 2) + 0.5) * scale
    return Features(pixels, None if descriptors is None else descriptors.astype(np.uint8))


def agreeing_matches(
    a: View, b: View, first: Features, second: Features, min_angle: float = MIN_ANGLE
) -> tuple[np.ndarray, np.ndarray]:
    """Match the features of two views, and triangulate the matches that agree with the views' poses.

    Args:
        a: The first view.
        b: The second view.
        first: Features of the first.
        second: Features of the second.
        min_angle: Smallest angle between the two rays [deg]; 0 if only the matches are used, not their depth.

    Returns:
        For each match, the rows of its two features, int, shape [N, 2], and its point [u], shape [N, 3].
    """
    import cv2

    nothing = np.zeros((0, 2), int), np.zeros((0, 3))
    if first.descriptors is None or second.descriptors is None or min(len(first.pixels), len(second.pixels)) < 2:
        return nothing
    matcher = cv2.BFMatcher(cv2.NORM_L2)
    matches = matcher.knnMatch(first.descriptors.astype(np.float32), second.descriptors.astype(np.float32), k=2)
    ids = np.array([(m.queryIdx, m.trainIdx) for m, n in matches if m.distance < RATIO * n.distance], dtype=int)
    if len(ids) == 0:
        return nothing
    found, good = _triangulate(a, b, first.pixels[ids[:, 0]], second.pixels[ids[:, 1]], min_angle)
    return ids[good], found[good]


def _triangulate(
    a: View, b: View, pixels_a: np.ndarray, pixels_b: np.ndarray, min_angle: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the points [u] midway between the rays of each match, shape [N, 3], and True where they pass the checks [N]."""
    origins = [v.camera.center for v in (a, b)]
    rays = []
    for view, pixels in ((a, pixels_a), (b, pixels_b)):
        far = geometry.back_project(view.camera, pixels, np.ones(len(pixels))) - view.camera.center
        rays.append(far / np.linalg.norm(far, axis=1, keepdims=True))
    baseline = origins[1] - origins[0]
    cosine = (rays[0] * rays[1]).sum(1)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    along = [geometry.matmul(r, baseline) for r in rays]
    s = (along[0] - cosine * along[1]) / sine2
    t = (cosine * along[0] - along[1]) / sine2
    points = 0.5 * (origins[0] + s[:, None] * rays[0] + origins[1] + t[:, None] * rays[1])
    good = (s > 0) & (t > 0) & (sine2 > np.sin(np.radians(min_angle)) ** 2)
    for view, pixels in ((a, pixels_a), (b, pixels_b)):
        projected, z = geometry.project_points(view.camera, points)
        with np.errstate(over="ignore"):  # points beside the camera are infinitely far from their pixels
            good &= (z > 0) & (np.linalg.norm(projected - pixels, axis=1) < MAX_ERROR)
    return points, good


def triangulate_matches(views: list[View]) -> PointCloud:
    """Match SIFT features between pairs of views (Lowe 2004) and triangulate the matches that agree with the known poses.

    Returns:
        N points [u] with the colours of their pixels in [0, 1]; none without matches.
    """
    centers = [v.camera.center for v in views]
    pairs = sorted(itertools.combinations(range(len(views)), 2), key=lambda p: np.linalg.norm(centers[p[0]] - centers[p[1]]))
    pairs = pairs[:MAX_PAIRS]
    features = {i: sift_features(views[i]) for i in sorted({i for pair in pairs for i in pair})}
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.float32)]
    for i, j in pairs:
        ids, found = agreeing_matches(views[i], views[j], features[i], features[j])
        at = features[i].pixels[ids[:, 0]].astype(int)
        points.append(found)
        colors.append(views[i].image[at[:, 1], at[:, 0]])
    return PointCloud(np.concatenate(points), np.concatenate(colors))
