"""DTU scenes in the layout of IDR: cameras.npz with world_mat_i and scale_mat_i (Yariv et al. 2020)."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np

from warpgs.errors import DataError
from warpgs.io.images import Lens, decode, list_images, load_photo
from warpgs.io.poses import rigid
from warpgs.scene import Camera, PointCloud, View

FILES = ("cameras.npz", "cameras_sphere.npz")


def decompose(P: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Split a projection matrix [3, 4] into intrinsics [3, 3] and camera_from_world [4, 4].

    Raises:
        DataError: It is not finite or singular, or its axes are skewed by more than a thousandth.
    """
    M = P[:3, :3]
    if not (np.isfinite(P).all() and abs(np.linalg.det(M)) > 1e-12 * np.abs(M).max() ** 3):
        raise DataError(f"{where}: the projection matrix is not finite or not invertible")
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


def load(root: Path, *, downscale: int, invert_masks: bool, **_) -> tuple[list[View], PointCloud | None, list[str]]:
    """Read a DTU scene folder: `image` or `images`, `mask` (matched by number), and the camera archive.

    Returns:
        Views in the archive's normalised coordinates, None for points, notes.

    Raises:
        DataError: The archive is malformed, or an image has no camera.
    """
    path = next((root / f for f in FILES if (root / f).is_file()), None)
    if path is None:
        raise DataError(f"{root}: there is no {' or '.join(FILES)}")
    try:
        with np.load(path, allow_pickle=False) as archive:
            matrices = {k: archive[k].astype(np.float64) for k in archive.files if "inv" not in k}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile, KeyError) as e:
        raise DataError(f"{path}: cannot be read as a numpy archive ({e}); copy it again") from e
    images = next((root / f for f in ("image", "images") if (root / f).is_dir()), None)
    files = list_images(images) if images else []
    if not files:
        raise DataError(f"{root}: there is no folder 'image' or 'images' with photographs")
    masks = {int("".join(filter(str.isdigit, p.stem)) or -1): p for p in list_images(root / "mask")}
    views = []
    for i, file in enumerate(files):
        where = f"{path}, image {file.name!r}"
        world, scale = matrices.get(f"world_mat_{i}"), matrices.get(f"scale_mat_{i}", np.eye(4))
        if world is None or world.shape != (4, 4) or scale.shape != (4, 4):
            raise DataError(
                f"{where}: world_mat_{i} is missing or not [4, 4]; there are {len(files)} images. Restore the archive"
            )
        K, viewmat = decompose((world @ scale)[:3], where)
        color, _ = decode(file)
        lens = Lens(K, color.shape[1], color.shape[0])
        digits = "".join(filter(str.isdigit, file.stem))
        mask_file = masks.get(int(digits)) if digits else None
        mask = None if mask_file is None else (decode(mask_file)[0][..., 0] > 0.5) != invert_masks
        photo = load_photo(file, lens, downscale=downscale, mask=mask)
        camera = Camera(viewmat, photo.K, photo.image.shape[1], photo.image.shape[0])
        views.append(View(file.relative_to(images).as_posix(), camera, photo.image, photo.mask))
    return views, None, [f"images area-resampled by {downscale}"] if downscale > 1 else []
