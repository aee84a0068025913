"""Middlebury multi-view scenes: `*_par.txt`, a line per image with K, R and t (Seitz et al. 2006)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpgs.errors import DataError
from warpgs.io.images import Lens, decode, load_photo
from warpgs.io.poses import rigid
from warpgs.scene import Camera, PointCloud, View


def load(root: Path, *, downscale: int, **_) -> tuple[list[View], PointCloud | None, list[str]]:
    """Read a Middlebury scene folder.

    Returns:
        Views in file coordinates, None for points, notes.

    Raises:
        DataError: The file's lines do not hold a name and 21 numbers, their number differs from the count in its first
            line, or an image is missing.
    """
    path = sorted(root.glob("*_par.txt"))[0]
    try:
        lines = [line.split() for line in path.read_text("utf-8-sig").splitlines() if line.strip()]
        count, rows = int(lines[0][0]), [(w[0], np.array([float(x) for x in w[1:]])) for w in lines[1:]]
    except (OSError, UnicodeDecodeError, ValueError, IndexError) as e:
        raise DataError(
            f"{path}: cannot be understood ({e}); its first line is a count, then a name and 21 numbers a line"
        ) from e
    if count != len(rows):
        raise DataError(f"{path}: announces {count} images and lists {len(rows)}; it is truncated. Copy it again")
    views = []
    for number, (name, values) in enumerate(rows, 2):
        where = f"{path}, line {number}, image {name!r}"
        if len(values) != 21 or not np.isfinite(values).all():
            raise DataError(f"{where}: needs 21 finite numbers (K, R, t), has {len(values)}")
        K = values[:9].reshape(3, 3).copy()
        if abs(K[0, 1]) > 1e-3 * K[0, 0]:
            raise DataError(f"{where}: the camera is skewed by {K[0, 1]:.3g} px, which is not supported")
        K[0, 1] = 0.0
        K[:2, 2] += 0.5  # the file counts pixels from the centre of the first one
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = values[9:18].reshape(3, 3), values[18:21]
        color, _ = decode(root / name)
        photo = load_photo(root / name, Lens(K, color.shape[1], color.shape[0]), downscale=downscale)
        camera = Camera(rigid(viewmat, where), photo.K, photo.image.shape[1], photo.image.shape[0])
        views.append(View(name, camera, photo.image, photo.mask))
    return views, None, [f"images area-resampled by {downscale}"] if downscale > 1 else []
