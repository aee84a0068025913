"""Extrapolated points where no view looks: beyond the images, and behind the near side of depth edges.

With few cameras, renders of other views show large areas that no photograph shows. The points extrapolate into these areas:
colour and depth of an image's border continue outwards, and a far surface continues a little behind the near one that occludes
it (docs/decisions/026-extrapolated-points.md).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from warpgs import geometry
from warpgs.pipeline.metrics.region import fitted_region
from warpgs.pipeline.model.depth_points import NOTHING, in_free_space, joined
from warpgs.priors.completion import complete
from warpgs.priors.opencv import single_threaded_opencv
from warpgs.scene import PointCloud, View, ViewDepth

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
SIDES = ((0, 1), (0, -1), (1, 1), (1, -1))
"""Axis and direction of the four neighbours of a pixel."""


def extrapolated_points(views: Sequence[View], depths: Sequence[ViewDepth]) -> PointCloud:
    """Return extrapolated points: first points beyond the images of pinhole cameras, then points behind edges of depth.

    There are none if any view has a mask, an alpha channel or a black background, since the border of a masked region is not
    the border of the image.

    Args:
        views: Training views.
        depths: Geometrically consistent depth of each.
    """
    if not all_count(views):
        return NOTHING
    known = [i for i, d in enumerate(depths) if d.searched and d.valid.any()]
    filled = {i: complete(depths[i].depth, depths[i].valid, views[i].image) for i in known}
    found = [_beyond(views, i, filled[i]) for i in known if views[i].camera.model == "pinhole"]
    confirmed = [d.depth for d in depths]
    found += [_behind(views, i, filled[i], confirmed) for i in known]
    return joined((NOTHING, *found))


def all_count(views: Sequence[View]) -> bool:
    """Return whether Gaussians may start behind all pixels of all views."""
    return all(fitted_region(v)[0] is None for v in views)


def _beyond(views: Sequence[View], i: int, depth: np.ndarray) -> PointCloud:
    """Return points around view ``i`` that no image shows; ``depth`` [H, W] is the view's z-depth [u], known everywhere."""
    view = views[i]
    height, width = depth.shape
    pad = int(BEYOND * width)
    inverse = _mean_around(np.pad(1 / depth, pad, "edge"), DEPTH_PX)
    image = _mean_around(np.pad(view.image, ((pad, pad), (pad, pad), (0, 0)), "edge"), COLOR_PX)
    half = BEYOND_PX // 2
    rows, columns = np.mgrid[half : height + 2 * pad : BEYOND_PX, half : width + 2 * pad : BEYOND_PX].reshape(2, -1)
    outside = (rows < pad) | (rows >= height + pad) | (columns < pad) | (columns >= width + pad)
    rows, columns = rows[outside], columns[outside]
    pixels = np.stack([columns, rows], 1) - pad + 0.5
    points = geometry.back_project(view.camera, pixels, 1 / inverse[rows, columns].astype(float))
    unseen = ~np.any([geometry.in_image(v.camera, points) for v in views], axis=0)
    return PointCloud(points[unseen], image[rows, columns][unseen].astype(np.float32))


def _behind(views: Sequence[View], i: int, depth: np.ndarray, confirmed: Sequence[np.ndarray]) -> PointCloud:
    """Return points of far surfaces behind near ones in view ``i``; none occludes confirmed depth of another view.

    Args:
        views: All views.
        i: Index of the view.
        depth: Its z-depth [u], known everywhere, shape [H, W].
        confirmed: Consistent depth of each view, 0 where there is none, shape [H, W] each.
    """
    import cv2

    view = views[i]
    with single_threaded_opencv():
        depth = cv2.medianBlur(depth, 5)
    far, source = depth, np.arange(depth.size).reshape(depth.shape)
    for _ in range(REACH):
        for axis, direction in SIDES:
            beside, its_source = (_neighbour(t, axis, direction) for t in (far, source))
            ends = beside > STEP * far
            far, source = np.where(ends, beside, far), np.where(ends, its_source, source)
    half = BEHIND_PX // 2
    rows, columns = np.mgrid[half : depth.shape[0] : BEHIND_PX, half : depth.shape[1] : BEHIND_PX].reshape(2, -1)
    hidden = far[rows, columns] > EDGE * depth[rows, columns]
    rows, columns = rows[hidden], columns[hidden]
    pixels = np.stack([columns, rows], 1) + 0.5
    points = geometry.back_project(view.camera, pixels, far[rows, columns].astype(float))
    image = _mean_around(view.image, BEHIND_COLOR_PX).reshape(-1, 3)
    keep = ~in_free_space(points, views, confirmed, i)
    return PointCloud(points[keep], image[source[rows, columns]][keep].astype(np.float32))


def _neighbour(values: np.ndarray, axis: int, direction: int) -> np.ndarray:
    """Return the value of each pixel's neighbour on one side of it, shape [H, W]; 0 beyond the border."""
    shifted = np.roll(values, direction, axis)
    shifted[(slice(None),) * axis + (0 if direction > 0 else -1,)] = 0
    return shifted


def _mean_around(values: np.ndarray, reach: int) -> np.ndarray:
    """Return the mean over the square of ``reach`` pixels to each side, border pixels repeated outwards, shape [H, W, ...]."""
    for axis in (0, 1):
        count, pads = values.shape[axis], [(0, 0)] * values.ndim
        pads[axis] = (reach, reach)
        padded = np.pad(values, pads, "edge")
        parts = [slice(None)] * axis
        values = sum(padded[(*parts, slice(k, k + count))] for k in range(2 * reach + 1)) / (2 * reach + 1)
    return values
