"""Order of near and far in rendered depth, compared with points whose depth is known."""

from __future__ import annotations

import numpy as np

from warpgs import geometry
from warpgs.scene import Camera, PointCloud

MIN_POINTS = 10
"""Fewest points for a correlation: with fewer it is not significant."""
MIN_ALPHA = 0.5
"""Opacity below which a pixel has no depth."""


def depth_order(depth: np.ndarray, alpha: np.ndarray, camera: Camera, seen: PointCloud) -> dict:
    """Return the points that a view sees, those on which something is rendered, and Spearman's rank correlation of the depths.

    The correlation is in [-1, 1]; NaN where fewer than 10 points are drawn, or depth is constant.

    Args:
        depth: Rendered z-depth, any unit, shape [H, W].
        alpha: Rendered opacity, shape [H, W].
        camera: That of the view in the points' coordinates, any size of the same image.
        seen: Points whose track holds the view.
    """
    from scipy.stats import spearmanr

    inside = geometry.in_image(camera, seen.points)
    pixels, wanted = geometry.project_points(camera, seen.points[inside])
    height, width = depth.shape
    columns, rows = np.floor(pixels * (np.array([width, height]) / [camera.width, camera.height])).astype(int).T
    drawn = (alpha[rows, columns] > MIN_ALPHA) & (depth[rows, columns] > 0)
    found, wanted = depth[rows, columns][drawn], wanted[drawn]
    known = len(found) >= MIN_POINTS and np.ptp(found) > 0 and np.ptp(wanted) > 0
    correlation = float(spearmanr(found, wanted).statistic) if known else float("nan")
    return {"points": int(inside.sum()), "drawn": len(found), "correlation": correlation}
