"""LLFF scenes: poses_bounds.npy, one row of 17 numbers per image in sorted-name order (Mildenhall et al. 2019)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpgs.errors import DataError
from warpgs.input_files import open_input
from warpgs.io.folders import SceneFolder, ViewList, has_folder
from warpgs.io.images import Lens, list_images
from warpgs.io.pose_matrices import from_camera_to_world
from warpgs.io.readers import Probe, Reader, ReadOptions, register
from warpgs.scene import Scene

FILE = "poses_bounds.npy"
MAX_ROWS = 1_000_000
"""Largest number of images."""


def read_rows(path: Path) -> np.ndarray:
    """Return the array of poses_bounds.npy, float64, shape [N, 17].

    Raises:
        DataError: The file does not hold such an array.
    """
    try:
        open_input(path).close()
        # mapped: numpy then compares the announced shape with the file's size before it allocates memory
        rows = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as e:  # numpy raises a dozen types on malformed files
        raise DataError(f"{path}: cannot be read as a numpy array ({type(e).__name__}: {e}); copy it again") from e
    if not isinstance(rows, np.ndarray):
        rows.close()
        raise DataError(f"{path}: is an archive of arrays, not one array [n, 17]; make it again")
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind not in "fiu":
        raise DataError(f"{path}: must be an array [n, 17] of numbers, not {list(rows.shape)} of {rows.dtype}; make it again")
    if len(rows) > MAX_ROWS:
        raise DataError(f"{path}: has {len(rows):,} rows; at most {MAX_ROWS:,} are supported. Make it again")
    return rows.astype(np.float64)


@register("llff")
class LLFFReader(Reader):
    """LLFF scenes: poses_bounds.npy and its image folder."""

    description = "poses_bounds.npy with images or images_N (LLFF)"
    priority = 30

    def probe(self, folder: Path) -> Probe | None:
        """See `Reader.probe`."""
        if not (folder / FILE).is_file():
            return None
        return Probe(FILE, "" if has_folder(folder, "images", "images_*") else "its image folder, images or images_N")

    def read(self, folder: Path, options: ReadOptions) -> Scene:
        """See `Reader.read`."""
        path = folder / FILE
        scene = SceneFolder(folder, options)
        rows = read_rows(scene.inside(path))
        images, factor, note = scene.images()
        files = list_images(images)
        if len(files) != len(rows):
            raise DataError(
                f"{path}: has {len(rows)} poses, but {images} holds {len(files)} images. They are matched in sorted order, so "
                "one missing or extra file would give every image the wrong pose. Copy the scene again, or remake the array."
            )
        views = ViewList()
        for file, row in zip(files, rows):
            name = file.relative_to(images).as_posix()
            where = f"{path}, image {name!r}"
            matrix = row[:15].reshape(3, 5)
            height, width, focal = matrix[:, 4].tolist()
            if not np.isfinite(matrix).all():
                raise DataError(f"{where}: the pose is not finite; estimate it again, or remove row and image")
            lens = Lens(np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]), int(width), int(height))
            # columns: down, right, back, centre
            pose = np.stack([matrix[:, 1], matrix[:, 0], -matrix[:, 2], matrix[:, 3]], axis=1)
            loaded = scene.image(file, lens.checked(where), downscale=factor, mask=scene.find_mask(file, images))
            views.add(name, from_camera_to_world(pose, where, opengl=False), loaded)
        notes = ([note] if note else []) + views.notes(options)
        return self.scene(folder, views.views, notes, pixels=scene.pixel_source(by_folder=True))
