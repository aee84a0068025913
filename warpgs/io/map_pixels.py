"""Given maps in the pixels of an image: rotated, undistorted and resized like the image, without mixing near and far depths."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpgs.errors import DataError
from warpgs.io.images import LoadedImage, turn_upright, undistortion_maps

SAME_SURFACE = 0.05
"""Largest relative difference between neighbours that are taken for one surface when a map is enlarged."""


def resized(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return a map [H, W] or [H, W, C] at another size; 0 marks missing values.

    In a reduced map, a pixel takes the known value nearest to its centre, which keeps sparse depths. An enlarged map is
    interpolated between known neighbours on one surface; elsewhere a pixel takes the nearest value.
    """
    import cv2

    rows, columns = values.shape[:2]
    if (rows, columns) == (height, width):
        return values
    if height * width >= rows * columns:
        nearest = cv2.resize(values, (width, height), interpolation=cv2.INTER_NEAREST)
        known = (values != 0) if values.ndim == 2 else (values != 0).any(-1)
        between = cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)
        whole = cv2.resize(known.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 1 - 1e-6
        off = np.abs(between - nearest)
        off, size = (off, np.abs(nearest)) if values.ndim == 2 else (off.max(-1), np.ones((height, width), np.float32))
        smooth = whole & (off <= SAME_SURFACE * size)
        return np.where(smooth if values.ndim == 2 else smooth[..., None], between, nearest)
    at = np.nonzero(values if values.ndim == 2 else values.any(-1))
    row, column = (np.asarray((i + 0.5) * new / old) for i, new, old in zip(at, (height, width), (rows, columns)))
    i, j = np.minimum(row.astype(int), height - 1), np.minimum(column.astype(int), width - 1)
    order = np.argsort(-((row - i - 0.5) ** 2 + (column - j - 0.5) ** 2), kind="stable")  # the nearest is written last
    found = np.zeros((height, width, *values.shape[2:]), values.dtype)
    found[i[order], j[order]] = values[at[0][order], at[1][order]]
    return found


def in_pixels_of(loaded: LoadedImage, values: np.ndarray, path: Path) -> np.ndarray:
    """Rotate, undistort and resize a map like its image; the result has shape [h, w] or [h, w, C] of the image's final size.

    Args:
        loaded: The image at its final size.
        values: The map, upright or oriented like the stored image, at the image's size or another size of the same aspect,
            shape [H, W] or [H, W, C].
        path: File of the map, for errors.

    Raises:
        DataError: The aspects differ, or the map holds vectors and the image was rotated.
    """
    import cv2

    height, width = loaded.full_size
    rows, columns = values.shape[:2]
    if loaded.orientation in (5, 6, 7, 8) and _same_aspect(values.shape, (width, height)):
        if values.ndim == 3:
            raise DataError(
                f"{path}: its image is rotated by an EXIF tag, and normals are not rotated with it; save both upright"
            )
        values = turn_upright(values, loaded.orientation)
    elif not _same_aspect(values.shape, (height, width)):
        raise DataError(
            f"{path}: the map is {columns} x {rows} px, its image {width} x {height}: the aspects differ. Give a map of the "
            "whole image"
        )
    final = loaded.image.shape[:2]
    if loaded.undone is not None:
        values = resized(values, width, height)
        K = np.diag([width / final[1], height / final[0], 1.0]) @ loaded.K
        columns_of, rows_of = undistortion_maps(K, loaded.undone, width, height)
        values = cv2.remap(values, columns_of, rows_of, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    values = resized(values, final[1], final[0])
    if loaded.mask is not None:
        values = np.where(loaded.mask if values.ndim == 2 else loaded.mask[..., None], values, 0)
    return np.ascontiguousarray(values, np.float32)


def _same_aspect(shape: tuple[int, ...], size: tuple[int, int]) -> bool:
    """Return True where a raster has the aspect of a size (height, width), within a pixel of the smaller one."""
    return abs(shape[1] * size[0] - shape[0] * size[1]) <= max(*size, *shape[:2])
