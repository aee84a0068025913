"""DTU scenes in the layout of IDR: cameras.npz with world_mat_i and scale_mat_i (Yariv et al. 2020)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from warpgs.errors import DataError
from warpgs.io.folders import ViewList, read_mask
from warpgs.io.images import Lens, list_images, load_photo
from warpgs.io.poses import rigid
from warpgs.scene import PointCloud, View

FILES = ("cameras.npz", "cameras_sphere.npz")
FOLDERS = ("image", "images")
LARGEST_MEMBER = 4096
"""Bytes that a 4 x 4 matrix and its header stay below, unpacked."""


def decompose(P: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Split a projection matrix [3, 4] into intrinsics [3, 3] and camera_from_world [4, 4].

    Raises:
        DataError: It is not finite or singular, or its axes are skewed by more than a thousandth.
    """
    M = P[:3, :3]
    if not (np.isfinite(P).all() and abs(np.linalg.det(M)) > 1e-12 * np.abs(M).max() ** 3):
        raise DataError(f"{where}: the projection matrix is not finite or not invertible; calibrate again")
    # RQ by QR of the reversed matrix
    q, r = np.linalg.qr(np.flipud(M).T)
    K, R = np.fliplr(np.flipud(r.T)), np.flipud(q.T)
    signs = np.sign(np.diag(K))
    K, R = K * signs, R * signs[:, None]
    t = np.linalg.solve(K, P[:3, 3])
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
    """The world and scale matrices of the archive, float64 [4, 4] each, by name."""
    matrices = {}
    try:
        with np.load(path, allow_pickle=False) as archive:
            for key in archive.files:
                if key.startswith(("world_mat_", "scale_mat_")) and "inv" not in key:
                    if archive.zip.getinfo(f"{key}.npy").file_size > LARGEST_MEMBER:
                        raise ValueError(f"{key} is too large for a 4 x 4 matrix")
                    matrices[key] = archive[key].astype(np.float64)
    except Exception as e:  # numpy and zipfile raise a dozen types on foreign bytes
        raise DataError(f"{path}: cannot be read as an archive of arrays ({type(e).__name__}: {e}); copy it again") from e
    for key, matrix in matrices.items():
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise DataError(f"{path}: {key} is not a finite [4, 4] matrix but {list(matrix.shape)}; copy the archive again")
    return matrices


def _number(file: Path) -> int | None:
    digits = re.findall(r"\d{1,9}", file.stem)
    return int(digits[-1]) if digits else None


def _masks(root: Path, files: list[Path]) -> dict[Path, Path]:
    """Mask of each image: by name, else by the number in it (image/000003.png, mask/003.png)."""
    folder = next((root / f for f in ("mask", "masks") if (root / f).is_dir()), None)
    masks = [] if folder is None else list_images(folder)
    by_name, by_number = {m.stem: m for m in masks}, {_number(m): m for m in masks}
    if len(by_number) != len(masks):
        by_number = {}  # rect_001_3_r5000: the last number names no view
    found = {f: by_name.get(f.stem) or (None if _number(f) is None else by_number.get(_number(f))) for f in files}
    return {f: m for f, m in found.items() if m is not None}


def load(root: Path, *, downscale: int, invert_masks: bool, **_) -> tuple[list[View], PointCloud | None, list[str]]:
    """Read a DTU scene folder: `image` or `images`, `mask` (matched by name or number), and the camera archive.

    Returns:
        Views in the archive's normalised coordinates, None for points, notes.

    Raises:
        DataError: The archive is malformed, or an image has no camera.
    """
    path = next((root / f for f in FILES if (root / f).is_file()), root / FILES[0])
    matrices = _read_matrices(path)
    images = next((root / f for f in FOLDERS if (root / f).is_dir()), root / FOLDERS[0])
    files = list_images(images)
    cameras = sum(key.startswith("world_mat_") for key in matrices)
    if not files or cameras != len(files):
        raise DataError(
            f"{path}: has {cameras} cameras, but {images} holds {len(files)} images. They are matched in sorted order, so the "
            "counts must agree: restore the set"
        )
    masks, views = _masks(root, files), ViewList()
    for i, file in enumerate(files):
        name = file.relative_to(images).as_posix()
        where = f"{path}, image {name!r}"
        world, scale = matrices.get(f"world_mat_{i}"), matrices.get(f"scale_mat_{i}", np.eye(4))
        if world is None:
            raise DataError(f"{where}: world_mat_{i} is missing; copy the archive again")
        K, viewmat = decompose((world @ scale)[:3], where)
        K[:2, 2] += 0.5  # the archives count pixels from the centre of the first one
        photo = load_photo(
            file,
            lambda width, height: Lens(K, width, height).checked(where),  # noqa: B023 - called before the next round
            downscale=downscale,
            mask=read_mask(masks[file], invert_masks) if file in masks else None,
        )
        views.add(name, viewmat, photo)
    notes = [f"images area-resampled by {downscale}"] if downscale > 1 else []
    return views.views, None, notes + views.notes()
