"""Sparse points from SIFT matches between views with known poses."""

from __future__ import annotations

import itertools

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


def _triangulate(a: View, b: View, pixels_a: np.ndarray, pixels_b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
    good = (s > 0) & (t > 0) & (sine2 > np.sin(np.radians(MIN_ANGLE)) ** 2)
    for view, pixels in ((a, pixels_a), (b, pixels_b)):
        projected, z = geometry.project_points(view.camera, points)
        good &= (z > 0) & (np.linalg.norm(projected - pixels, axis=1) < MAX_ERROR)
    return points, good


def triangulate_matches(views: list[View]) -> PointCloud:
    """Match SIFT features between pairs of views (Lowe 2004) and triangulate the matches that agree with the known poses.

    Returns:
        N points [u] with the colours of their pixels in [0, 1]; none where nothing matched.
    """
    import cv2

    sift, matcher = cv2.SIFT_create(), cv2.BFMatcher(cv2.NORM_L2)
    features = []
    for view in views:
        gray = cv2.cvtColor((view.image * 255).round().astype(np.uint8), cv2.COLOR_RGB2GRAY)
        mask = None if view.mask is None else view.mask.astype(np.uint8) * 255
        keypoints, descriptors = sift.detectAndCompute(gray, mask)
        # OpenCV's pixel centres are at whole numbers
        features.append((np.array([k.pt for k in keypoints]).reshape(-1, 2) + 0.5, descriptors))
    centers = [v.camera.center for v in views]
    pairs = sorted(itertools.combinations(range(len(views)), 2), key=lambda p: np.linalg.norm(centers[p[0]] - centers[p[1]]))
    points, colors = [np.zeros((0, 3))], [np.zeros((0, 3), np.float32)]
    for i, j in pairs[:MAX_PAIRS]:
        (pixels_i, descriptors_i), (pixels_j, descriptors_j) = features[i], features[j]
        if len(pixels_i) < 2 or len(pixels_j) < 2:
            continue
        matches = matcher.knnMatch(descriptors_i, descriptors_j, k=2)
        ids = np.array([(m.queryIdx, m.trainIdx) for m, n in matches if m.distance < RATIO * n.distance], dtype=int)
        if len(ids) == 0:
            continue
        pixels = pixels_i[ids[:, 0]]
        found, good = _triangulate(views[i], views[j], pixels, pixels_j[ids[:, 1]])
        at = pixels[good].astype(int)
        points.append(found[good])
        colors.append(views[i].image[at[:, 1], at[:, 0]])
    return PointCloud(np.concatenate(points), np.concatenate(colors))
