"""Scenes as the data sets LLFF, DTU and Middlebury store them."""

import io
import re
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from warpgs.errors import DataError, explained
from warpgs.files import read_input
from warpgs.geometry import matmul, pose_of
from warpgs.io import folder as scenes
from warpgs.io.colmap import understood
from warpgs.io.folder import Probe, Reader, SceneFolder, ViewList, register
from warpgs.io.images import Lens, ReadOptions, list_images
from warpgs.io.maps import read_array
from warpgs.scene import Scene

IN_ORDER = "They are matched in sorted order, so one file too many or too few would give all a wrong pose. Copy the scene again"
"""Why the numbers of cameras and images must be equal, for messages."""
MAX_BYTES = 2**25
"""Largest file of parameters that is read [bytes]."""

# LLFF scenes: poses_bounds.npy, one row of 17 numbers per image in sorted-name order (Mildenhall et al. 2019).

FILE = "poses_bounds.npy"


def read_poses_bounds(path: Path) -> np.ndarray:
    """Return the array of poses_bounds.npy, float64, shape [N, 17]."""
    rows = read_array(path, MAX_BYTES, "make it again")
    if rows.ndim != 2 or rows.shape[1] != 17 or rows.dtype.kind not in "fiu":
        raise DataError(f"{path}: must be an array [n, 17] of numbers, not {list(rows.shape)} of {rows.dtype}; make it again")
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
        return Probe(FILE, "" if scenes.has_folder(folder, "images", "images_*") else "its image folder, images or images_N")

    def read(self, folder: Path, options: ReadOptions) -> Scene:
        """See `Reader.read`."""
        path = folder / FILE
        scene = SceneFolder(folder, options)
        rows = read_poses_bounds(scene.inside(path))
        images, factor, note = scene.images()
        if len(files := list_images(images)) != len(rows):
            raise DataError(f"{path}: has {len(rows)} poses, but {images} holds {len(files)} images. {IN_ORDER}")
        views = ViewList(options)
        for file, row in zip(files, rows):
            name = file.relative_to(images).as_posix()
            if options.excludes(name):
                continue
            where = f"{path}, image {name!r}"
            matrix = row[:15].reshape(3, 5)
            height, width, focal = matrix[:, 4].tolist()
            if not np.isfinite(matrix).all():
                raise DataError(f"{where}: the pose is not finite; estimate it again, or remove row and image")
            lens = Lens(np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]), int(width), int(height))
            # columns: down, right, back, centre
            pose = np.stack([matrix[:, 1], matrix[:, 0], -matrix[:, 2], matrix[:, 3]], axis=1)
            viewmat, mask = scenes.from_camera_to_world(pose, where, opengl=False), scene.mask_of(file, images)
            views.add(name, viewmat, partial(scene.image, file, lens.checked(where), downscale=factor, mask=mask))
        notes = ([note] if note else []) + views.notes(options) + scene.mask_notes()
        return self.scene(folder, views.views, notes, pixels=scene.pixel_source(by_folder=True))


# DTU scenes in the layout of IDR: cameras.npz with world_mat_i and scale_mat_i (Yariv et al. 2020).

FILES = ("cameras.npz", "cameras_sphere.npz")
FOLDERS = ("image", "images")
MAX_ARCHIVE_BYTES = 2**24
"""Size of the largest archive that is read [bytes]; an archive of 64 cameras has a hundred thousand."""
MAX_MATRIX_BYTES = 4096
"""Largest accepted size of an unpacked 4 x 4 matrix with its header [bytes]."""


def decompose(P: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray]:
    """Split a projection matrix [3, 4] into K [3, 3], for pixel centres at +0.5, and camera_from_world [4, 4]."""
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
    return _centred(K, where), scenes.rigid(pose_of(R, t), where)


def _centred(K: np.ndarray, where: str) -> np.ndarray:
    """Return K [3, 3] of a file that counts pixels from the centre of the first one for centres at +0.5, and without skew."""
    if abs(K[0, 1]) > 1e-3 * abs(K[0, 0]):
        raise DataError(f"{where}: the camera is skewed by {K[0, 1]:.3g} px, which is not supported; rectify the images")
    K[0, 1] = 0.0
    K[:2, 2] += 0.5
    return K


def _lens(K: np.ndarray, where: str) -> Callable[[int, int], Lens]:
    """Return the function that makes the lens of K for the size of its image file."""
    return lambda width, height: Lens(K, width, height).checked(where)


def _read_matrices(path: Path) -> dict[str, np.ndarray]:
    """Return the world and scale matrices of the archive by name, float64, shape [4, 4] each."""
    matrices = {}
    with explained(f"{path}: cannot be read as an archive of arrays", "copy it again", Exception):
        with np.load(io.BytesIO(read_input(path, MAX_ARCHIVE_BYTES)), allow_pickle=False) as archive:
            for key in archive.files:
                if key.startswith(("world_mat_", "scale_mat_")) and "inv" not in key:
                    if archive.zip.getinfo(f"{key}.npy").file_size > MAX_MATRIX_BYTES:
                        raise ValueError(f"{key} is too large for a 4 x 4 matrix")
                    matrices[key] = archive[key].astype(np.float64)
    for key, matrix in matrices.items():
        if matrix.shape != (4, 4) or not np.isfinite(matrix).all():
            raise DataError(f"{path}: {key} must be finite and [4, 4], not {list(matrix.shape)}. Copy the archive again")
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
        return Probe(found, "" if scenes.has_folder(folder, *FOLDERS) else f"its image folder, {' or '.join(FOLDERS)}")

    def read(self, folder: Path, options: ReadOptions) -> Scene:
        """See `Reader.read`."""
        path = next((folder / f for f in FILES if (folder / f).is_file()), folder / FILES[0])
        scene = SceneFolder(folder, options)
        matrices = _read_matrices(scene.inside(path))
        images = next((folder / f for f in FOLDERS if (folder / f).is_dir()), folder / FOLDERS[0])
        files = list_images(images)
        cameras = sum(key.startswith("world_mat_") for key in matrices)
        if not files or cameras != len(files):
            raise DataError(f"{path}: has {cameras} cameras, but {images} holds {len(files)} images. {IN_ORDER}")
        masks, views = _masks(folder, files), ViewList(options)
        for i, file in enumerate(files):
            name = file.relative_to(images).as_posix()
            if options.excludes(name):
                continue
            where = f"{path}, image {name!r}"
            world, scale = matrices.get(f"world_mat_{i}"), matrices.get(f"scale_mat_{i}", np.eye(4))
            if world is None:
                raise DataError(f"{where}: world_mat_{i} is missing; copy the archive again")
            K, viewmat = decompose(matmul(world, scale)[:3], where)
            mask = partial(scene.mask, masks[file]) if file in masks else None
            views.add(name, viewmat, partial(scene.image, file, _lens(K, where), mask=mask))
        notes = scenes.resampling_note(options.downscale) + views.notes(options)
        return self.scene(folder, views.views, notes, pixels=scene.pixel_source(by_folder=False))


# Middlebury multi-view scenes: `*_par.txt`, a line per image with K, R and t (Seitz et al. 2006).


def files_of(root: Path) -> list[Path]:
    """Return the parameter files of a folder, sorted; a scene has one."""
    return sorted(p for p in root.glob("*_par.txt") if p.is_file() and not p.name.startswith("."))


def read_camera_rows(path: Path) -> list[tuple[int, str, np.ndarray]]:
    """Return line number, image name and the numbers K, R, t, float64, shape [21], of each camera."""
    rows, count = [], None
    with understood(str(path), OSError):
        for number, line in enumerate(io.StringIO(read_input(path, MAX_BYTES).decode("utf-8-sig")), 1):
            if not (words := line.split()):
                continue
            if count is None:
                count = int(words[0])
                continue
            values = np.array([float(x) for x in words[1:]])
            if len(values) != 21 or not np.isfinite(values).all():
                raise DataError(f"{path}, line {number}, image {words[0]!r}: needs 21 finite numbers. Copy it again")
            rows.append((number, words[0], values))
    if count != len(rows):
        raise DataError(f"{path}: announces {count or 0} images and lists {len(rows)}; it is truncated. Copy it again")
    return rows


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
        scene, views = SceneFolder(folder, options), ViewList(options)
        for number, name, values in read_camera_rows(scene.inside(path)):
            if options.excludes(scenes.view_name(name)):
                continue
            where = f"{path}, line {number}, image {name!r}"
            K = _centred(values[:9].reshape(3, 3).copy(), where)
            if not np.allclose(K[[1, 2, 2, 2], [0, 0, 1, 2]], (0, 0, 0, 1)):
                raise DataError(f"{where}: K is not a matrix of intrinsics, fx 0 cx, 0 fy cy, 0 0 1; calibrate again")
            viewmat = scenes.rigid(pose_of(values[9:18].reshape(3, 3), values[18:21]), where)
            file, view = scene.child(folder, name, where), views.claim(scenes.view_name(name), where)
            mask = scene.mask_of(file, folder, folder / "masks")
            views.add(view, viewmat, partial(scene.image, file, _lens(K, where), mask=mask))
        notes += scenes.resampling_note(options.downscale) + views.notes(options) + scene.mask_notes()
        return self.scene(folder, views.views, notes, pixels=scene.pixel_source(by_folder=False))
