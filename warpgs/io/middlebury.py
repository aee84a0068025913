"""Middlebury multi-view scenes: `*_par.txt`, a line per image with K, R and t (Seitz et al. 2006)."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np

from warpgs.errors import DataError
from warpgs.input_files import read_input, unread_reason
from warpgs.io.folders import SceneFolder, ViewList, resampling_note, view_name
from warpgs.io.images import Lens
from warpgs.io.pose_matrices import rigid
from warpgs.io.readers import Probe, Reader, ReadOptions, register
from warpgs.scene import Scene

MAX_BYTES = 2**25
"""Largest file of parameters that is read [bytes]."""


def files_of(root: Path) -> list[Path]:
    """Return the parameter files of a folder, sorted; a scene has one."""
    return sorted(p for p in root.glob("*_par.txt") if p.is_file() and not p.name.startswith("."))


def read_rows(path: Path) -> list[tuple[int, str, np.ndarray]]:
    """Return line number, image name and the numbers K, R, t, float64, shape [21], of each camera.

    Raises:
        DataError: The file is malformed; the message names the line.
    """
    rows, count = [], None
    try:
        text = read_input(path, MAX_BYTES).decode("utf-8-sig")
        for number, line in enumerate(io.StringIO(text), 1):
            words = line.split()
            if not words:
                continue
            if count is None:
                count = int(words[0])
                continue
            values = np.array([float(x) for x in words[1:]])
            if len(values) != 21 or not np.isfinite(values).all():
                raise DataError(
                    f"{path}, line {number}, image {words[0]!r}: needs 21 finite numbers (K, R, t), has "
                    f"{int(np.isfinite(values).sum())}. Copy the file again"
                )
            rows.append((number, words[0], values))
    except (OSError, ValueError) as e:
        why = unread_reason(e) if isinstance(e, OSError) else e
        raise DataError(
            f"{path}: cannot be understood ({why}); expected a count of images in the first line, then a line with a name "
            "and 21 numbers for each image. Copy the file again"
        ) from e
    if count != len(rows):
        raise DataError(f"{path}: announces {count or 0} images and lists {len(rows)}; it is truncated. Copy it again")
    return rows


def _intrinsics(K: np.ndarray, where: str) -> np.ndarray:
    """Return K [3, 3] of a file for pixel centres at +0.5; DataError if it is not a matrix of intrinsics, or skewed."""
    if abs(K[0, 1]) > 1e-3 * abs(K[0, 0]):
        raise DataError(f"{where}: the camera is skewed by {K[0, 1]:.3g} px, which is not supported; rectify the images")
    if not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], (0, 0, 0, 1)):
        raise DataError(f"{where}: K is not a matrix of intrinsics (its lower rows are not 0 fy cy, 0 0 1); calibrate again")
    K[0, 1] = 0.0
    K[:2, 2] += 0.5  # in the file, the centre of the first pixel is 0
    return K


@register("middlebury")
class MiddleburyReader(Reader):
    """Middlebury scenes: a parameter file, and beside it the images that it names."""

    description = "*_par.txt (Middlebury)"
    priority = 50

    def probe(self, folder: Path) -> Probe | None:
        """See `Reader.probe`."""
        files = files_of(folder)
        return Probe(files[0].name) if files else None

    def read(self, folder: Path, options: ReadOptions) -> Scene:
        """See `Reader.read`."""
        path, *others = files_of(folder)
        notes = [f"cameras taken from {path.name}; {', '.join(p.name for p in others)} ignored"] if others else []
        scene, views = SceneFolder(folder, options), ViewList()
        for number, name, values in read_rows(scene.inside(path)):
            where = f"{path}, line {number}, image {name!r}"
            K, viewmat = _intrinsics(values[:9].reshape(3, 3).copy(), where), np.eye(4)
            viewmat[:3, :3], viewmat[:3, 3] = values[9:18].reshape(3, 3), values[18:21]
            viewmat = rigid(viewmat, where)
            file, view = scene.child(folder, name, where), views.claim(view_name(name), where)
            loaded = scene.image(
                file,
                lambda width, height: Lens(K, width, height).checked(where),  # noqa: B023 - called before the next round
                mask=scene.find_mask(file, folder, folder / "masks"),
            )
            views.add(view, viewmat, loaded)
        notes += resampling_note(options.downscale) + views.notes(options)
        return self.scene(folder, views.views, notes, pixels=scene.pixel_source(by_folder=False))
