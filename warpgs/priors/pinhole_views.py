"""Views resampled to pinholes, for searches along epipolar lines (sweeps and flow), and depth mapped back to the lens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from warpgs import lenses
from warpgs.errors import UsageError
from warpgs.priors.epipolar import pixel_grid
from warpgs.scene import Camera, View, ViewDepth


def pinhole_view(view: View) -> View:
    """Return a view resampled to a pinhole of the same K and size; a pinhole's view is returned unchanged.

    Pixels that the lens did not see are removed from the mask. The rim of a wide fisheye is lost.

    Raises:
        UsageError: The camera is orthographic, or its model is only supported by the kernels.
    """
    import cv2

    camera = view.camera
    if camera.model == "pinhole":
        return view
    if camera.model not in lenses.CENTRAL:
        raise UsageError(
            f"depth estimation and coverage need pinholes and do not support the camera model {camera.model!r}: start "
            "from points (--init.source points), with --strategy clone_split or mcmc"
        )
    maps = _lens_pixels(camera) - 0.5  # OpenCV's pixel centres are at whole numbers
    shape = (camera.height, camera.width)
    x, y = (maps[:, i].reshape(shape).astype(np.float32) for i in range(2))
    inside = (x >= -0.5) & (x <= camera.width - 0.5) & (y >= -0.5) & (y <= camera.height - 0.5)

    def moved(raster: np.ndarray) -> np.ndarray:
        return cv2.remap(raster.astype(np.float32), x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    masks = [None if m is None else inside & (moved(m) > 0.5) for m in (view.mask, view.score_mask)]
    mask = inside if masks[0] is None else masks[0]
    alpha = None if view.alpha is None else np.clip(moved(view.alpha), 0, 1) * inside

    def picked(raster: np.ndarray) -> np.ndarray:
        return cv2.remap(raster, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)

    depth = view.depth
    if depth is not None:
        sure = None if depth.confidence is None else picked(depth.confidence)
        depth = replace(depth, values=picked(depth.values), confidence=sure)
    return replace(
        view, camera=replace(camera, model="pinhole", distortion=None), image=moved(view.image),
        mask=None if mask.all() else mask, score_mask=masks[1], alpha=alpha, depth=depth,
    )  # fmt: skip


def lens_depth(camera: Camera, found: ViewDepth) -> ViewDepth:
    """Map depth found in a `pinhole_view` to the pixels of the original camera; invalid where the pinhole sees nothing."""
    if camera.model == "pinhole":
        return found
    plane = (pixel_grid(camera) - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    with np.errstate(all="ignore"):
        rays = lenses.from_plane(camera.model, camera.distortion, plane)
        pixels = rays[:, :2] / rays[:, 2:] * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
        size = np.array([camera.width, camera.height])
        seen = (rays[:, 2] > 0) & (pixels >= 0).all(1) & (pixels < size).all(1)  # a NaN is not seen
    columns, rows = np.floor(np.where(seen[:, None], pixels, 0)).astype(int).T
    shape = (camera.height, camera.width)

    def taken(raster: np.ndarray) -> np.ndarray:
        return raster[rows, columns].reshape(shape)

    valid = taken(found.valid) & seen.reshape(shape)
    per_z = np.where(seen, 1 / np.where(seen, rays[:, 2], 1), 0).reshape(shape)  # rays have depth 1
    depth = np.where(valid, taken(found.depth) * per_z, 0).astype(np.float32)
    sensitivity = np.where(valid, taken(found.sensitivity) * per_z, np.inf).astype(np.float32)
    given = None if found.given is None else (taken(found.given) * per_z).astype(np.float32)
    return replace(found, depth=depth, valid=valid, sensitivity=sensitivity, given=given)


def _lens_pixels(camera: Camera) -> np.ndarray:
    """Return for each pixel of a pinhole with the same K the lens pixel [H * W, 2] in its direction; far off if none exists."""
    plane = (pixel_grid(camera) - camera.K[:2, 2]) / camera.K[[0, 1], [0, 1]]
    positions = np.concatenate([plane, np.ones((len(plane), 1))], 1)
    with np.errstate(all="ignore"):
        found = lenses.to_plane(camera.model, camera.distortion, positions) * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
    seen = lenses.on_lens(camera.model, camera.distortion, positions)
    return np.where(seen[:, None] & np.isfinite(found), found, -1e6)
