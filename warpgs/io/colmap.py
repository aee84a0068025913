"""COLMAP reconstructions, binary and text: cameras, images, points (colmap.github.io, "Output Format")."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpgs.errors import DataError
from warpgs.io.images import Lens, find_mask, image_folder, load_photo
from warpgs.io.poses import quat_rotation, rigid
from warpgs.scene import Camera, PointCloud, View

MODELS = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8)}
"""Model number to name and number of parameters."""
OTHER_MODELS = {
    5: "OPENCV_FISHEYE", 6: "FULL_OPENCV", 7: "FOV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE",
    10: "THIN_PRISM_FISHEYE",
}  # fmt: skip


@dataclass(frozen=True)
class Pose:
    """One row of the images file."""

    name: str
    camera_id: int
    quat: tuple[float, ...]
    translation: tuple[float, ...]


class _Reader:
    """A binary file read front to back, each read checked against what is left."""

    def __init__(self, path: Path):
        self.path, self.at = path, 0
        try:
            self.data = path.read_bytes()
        except OSError as e:
            raise DataError(f"{path}: cannot be read ({e.strerror})") from e

    def take(self, layout: str) -> tuple:
        size = struct.calcsize("<" + layout)
        if self.at + size > len(self.data):
            raise DataError(f"{self.path}: the file ends in the middle of a record, at byte {len(self.data)}; copy it again")
        values = struct.unpack_from("<" + layout, self.data, self.at)
        self.at += size
        return values

    def skip(self, size: int) -> bytes:
        if self.at + size > len(self.data):
            raise DataError(f"{self.path}: the file ends in the middle of a record, at byte {len(self.data)}; copy it again")
        self.at += size
        return self.data[self.at - size : self.at]

    def count(self, smallest: int) -> int:
        """A record count, held against the bytes that are left."""
        (count,) = self.take("Q")
        if count * smallest > len(self.data) - self.at:
            raise DataError(
                f"{self.path}: announces {count:,} records but holds bytes for at most {(len(self.data) - self.at) // smallest:,}; "
                "it is truncated or no COLMAP file. Copy it again"
            )
        return count

    def text(self) -> str:
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise DataError(f"{self.path}: a name has no end, so the file is truncated; copy it again")
        name = self.data[self.at : end].decode("utf-8", "surrogateescape")
        self.at = end + 1
        return name


def _lens(path: Path, model: str, width: int, height: int, p: tuple[float, ...]) -> Lens:
    if width < 1 or height < 1 or not np.isfinite(p).all():
        raise DataError(f"{path}: a camera has size {width} x {height} and parameters {p}; they must be positive and finite")
    if model == "SIMPLE_PINHOLE":
        fx, fy, cx, cy, distortion = p[0], p[0], p[1], p[2], ()
    elif model == "PINHOLE":
        fx, fy, cx, cy, distortion = *p, ()
    elif model in ("SIMPLE_RADIAL", "RADIAL"):
        fx, fy, cx, cy, distortion = p[0], p[0], p[1], p[2], (p[3], p[4] if model == "RADIAL" else 0.0, 0.0, 0.0)
    else:
        fx, fy, cx, cy, distortion = p[0], p[1], p[2], p[3], tuple(p[4:8])
    if not (fx > 0 and fy > 0):
        raise DataError(f"{path}: a camera has focal lengths {fx}, {fy}; they must be positive")
    return Lens(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), width, height, distortion, model)


def _unknown_model(path: Path, model: object) -> DataError:
    supported = ", ".join(name for name, _ in MODELS.values())
    return DataError(
        f"{path}: camera model {model} is not supported (supported: {supported}). "
        "Run `colmap image_undistorter` and give its output folder"
    )


def read_cameras(path: Path) -> dict[int, Lens]:
    """Lenses by camera number from cameras.bin or cameras.txt; DataError where the file is malformed."""
    cameras: dict[int, Lens] = {}
    if path.suffix == ".bin":
        r = _Reader(path)
        for _ in range(r.count(24)):
            number, model, width, height = r.take("iiQQ")
            if model not in MODELS:
                raise _unknown_model(path, OTHER_MODELS.get(model, model))
            name, count = MODELS[model]
            cameras[number] = _lens(path, name, width, height, r.take(f"{count}d"))
        return cameras
    counts = {name: count for name, count in MODELS.values()}
    for line_number, words in _lines(path):
        with _line_errors(path, line_number):
            model, parameters = words[1], tuple(float(w) for w in words[4:])
            if model not in counts:
                raise _unknown_model(path, model)
            if len(parameters) != counts[model]:
                raise ValueError(f"{model} has {counts[model]} parameters, not {len(parameters)}")
            cameras[int(words[0])] = _lens(path, model, int(words[2]), int(words[3]), parameters)
    return cameras


def _lines(path: Path):
    try:
        text = path.read_text("utf-8-sig")
    except (OSError, UnicodeDecodeError) as e:
        raise DataError(f"{path}: cannot be read as text ({e})") from e
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.startswith("#"):
            yield number, line.split()


class _line_errors:
    """Turn what parsing a line may raise into an error that names file and line."""

    def __init__(self, path: Path, line: int):
        self.path, self.line = path, line

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        if kind is not None and issubclass(kind, (ValueError, IndexError, KeyError)):
            raise DataError(f"{self.path}, line {self.line}: cannot be understood ({error}); write the file again") from error


def read_poses(path: Path) -> tuple[dict[int, Pose], dict[int, str]]:
    """Poses by image number, and names by image number, from images.bin or images.txt; DataError where malformed."""
    poses: dict[int, Pose] = {}
    if path.suffix == ".bin":
        r = _Reader(path)
        for _ in range(r.count(73)):
            number, *rest = r.take("i7di")
            name = r.text()
            (observed,) = r.take("Q")
            r.skip(24 * observed)
            poses[number] = Pose(name, rest[7], tuple(rest[:4]), tuple(rest[4:7]))
    else:
        try:
            text = path.read_text("utf-8-sig")
        except (OSError, UnicodeDecodeError) as e:
            raise DataError(f"{path}: cannot be read as text ({e})") from e
        # two lines an image; the second lists observations and may be empty
        rows = [(n, line) for n, line in enumerate(text.splitlines(), 1) if not line.startswith("#")]
        while rows and not rows[-1][1].strip():
            rows.pop()
        for line_number, line in rows[::2]:
            with _line_errors(path, line_number):
                words = line.split(maxsplit=9)
                values = [float(w) for w in words[1:8]]
                poses[int(words[0])] = Pose(words[9].strip(), int(words[8]), tuple(values[:4]), tuple(values[4:7]))
    return poses, {n: p.name for n, p in poses.items()}


def read_points(path: Path, names: dict[int, str]) -> PointCloud:
    """Points with the views that saw them from points3D.bin or points3D.txt; DataError where malformed."""
    points, colors, tracks = [], [], []
    if path.suffix == ".bin":
        r = _Reader(path)
        for _ in range(r.count(51)):
            _, x, y, z, red, green, blue, _ = r.take("Q3d3Bd")
            (length,) = r.take("Q")
            track = np.frombuffer(r.skip(8 * length), "<i4")[::2]
            points.append((x, y, z))
            colors.append((red, green, blue))
            tracks.append(frozenset(names[i] for i in track.tolist() if i in names))
    else:
        for line_number, words in _lines(path):
            with _line_errors(path, line_number):
                points.append(tuple(float(w) for w in words[1:4]))
                colors.append(tuple(int(w) for w in words[4:7]))
                tracks.append(frozenset(names[int(i)] for i in words[8::2] if int(i) in names))
    positions = np.array(points, np.float64).reshape(-1, 3)
    if not np.isfinite(positions).all():
        bad = int((~np.isfinite(positions).all(1)).sum())
        raise DataError(f"{path}: {bad} of {len(positions)} points are not finite; reconstruct again, or remove them")
    return PointCloud(positions, np.array(colors, np.float32).reshape(-1, 3) / 255, tuple(tracks))


def model_folder(root: Path) -> Path | None:
    """The folder of a reconstruction that holds any COLMAP file: sparse/0, sparse, or the root; None if none does."""
    for folder in (root / "sparse" / "0", root / "sparse", root):
        if any((folder / f"{stem}.{kind}").is_file() for stem in ("cameras", "images", "points3D") for kind in ("bin", "txt")):
            return folder
    return None


def missing_parts(folder: Path) -> list[str]:
    """Names of the files that a complete reconstruction needs and this folder lacks."""
    for kind in ("bin", "txt"):
        if (folder / f"images.{kind}").is_file() and (folder / f"cameras.{kind}").is_file():
            return []
    kind = "txt" if (folder / "cameras.txt").is_file() or (folder / "images.txt").is_file() else "bin"
    return [f"{stem}.{kind}" for stem in ("cameras", "images") if not (folder / f"{stem}.{kind}").is_file()]


def load(root: Path, *, downscale: int, invert_masks: bool, **_) -> tuple[list[View], PointCloud | None, list[str]]:
    """Read a scene folder with a COLMAP reconstruction.

    Returns:
        Views in file coordinates, points (None where there is no points file), notes.

    Raises:
        DataError: A file is missing or malformed, an image lacks, or a size does not fit.
    """
    folder = model_folder(root)
    if folder is None or (missing := missing_parts(folder)):
        raise DataError(f"{folder or root}: the COLMAP reconstruction lacks {' and '.join(missing)}; copy the whole folder")
    kind = "bin" if not missing_parts_of(folder, "bin") else "txt"
    lenses = read_cameras(folder / f"cameras.{kind}")
    poses, names = read_poses(folder / f"images.{kind}")
    notes: list[str] = []
    images, factor, note = image_folder(root, downscale)
    notes += [note] if note else []
    views, models = [], set()
    for pose in sorted(poses.values(), key=lambda p: p.name):
        lens = lenses.get(pose.camera_id)
        if lens is None:
            raise DataError(f"{folder}/images.{kind}: image {pose.name!r} names camera {pose.camera_id}, which does not exist")
        path = images / pose.name
        photo = load_photo(path, lens, downscale=factor, mask=find_mask(path, images, invert_masks))
        viewmat = np.eye(4)
        viewmat[:3, :3] = quat_rotation(pose.quat, f"{folder}/images.{kind}, image {pose.name!r}")
        viewmat[:3, 3] = pose.translation
        viewmat = rigid(viewmat, f"{folder}/images.{kind}, image {pose.name!r}")
        height, width = photo.image.shape[:2]
        views.append(View(pose.name, Camera(viewmat, photo.K, width, height), photo.image, photo.mask))
        if any(lens.distortion):
            models.add(lens.model)
    notes += [f"lens distortion ({m}) undone" for m in sorted(models)]
    points_path = folder / f"points3D.{kind}"
    if not points_path.is_file():
        notes.append(f"{points_path.name} is missing, so there are no points to start from")
        return views, None, notes
    points = read_points(points_path, names)
    if len(points) == 0:
        notes.append(f"{points_path.name} holds no points")
    return views, points, notes


def missing_parts_of(folder: Path, kind: str) -> list[str]:
    """Like `missing_parts` for one kind of file, bin or txt."""
    return [f"{stem}.{kind}" for stem in ("cameras", "images") if not (folder / f"{stem}.{kind}").is_file()]
