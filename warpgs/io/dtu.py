"""DTU scenes in the layout of IDR: cameras.npz with world_mat_i and scale_mat_i (Yariv et al. 2020)."""

from __future__ import annotations

import io
import re
from pathlib import Path

import numpy as np

from warpgs.errors import DataError
from warpgs.geometry import matmul
from warpgs.input_files import read_input
from warpgs.io.folders import SceneFolder, ViewList, has_folder, resampling_note
from warpgs.io.images import Lens, list_images
from warpgs.io.pose_matrices import rigid
from warpgs.io.readers import Probe, Reader, ReadOptions, register
from warpgs.scene import Scene

FILES = ("cameras.npz", "cameras_sphere.npz")
FOLDERS = ("image", "images")
MAX_ARCHIVE_BYTES = 2**24
"""Size of the largest archive that is read [bytes]; an archive of 64 cameras has a hundred thousand."""
MAX_MATRIX_BYTES = 4096
"""Largest accepted size of an unpacked 4 x 4 matrix with its header [bytes]."""


def decompose(P: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Split a projection matrix [3, 4] into intrinsics [3, 3] and camera_from_world [4, 4].

    Raises:
        DataError: The matrix is not finite, is singular, or has a skew of more than a thousandth of the focal length.
    """
    M = P[:3, :3]
    if not (np.isfinite(P).all() and abs(np.linalg.det(M)) > 1e-12 * np.abs(M).max() ** 3):
        raise DataError(f"{where}: the projection matrix is not finite or not invertible; calibrate again")
    # M = K R by Gram-Schmidt from the last row, and K t by substitution: LAPACK's rounding depends on the processor
    K, R, t = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(3)
    for i in (2, 1, 0):
        K[i, i + 1 :] = (R[i + 1 :] * M[i]).sum(1)
        axis = M[i] - (K[i, i + 1 :, None] * R[i + 1 :]).sum(0)
        K[i, i] = np.sqrt((axis * axis).sum())
        R[i] = axis / K[i, i]
        t[i] = (P[i, 3] - (K[i, i + 1 :] * t[i + 1 :]).sum()) / K[i, i]
    if np.linalg.det(R) < 0:  # P is given up to sign
        R, t = -R, -t
    K = K / K[2, 2]
    if abs(K[0, 1]) > 1e-3 * K[0, 0]:
        raise DataError(f"{where}: the camera is skewed by {K[0, 1]:.3g} px, which is not supported; rectify the images")
    K[0, 1] = 0.0
    viewmat = np.eye(4)
    viewmat[:3, :3], viewmat[:3, 3] = R, t
    return K, rigid(viewmat, where)


def _read_matrices(path: Path) -> dict[str, np.ndarray]:
    """Return the world and scale matrices of the archive by name, float64, shape [4, 4] each."""
    matrices = {}
    try:
        with np.load(io.BytesIO(read_input(path, MAX_ARCHIVE_BYTES)), allow_pickle=False) as archive:
            for key in archive.files:
                if key.startswith(("world_mat_", "scale_mat_")) and "inv" not in key:
                    if archive.zip.getinfo(f"{key}.npy").file_size > MAX_MATRIX_BYTES:
                        raise ValueError(f"{key} is too large for a 4 x 4 matrix")
                    matrices[key] = archive[key].astype(np.float64)
    except Exception as e:  # numpy and zipfile raise a dozen types on malformed files
        raise DataError(f"{path}: cannot be read as an archive of arrays ({type(e).__name__}: {e}); copy it again") from e
    for key, matrix in matrices.items():
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise DataError(
                f"{path}: {key} must be finite and [4, 4]; its shape is {list(matrix.shape)}. Copy the archive again"
            )
    return matrices


def _number(file: Path) -> int | None:
    digits = re.findall(r"\d{1,9}", file.stem)
    return int(digits[-1]) if digits else None


def _masks(root: Path, files: list[Path]) -> dict[Path, Path]:
    """Return the mask file of each image that has one, by name, else by number (image/000003.png, mask/003.png)."""
    folder = next((root / f for f in ("mask", "masks") if (root / f).is_dir()), None)
    masks = [] if folder is None else list_images(folder)
    by_name, by_number = {m.stem: m for m in masks}, {_number(m): m for m in masks}
    if len(by_number) != len(masks):
        by_number = {}  # rect_001_3_r5000: the last number names no view
    found = {f: by_name.get(f.stem) or (None if _number(f) is None else by_number.get(_number(f))) for f in files}
    return {f: m for f, m in found.items() if m is not None}


@register("dtu")
class DTUReader(Reader):
    """DTU scenes: `image` or `images`, `mask` or `masks` (matched by name or number), and the camera archive.

    Scenes are in the archive's normalised coordinates.
    """

    description = "cameras.npz or cameras_sphere.npz with image or images (DTU)"
    priority = 40

    def probe(self, folder: Path) -> Probe | None:
        """See `Reader.probe`."""
        found = next((f for f in FILES if (folder / f).is_file()), None)
        if found is None:
            return None
        return Probe(found, "" if has_folder(folder, *FOLDERS) else f"its image folder, {' or '.join(FOLDERS)}")

    def read(self, folder: Path, options: ReadOptions) -> Scene:
        """See `Reader.read`."""
        path = next((folder / f for f in FILES if (folder / f).is_file()), folder / FILES[0])
        scene = SceneFolder(folder, options)
        matrices = _read_matrices(scene.inside(path))
        images = next((folder / f for f in FOLDERS if (folder / f).is_dir()), folder / FOLDERS[0])
        files = list_images(images)
        cameras = sum(key.startswith("world_mat_") for key in matrices)
        if not files or cameras != len(files):
            raise DataError(
                f"{path}: has {cameras} cameras, but {images} holds {len(files)} images. They are matched in sorted order, so "
                "the counts must agree. Copy the scene again"
            )
        masks, views = _masks(folder, files), ViewList()
        for i, file in enumerate(files):
            name = file.relative_to(images).as_posix()
            where = f"{path}, image {name!r}"
            world, scale = matrices.get(f"world_mat_{i}"), matrices.get(f"scale_mat_{i}", np.eye(4))
            if world is None:
                raise DataError(f"{where}: world_mat_{i} is missing; copy the archive again")
            K, viewmat = decompose(matmul(world, scale)[:3], where)
            K[:2, 2] += 0.5  # the archives count pixels from the centre of the first one
            loaded = scene.image(
                file,
                lambda width, height: Lens(K, width, height).checked(where),  # noqa: B023 - called before the next round
                mask=scene.mask(masks[file]) if file in masks else None,
            )
            views.add(name, viewmat, loaded)
        notes = resampling_note(options.downscale) + views.notes(options)
        return self.scene(folder, views.views, notes, pixels=scene.pixel_source(by_folder=False))
