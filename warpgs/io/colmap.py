"""COLMAP reconstructions, binary and text: cameras, images, points (colmap.github.io, "Output Format").

Other files of a reconstruction (rigs, frames, project.ini) hold nothing that a scene needs and are not read.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath

import numpy as np

from warpgs.errors import DataError
from warpgs.files import read_file
from warpgs.io.folder import (
    Probe,
    Reader,
    SceneFolder,
    ViewList,
    has_folder,
    quat_rotation,
    register,
    rigid,
    view_name,
)
from warpgs.io.images import Lens, ReadOptions, list_images
from warpgs.scene import PointCloud, Scene

MODELS = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8)}
"""Name and number of parameters by model number."""
NATIVE_MODELS = {
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 8: ("SIMPLE_RADIAL_FISHEYE", 4), 9: ("RADIAL_FISHEYE", 5),
}  # fmt: skip
"""Models that are only read with `--lenses native`, because undistortion is not implemented for them."""
OTHER_MODELS = {7: "FOV", 10: "THIN_PRISM_FISHEYE"} | {number: name for number, (name, _) in NATIVE_MODELS.items()}
STEMS = ("cameras", "images", "points3D")


Pose = tuple[str, int, tuple[float, ...], tuple[float, ...]]
"""A row of the images file: path below the image folder, number of the camera, and camera_from_world: rotation wxyz and
translation [file units]."""


class _BinaryFile:
    """A binary file that is read front to back; every read is checked against the bytes that are left."""

    def __init__(self, path: Path):
        self.path, self.at, self.data = path, 0, read_file(path, fix="fix its permissions or copy it again")

    def raw(self, size: int) -> bytes:
        """Return the next bytes unchanged."""
        if size > len(self.data) - self.at:
            raise DataError(
                f"{self.path}: the file ends in the middle of a record, at byte {len(self.data)}; "
                "it is truncated. Copy it again"
            )
        self.at += size
        return self.data[self.at - size : self.at]

    def take(self, layout: str) -> tuple:
        """Return the next values, little endian."""
        return struct.unpack("<" + layout, self.raw(struct.calcsize("<" + layout)))

    def count(self, smallest: int) -> int:
        """Return a record count; DataError where the bytes that are left cannot hold so many records."""
        (count,) = self.take("Q")
        capacity = (len(self.data) - self.at) // smallest
        if count > capacity:
            raise DataError(
                f"{self.path}: announces {count:,} records but holds bytes for at most {capacity:,}; it is truncated or not "
                "a COLMAP file. Copy it again"
            )
        return count

    def text(self) -> str:
        """Return the next name, which ends in a zero byte."""
        end = self.data.find(b"\0", self.at)
        if end < 0:
            raise DataError(f"{self.path}: a name has no end, so the file is truncated; copy it again")
        raw, self.at = self.data[self.at : end], end + 1
        return raw.decode("utf-8", "surrogateescape")

    def end(self) -> None:
        """Raise a DataError where bytes follow the last record, which means a wrong count."""
        if self.at != len(self.data):
            raise DataError(
                f"{self.path}: {len(self.data) - self.at} bytes follow the last record, so its count "
                "of records is wrong. Copy it again"
            )


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yield the numbered lines of a text file; only line feeds end a line, since names may hold other separators."""
    text = read_file(path, fix="fix its permissions or copy it again").decode("utf-8-sig", "surrogateescape")
    at, number = 0, 1
    while (end := text.find("\n", at)) >= 0:  # one at a time: a list takes a hundred bytes for each empty line
        yield number, text[at:end].removesuffix("\r")
        at, number = end + 1, number + 1
    yield number, text[at:]


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    for number, line in _lines(path):
        if line.strip() and not line.lstrip().startswith("#"):
            yield number, line.split()


@contextmanager
def _understood(path: Path, line: int):
    """Turn errors of parsing a line into a DataError that names file and line."""
    try:
        yield
    except (ValueError, IndexError, OverflowError) as e:
        raise DataError(f"{path}, line {line}: cannot be understood ({e}); write the file again") from e


def _expect(condition: bool, message: str) -> None:
    """Raise a ValueError for `_understood` where a line breaks a rule."""
    if not condition:
        raise ValueError(message)


def _store(table: dict, key: int, value: object, where: str) -> None:
    if key in table:
        raise DataError(f"{where}: id {key} is given twice; write the file again")
    table[key] = value


def _lens(where: str, model: str, width: int, height: int, p: tuple[float, ...]) -> Lens:
    fisheye = model.endswith("FISHEYE")
    if "OPENCV" in model or model == "PINHOLE":
        (fx, fy, cx, cy), distortion = p[:4], p[4:]
    else:
        fx, cx, cy = p[:3]
        fy, distortion = fx, p[3:]
        if distortion and not fisheye:  # SIMPLE_RADIAL has k1, RADIAL k1 and k2
            distortion = (*distortion, *[0.0] * (4 - len(distortion)))
    K = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
    return Lens(K, width, height, tuple(distortion), model, fisheye).checked(where)


def _unknown_model(path: Path, model: object, known: dict[int, tuple[str, int]]) -> DataError:
    supported = ", ".join(name for name, _ in known.values())
    kept = known is MODELS and model in [name for name, _ in NATIVE_MODELS.values()]
    return DataError(
        f"{path}: camera model {model} is not supported (supported: {supported}). "
        f"Run `colmap image_undistorter` and give its output folder{', or fit with --lenses native' if kept else ''}"
    )


def read_cameras(path: Path, native: bool = False) -> dict[int, Lens]:
    """Return lenses by camera number from cameras.bin or cameras.txt; ``native`` also allows models without undistortion."""
    cameras: dict[int, Lens] = {}
    known = MODELS | NATIVE_MODELS if native else MODELS
    if path.suffix == ".bin":
        r = _BinaryFile(path)
        for _ in range(r.count(24)):
            number, model, width, height = r.take("iiQQ")
            if model not in known:
                raise _unknown_model(path, OTHER_MODELS.get(model, model), known)
            name, count = known[model]
            where = f"{path}, camera {number}"
            _store(cameras, number, _lens(where, name, width, height, r.take(f"{count}d")), where)
        r.end()
        return cameras
    counts = dict(known.values())
    for line, words in _rows(path):
        with _understood(path, line):
            number, model, parameters = int(words[0]), words[1], tuple(float(w) for w in words[4:])
            if model not in counts:
                raise _unknown_model(path, model, known)
            _expect(len(parameters) == counts[model], f"{model} has {counts[model]} parameters, not {len(parameters)}")
            where = f"{path}, line {line}, camera {number}"
            _store(cameras, number, _lens(where, model, int(words[2]), int(words[3]), parameters), where)
    return cameras


def read_poses(path: Path) -> dict[int, Pose]:
    """Return poses by image number from images.bin or images.txt."""
    poses: dict[int, Pose] = {}
    if path.suffix == ".bin":
        r = _BinaryFile(path)
        for _ in range(r.count(73)):
            number, *values, camera = r.take("i7di")
            pose = (r.text(), camera, tuple(values[:4]), tuple(values[4:]))
            (observed,) = r.take("Q")
            r.raw(24 * observed)
            _store(poses, number, pose, str(path))
        r.end()
        return poses
    lines = _lines(path)
    for line, text in lines:
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        with _understood(path, line):
            words = text.split(maxsplit=9)
            values = tuple(float(w) for w in words[1:8])
            pose = (words[9].rstrip(), int(words[8]), values[:4], values[4:])
            _store(poses, int(words[0]), pose, f"{path}, line {line}")
        # the line of observations always follows, but may be empty
        line, text = next(lines, (0, ""))
        if len(text.split()) % 3:
            raise DataError(
                f"{path}, line {line}: expected the observations of image {pose[0]!r} as X Y POINT, or an empty line; "
                "write the file again"
            )
    return poses


def posed_lenses(poses: dict[int, Pose], lenses: dict[int, Lens], file: Path) -> Iterator[tuple[str, Lens, np.ndarray]]:
    """Yield name, lens and camera_from_world [4, 4] of each image, sorted by name; ``file`` holds the poses."""
    for name, camera, quat, translation in sorted(poses.values(), key=lambda pose: pose[0]):
        where = f"{file}, image {name!r}"
        if camera not in lenses:
            raise DataError(f"{where}: camera {camera} is missing from cameras{file.suffix}; export the cameras again")
        viewmat = np.eye(4)
        viewmat[:3, :3], viewmat[:3, 3] = quat_rotation(quat, where), translation
        yield name, lenses[camera], rigid(viewmat, where)


def read_points(path: Path, names: dict[int, str]) -> PointCloud:
    """Return points, with the views that saw them, from points3D.bin or points3D.txt."""
    points: list[tuple[float, ...]] = []
    colors: list[tuple[int, ...]] = []
    tracks: list[frozenset[str]] = []
    if path.suffix == ".bin":
        r = _BinaryFile(path)
        for _ in range(r.count(51)):
            _, x, y, z, red, green, blue, _, length = r.take("Q3d3BdQ")
            track = np.frombuffer(r.raw(8 * length), "<i4")[::2]
            points.append((x, y, z))
            colors.append((red, green, blue))
            tracks.append(frozenset(names[i] for i in track.tolist() if i in names))
        r.end()
    else:
        for line, words in _rows(path):
            with _understood(path, line):
                _expect(len(words) >= 8 and len(words) % 2 == 0, "a point needs 8 numbers, then pairs IMAGE OBSERVATION")
                points.append(tuple(float(w) for w in words[1:4]))
                colors.append(tuple(min(max(int(w), 0), 255) for w in words[4:7]))
                tracks.append(frozenset(names[i] for w in words[8::2] if (i := int(w)) in names))
    positions = np.array(points, np.float64).reshape(-1, 3)
    bad = int((~np.isfinite(positions).all(axis=1)).sum())
    if bad:
        raise DataError(f"{path}: {bad} of {len(positions)} points are not finite; reconstruct again, or remove them")
    return PointCloud(positions, np.array(colors, np.float32).reshape(-1, 3) / 255, tuple(tracks))


def reconstruction(root: Path) -> tuple[Path, str, list[str]] | None:
    """Return folder, kind (bin or txt) and missing files of a reconstruction; None if there is no COLMAP file.

    Of sparse/0, sparse and the root, the first complete folder is taken, else the first with any COLMAP file.
    """
    partial, kinds = [], ("bin", "txt")
    for folder in (root / "sparse" / "0", root / "sparse", root):
        lacks = {k: [n for s in STEMS[:2] if not (folder / (n := f"{s}.{k}")).is_file()] for k in kinds}
        if any((folder / f"{s}.{k}").is_file() for s in STEMS for k in kinds):
            kind = min(kinds, key=lambda k: len(lacks[k]))
            partial.append((folder, kind, lacks[kind]))
    return next((p for p in partial if not p[2]), partial[0] if partial else None)


def _image_paths(scene: SceneFolder, images: Path, names: list[str], where: str) -> tuple[dict[str, Path], str]:
    """Return the image file by view name, and a note for the user (empty where nothing was chosen).

    Folders of reduced images often have other suffixes (images_8/a.png for a.JPG) or other names (LLFF's image000.png). Files
    with another suffix are matched by stem, files with other names by sorted order if the counts agree.
    """
    paths = {n: scene.child(images, n, where) for n in names}
    lost = [n for n in names if not paths[n].is_file()]
    if not lost or images.name == "images":
        return paths, ""
    files = list_images(images)
    stems = {p.relative_to(images).with_suffix("").as_posix(): p for p in files}
    found = {n: stems.get(str(PurePosixPath(n).with_suffix(""))) for n in lost}
    if len(stems) == len(files) and all(found.values()):
        return paths | found, f"{len(lost)} images of {images.name} matched by their names without suffix"
    if len(lost) == len(names) == len(files):
        pairs = dict(zip(sorted(names), files))
        order = f"images of {images.name} matched in sorted order, because their names differ"
        return pairs, f"{order} ({min(names)} is {pairs[min(names)].name})"
    return paths, ""  # the missing file is named when it is read


@register("colmap")
class ColmapReader(Reader):
    """COLMAP reconstructions, binary or text, with their image folder."""

    description = "sparse/0, sparse or the folder itself with cameras and images .bin/.txt (COLMAP)"
    priority = 10

    def probe(self, folder: Path) -> Probe | None:
        """See `Reader.probe`."""
        model = reconstruction(folder)
        if model is None:
            return None
        images = [] if has_folder(folder, "images", "images_*") else ["its image folder, images"]
        return Probe(
            f"the COLMAP reconstruction in {model[0].relative_to(folder).as_posix()}", " and ".join(model[2] or images)
        )

    def read(self, folder: Path, options: ReadOptions) -> Scene:
        """See `Reader.read`."""
        model, kind, lacks = reconstruction(folder) or (folder, "", ["cameras and images"])
        if lacks:
            raise DataError(f"{model}: the COLMAP reconstruction lacks {' and '.join(lacks)}; copy the whole folder")
        scene, file = SceneFolder(folder, options), model / f"images.{kind}"
        poses = read_poses(scene.inside(file))
        lenses = read_cameras(scene.inside(model / f"cameras.{kind}"), options.lenses == "native")
        images, factor, chosen = scene.images()
        paths, matched = _image_paths(scene, images, [name for name, *_ in poses.values()], str(file))
        notes, views = [note for note in (chosen, matched) if note], ViewList()
        for name, lens, viewmat in posed_lenses(poses, lenses, file):
            view = views.claim(view_name(name), f"{file}, image {name!r}")
            mask = scene.find_mask(paths[name], images)
            views.add(view, viewmat, scene.image(paths[name], lens, downscale=factor, mask=mask))
        unposed = len(set(list_images(images)) - set(paths.values()))
        if unposed:
            notes.append(f"{unposed} files in {images.name} have no pose in the reconstruction and are left out")
        notes += views.notes(options)
        points_path, points = model / f"points3D.{kind}", None
        if not points_path.is_file():
            notes.append(f"{points_path.name} is missing, so there are no points to start from")
        else:
            there = {v.name for v in views.views}  # without those that are left out
            names = {n: view_name(p[0]) for n, p in poses.items() if view_name(p[0]) in there}
            points = read_points(scene.inside(points_path), names)
            if len(points) == 0:
                notes.append(f"{points_path.name} holds no points")
        return self.scene(folder, views.views, notes, points=points, pixels=scene.pixel_source(by_folder=True))
