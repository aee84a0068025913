"""Change from file coordinates to scene coordinates, and the fingerprint of a scene."""

from __future__ import annotations

import hashlib
from dataclasses import replace

import numpy as np

from warpgs.errors import DataError
from warpgs.geometry import matmul
from warpgs.scene import Normalization, PointCloud, View

MIN_EXTENT = 1e-9
"""Extent of a camera set [file units] below which all cameras are taken to be in one place."""
MAX_COORDINATE = 1e12
"""Largest coordinate of a camera centre [file units] and of a point [u]; a file with a larger one is rejected."""


def normalization_of(views: list[View], points: PointCloud | None, where: str) -> Normalization:
    """Return the similarity that puts the mean camera centre at the origin and the farthest camera at a distance of 1 / 1.1.

    If all cameras are in one place, points set the scale: the median of their largest offsets along an axis becomes 1. Without
    points the scale is unchanged.

    Raises:
        DataError: A camera centre is absurdly far away; the message begins with ``where`` and names the image.
    """
    centers = np.array([v.camera.center for v in views])
    far = np.abs(centers).max(axis=1)
    if not (far < MAX_COORDINATE).all():
        worst = int(np.argmax(far))
        raise DataError(
            f"{where}, image {views[worst].name!r}: its camera centre {centers[worst].tolist()} is beyond "
            f"{MAX_COORDINATE:.0e} units, so the scene cannot be scaled; estimate its pose again, or remove the image"
        )
    offset = centers.mean(0)
    extent = 1.1 * float(np.linalg.norm(centers - offset, axis=1).max())
    if extent < MIN_EXTENT:
        extent = 1.0
        if points is not None and len(points):
            with np.errstate(over="ignore"):
                median = float(np.median(np.abs(points.points - offset).max(axis=1)))
            extent = median if MIN_EXTENT < median < MAX_COORDINATE else 1.0
    return Normalization(offset, 1 / extent)


def normalize_view(view: View, n: Normalization) -> View:
    """Return the view with camera (float64) and metric depth in scene coordinates; rotation and intrinsics stay."""
    viewmat = view.camera.viewmat.copy()
    viewmat[:3, 3] = n.scale * (matmul(viewmat[:3, :3], n.offset) + viewmat[:3, 3])
    depth = view.depth
    if depth is not None and depth.kind == "metric":
        depth = replace(depth, values=depth.values * np.float32(n.scale))
    return replace(view, camera=replace(view.camera, viewmat=viewmat), depth=depth)


def normalize_points(points: PointCloud, n: Normalization, where: str) -> PointCloud:
    """Return the points in scene coordinates (float64).

    Raises:
        DataError: A point is not finite or absurdly far away; the message begins with ``where``.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        moved = n.scale * (points.points - n.offset)
    far = int((~(np.abs(moved) < MAX_COORDINATE).all(axis=1)).sum())
    if far:
        raise DataError(
            f"{where}: {far} of {len(moved)} points are not finite, or farther than {MAX_COORDINATE:.0e} times the extent of "
            "the cameras; remove them, or reconstruct again"
        )
    return replace(points, points=moved)


def fingerprint(views: list[View]) -> str:
    """Return the SHA-256, hexadecimal, over names, cameras, pixels, masks and given maps of the views in their order."""
    digest = hashlib.sha256()
    for v in views:
        # cameras to 1e-9: their last bits depend on the machine's linear algebra
        cameras = [np.round(m, 9) + 0.0 for m in (v.camera.viewmat, v.camera.K)]
        maps = () if v.depth is None else (v.depth.values, v.depth.confidence)
        arrays = [*cameras, v.image] + [m for m in (v.mask, v.score_mask, v.alpha, *maps, v.normals) if m is not None]
        # name and shapes are delimited, so that bytes moved from one field to the next cannot give the same hash
        lens = () if v.camera.distortion is None else tuple(np.round(v.camera.distortion, 9).tolist())
        model = () if v.camera.model == "pinhole" else (v.camera.model, *lens)
        model += () if v.depth is None else (v.depth.kind, v.depth.confidence is None)
        digest.update(repr((v.name, [(a.shape, str(a.dtype)) for a in arrays], *model)).encode("utf-8", "surrogateescape"))
        for array in arrays:
            digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()
