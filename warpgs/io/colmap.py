"""COLMAP reconstructions, binary and text: cameras, images, points (colmap.github.io, "Output Format").

Other files of a reconstruction (rigs, frames, project.ini) hold nothing that a scene needs and are not read.
"""

import re
import struct
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from functools import partial
from pathlib import Path, PurePosixPath

import numpy as np

from warpgs.errors import DataError, expect, explained, listed
from warpgs.files import MAX_HEADER_BYTES, PLY_LIST, open_input, ply_header, read_file
from warpgs.geometry import pose_of
from warpgs.io import folder as scenes
from warpgs.io.folder import Probe, Reader, SceneFolder, ViewList, register
from warpgs.io.images import SUFFIXES, Lens, ReadOptions, list_images
from warpgs.scene import ORIGIN, PointCloud, Scene, base_colors, checked_origin

MODELS = {0: ("SIMPLE_PINHOLE", 3), 1: ("PINHOLE", 4), 2: ("SIMPLE_RADIAL", 4), 3: ("RADIAL", 5), 4: ("OPENCV", 8)}
"""Name and number of parameters by model number."""
NATIVE_MODELS = {
    5: ("OPENCV_FISHEYE", 8), 6: ("FULL_OPENCV", 12), 8: ("SIMPLE_RADIAL_FISHEYE", 4), 9: ("RADIAL_FISHEYE", 5),
}  # fmt: skip
"""Models that are only read with `--lenses native`, because undistortion is not implemented for them."""
OTHER_MODELS = {
    7: "FOV", 10: "THIN_PRISM_FISHEYE", 11: "RAD_TAN_THIN_PRISM_FISHEYE", 12: "SIMPLE_DIVISION", 13: "DIVISION",
    14: "SIMPLE_FISHEYE", 15: "FISHEYE", 16: "EUCM", 17: "EQUIRECTANGULAR",
}  # fmt: skip
"""Models that are not read, for messages."""
STEMS = ("cameras", "images", "points3D")
IMAGES = ("images", "input")
"""Names of image folders."""

Model = tuple[Path, str, list[str]]
"""Folder, kind (bin or txt) and missing files of a reconstruction."""


Pose = tuple[str, int, tuple[float, ...], tuple[float, ...]]
"""A row of the images file: path below the image folder, number of the camera, and camera_from_world: rotation wxyz and
translation [file units]."""


Posed = tuple[str, Lens | Callable[[int, int], Lens], np.ndarray]
"""Path below the image folder, lens (or a function that returns it for the size of the image), camera_from_world [4, 4]."""


class _BinaryFile:
    """A binary file that is read front to back; every read is checked against the bytes that are left."""

    def __init__(self, path: Path):
        self.path, self.at, self.data = path, 0, read_file(path, fix="fix its permissions or copy it again")

    def raw(self, size: int) -> bytes:
        """Return the next bytes unchanged."""
        if size > len(self.data) - self.at:
            raise DataError(f"{self.path}: the file ends in the middle of a record, at byte {len(self.data)}. Copy it again")
        self.at += size
        return self.data[self.at - size : self.at]

    def take(self, layout: str) -> tuple:
        """Return the next values, little endian."""
        return struct.unpack("<" + layout, self.raw(struct.calcsize("<" + layout)))

    def records(self, smallest: int) -> Iterator["_BinaryFile"]:
        """Yield this file for each record; DataError where their count does not fit the bytes, ``smallest`` for each."""
        (count,) = self.take("Q")
        capacity = (len(self.data) - self.at) // smallest
        if count > capacity:
            raise DataError(f"{self.path}: truncated: {count:,} records announced, at most {capacity:,} found. Copy it again")
        for _ in range(count):
            yield self
        if self.at != len(self.data):
            raise DataError(f"{self.path}: {len(self.data) - self.at} bytes follow the last of its records. Copy it again")

    def text(self) -> str:
        """Return the next name, which ends in a zero byte."""
        if (end := self.data.find(b"\0", self.at)) < 0:
            raise DataError(f"{self.path}: a name has no end, so the file is truncated; copy it again")
        raw, self.at = self.data[self.at : end], end + 1
        return raw.decode("utf-8", "surrogateescape")


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


def origin_stated(path: Path) -> np.ndarray:
    """Return the origin [3] that the first line of a text file of ours states, 0 without one."""
    if path.suffix != ".txt":
        return np.zeros(3)
    with open_input(path) as file:
        words = file.readline(4096).decode("utf-8", "replace").split()
    return checked_origin(words[2:], str(path)) if words[:2] == ["#", ORIGIN] else np.zeros(3)


PARSING = (ValueError, LookupError, OverflowError, TypeError, AttributeError)
"""Errors of parsing."""


def understood(where: str, *errors: type[Exception]) -> AbstractContextManager[None]:
    """Turn errors of parsing, and others that are named, into a DataError that names the place."""
    return explained(f"{where}: cannot be understood", "write the file again", (*PARSING, *errors))


NAN = re.compile(rb"[-+]?(?:nan\([a-z]*\)|1\.#(?:ind|qnan|snan)\d*)", re.IGNORECASE)
"""How Microsoft's C library writes a NaN, which Python's float does not read."""


def _number(word: str) -> float:
    """Return the number of a word, also a NaN in Microsoft's spelling."""
    return float("nan" if "n" in word.lower() and NAN.fullmatch(word.encode()) else word)


def _store(table: dict, key: int, value: object, where: str) -> None:
    if key in table:
        raise DataError(f"{where}: id {key} is given twice; write the file again")
    table[key] = value


def _lens(where: str, model: str, width: int, height: int, p: tuple[float, ...], native: bool) -> Lens:
    fisheye = model.endswith("FISHEYE")
    if model == "FULL_OPENCV" and not native:
        p = p[:9]  # the terms behind are 0
    if "OPENCV" in model or model == "PINHOLE":
        (fx, fy, cx, cy), distortion = p[:4], p[4:]
    else:
        fx, cx, cy = p[:3]
        fy, distortion = fx, p[3:]
        if distortion and not fisheye:  # SIMPLE_RADIAL has k1, RADIAL k1 and k2
            distortion = (*distortion, *[0.0] * (4 - len(distortion)))
    lens = Lens(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]]), width, height, tuple(distortion), model, fisheye)
    return lens.checked(where) if np.isfinite(p).all() else lens  # the images of other lenses are left out


def read_cameras(path: Path, native: bool = False) -> dict[int, Lens]:
    """Return lenses by camera number from cameras.bin or cameras.txt; ``native`` also allows models without undistortion."""
    cameras: dict[int, Lens] = {}
    readable = MODELS | NATIVE_MODELS
    counts = dict(readable.values())
    known = counts if native else dict(MODELS.values())

    def allow(model: object, parameters: tuple[float, ...] = ()) -> None:
        """Refuse a model; FULL_OPENCV without rational terms is OPENCV with k3, which can be undistorted."""
        if model not in known and not (model == "FULL_OPENCV" and not any(parameters[9:])):
            kept = ", or fit with --lenses native" if model in counts else ""
            raise DataError(f"{path}: camera model {model} is not supported. Run `colmap image_undistorter`{kept}")

    if path.suffix == ".bin":
        for r in _BinaryFile(path).records(24):
            number, model, width, height = r.take("iiQQ")
            name, count = readable.get(model, (OTHER_MODELS.get(model, model), 0))
            allow(name)
            parameters = r.take(f"{count}d")
            allow(name, parameters)
            where = f"{path}, camera {number}"
            _store(cameras, number, _lens(where, name, width, height, parameters, native), where)
        return cameras
    for line, words in _rows(path):
        with understood(f"{path}, line {line}"):
            number, model, parameters = int(words[0]), words[1], tuple(_number(w) for w in words[4:])
            allow(model, parameters)
            expect(len(parameters) == counts[model], f"{model} has {counts[model]} parameters, not {len(parameters)}")
            where = f"{path}, line {line}, camera {number}"
            width, height = float(words[2]), float(words[3])  # some exports write 1920.0
            expect(width % 1 == height % 1 == 0, f"the size {width:g} x {height:g} px is not whole")
            _store(cameras, number, _lens(where, model, int(width), int(height), parameters, native), where)
    return cameras


def read_poses(path: Path) -> dict[int, Pose]:
    """Return poses by image number from images.bin or images.txt."""
    poses: dict[int, Pose] = {}
    if path.suffix == ".bin":
        for r in _BinaryFile(path).records(73):
            number, *values, camera = r.take("i7di")
            pose = (r.text(), camera, tuple(values[:4]), tuple(values[4:]))
            (observed,) = r.take("Q")
            r.raw(24 * observed)
            _store(poses, number, pose, str(path))
        return poses
    lines = _lines(path)
    for line, text in lines:
        if not text.strip() or text.lstrip().startswith("#"):
            continue
        with understood(f"{path}, line {line}"):
            words = text.split(maxsplit=9)
            values = tuple(_number(w) for w in words[1:8])
            pose = (words[9].rstrip(), int(words[8]), values[:4], values[4:])
            _store(poses, int(words[0]), pose, f"{path}, line {line}")
        # the line of observations always follows, but may be empty
        line, text = next(lines, (0, ""))
        if len(text.split()) % 3:
            raise DataError(f"{path}, line {line}: expected X Y POINT of image {pose[0]!r}, or an empty line; write it again")
    return poses


def without_unaligned(
    poses: dict[int, Pose], lenses: dict[int, Lens], file: Path, strict: bool
) -> tuple[dict[int, Pose], list[str]]:
    """Return the poses with finite numbers and a finite lens, and a note on the others; all poses if none is finite.

    Some programs write NaN for photographs that they could not align. `posed_lenses` refuses the poses that stay.
    """

    def finite(pose: Pose) -> bool:
        lens = lenses.get(pose[1])
        numbers = () if lens is None else (*lens.K.flat, *lens.distortion)
        return bool(np.isfinite([*pose[2], *pose[3], *numbers]).all())

    kept = {number: pose for number, pose in poses.items() if finite(pose)}
    if strict or not kept or len(kept) == len(poses):
        return poses, []
    names = listed(sorted(pose[0] for number, pose in poses.items() if number not in kept))
    return kept, [f"left out: {len(poses) - len(kept)} of {len(poses)} images, as pose or camera is not finite: {names}"]


def posed_lenses(poses: dict[int, Pose], lenses: dict[int, Lens], file: Path) -> Iterator[tuple[str, Lens, np.ndarray]]:
    """Yield name, lens and camera_from_world [4, 4] of each image, sorted by name; ``file`` holds the poses."""
    origin = origin_stated(file)
    for name, camera, quat, translation in sorted(poses.values(), key=lambda pose: pose[0]):
        where = f"{file}, image {name!r}"
        if camera not in lenses:
            raise DataError(f"{where}: camera {camera} is missing from cameras{file.suffix}; export the cameras again")
        viewmat = scenes.rigid(pose_of(scenes.quat_rotation(quat, where), translation), where)
        yield name, lenses[camera].checked(f"{file.with_stem('cameras')}, camera {camera}"), scenes.about(viewmat, origin)


def read_points(path: Path, names: dict[int, str], notes: list[str] | None = None) -> PointCloud:
    """Return points, with the views that saw them, from points3D.bin or points3D.txt; see `_cloud` for ``notes``."""
    points: list[tuple[float, ...]] = []
    colors: list[tuple[float, ...]] = []
    tracks: list[frozenset[str]] = []
    if path.suffix == ".bin":
        for r in _BinaryFile(path).records(51):
            _, x, y, z, red, green, blue, _, length = r.take("Q3d3BdQ")
            track = np.frombuffer(r.raw(8 * length), "<i4")[::2]
            points.append((x, y, z))
            colors.append((red, green, blue))
            tracks.append(frozenset(names[i] for i in track.tolist() if i in names))
    else:
        for line, words in _rows(path):
            with understood(f"{path}, line {line}"):
                expect(len(words) >= 8 and len(words) % 2 == 0, "a point needs 8 numbers, then pairs IMAGE OBSERVATION")
                points.append(tuple(_number(w) for w in words[1:4]))
                colors.append(tuple(_number(w) for w in words[4:7]))
                tracks.append(frozenset(names[i] for w in words[8::2] if (i := int(w)) in names))
    positions = np.array(points, np.float64).reshape(-1, 3) + origin_stated(path)
    return _cloud(path, positions, np.array(colors, np.float64).reshape(-1, 3), notes, tuple(tracks))


def _cloud(
    path: Path, positions: np.ndarray, colors: np.ndarray, notes: list[str] | None,
    tracks: tuple[frozenset[str], ...] | None = None,
) -> PointCloud:  # fmt: skip
    """Return points [N, 3] with colours of 0 to 255, or of 0 to 1 if they are fractions.

    Points that are not finite are left out with a note; without ``notes``, or if there are no others, they are an error.
    """
    finite = np.isfinite(np.concatenate([positions, colors], axis=1)).all(axis=1)
    if bad := int((~finite).sum()):
        if notes is None or bad == len(finite):
            raise DataError(f"{path}: {bad} of {len(finite)} points are not finite; reconstruct again, or remove them")
        notes.append(f"{bad:,} of {len(finite):,} points of {path.name} are not finite and are left out")
        positions, colors = positions[finite], colors[finite]
        tracks = None if tracks is None else tuple(track for track, kept in zip(tracks, finite) if kept)
    fractions = bool((colors % 1).any()) and colors.max() <= 1
    return PointCloud(positions, np.clip(colors, 0, 255).astype(np.float32) / np.float32(1 if fractions else 255), tracks)


COLORS = [c.split() for c in ("red green blue", "r g b", "diffuse_red diffuse_green diffuse_blue", "f_dc_0 f_dc_1 f_dc_2")]
"""Names of the colours of points; the last are coefficients of Gaussians."""


def read_ply_points(path: Path, notes: list[str] | None = None) -> PointCloud:
    """Return the points of a PLY file, text or binary; points without colours are gray, and no views are known.

    See `_cloud` for ``notes``.
    """
    data = read_file(path, fix="fix its permissions or copy it again")
    with explained(f"{path}: the points cannot be understood", "export them again as PLY, or remove the file", PARSING):
        elements, start, text = ply_header(data[:MAX_HEADER_BYTES])
        name, count, properties = elements[0] if elements else ("", 0, [])
        kinds, body = dict(properties), data[start:]
        expect(name == "vertex", "its first element is not vertex")
        plain = len(kinds) == len(properties) and PLY_LIST not in kinds.values()
        expect(plain and {"x", "y", "z"} <= kinds.keys(), "its vertices lack x, y or z, have one twice, or have lists")
        if text:
            words = np.array([row.split()[: len(kinds)] for row in NAN.sub(b"nan", body).splitlines()[:count]], np.float64)
            expect(count == len(words), f"it lists {len(words)} of {count} points")
            values = dict(zip(kinds, words.reshape(count, len(kinds)).T))
        else:
            table = np.frombuffer(body, np.dtype(properties), count)
            values = {n: table[n].astype(np.float64) for n in kinds}
    rgb = next((c for c in COLORS if kinds.keys() >= set(c)), [])
    colors = np.stack([values[c] for c in rgb], 1) if rgb else np.full((count, 3), 127.0)
    if not rgb and notes is not None:
        notes.append("they have no colours and start gray")
    if "f_dc_0" in rgb:
        colors = 255 * np.asarray(base_colors(colors[:, None]))
    elif rgb and kinds[rgb[0]][1:] == "u2":
        colors = colors / 257
    elif rgb and kinds[rgb[0]][1:2] == "f" and colors.size and colors.max() <= 1:
        colors = colors * 255
    return _cloud(path, np.stack([values[c] for c in "xyz"], 1), colors, notes)


def _found(folder: Path) -> Model | None:
    """Return the reconstruction in a folder; None if it has no COLMAP file."""
    kinds = ("bin", "txt")
    lacks = {k: [n for s in STEMS[:2] if not (folder / (n := f"{s}.{k}")).is_file()] for k in kinds}
    if not any((folder / f"{s}.{k}").is_file() for s in STEMS for k in kinds):
        return None
    kind = min(kinds, key=lambda k: len(lacks[k]))
    return folder, kind, lacks[kind]


def _numbered(folder: Path) -> list[Path]:
    """Return the subfolders 0, 1, 2, ... of a folder in this order."""
    return sorted((p for p in folder.glob("[0-9]*") if p.name.isdecimal() and p.is_dir()), key=lambda p: (int(p.name), p.name))


def reconstructions(root: Path) -> list[Model]:
    """Return the sub-models among which the choice is: the first place with a complete one decides, if possible with images.

    The places are sparse/N, sparse, the root, dense/N/sparse, dense/sparse, colmap/sparse/N, colmap/sparse and colmap. Without
    a complete one, the first with any COLMAP file is returned.
    """
    dense, colmap = root / "dense", root / "colmap"
    places = [
        _numbered(root / "sparse"), [root / "sparse"], [root], [p / "sparse" for p in _numbered(dense)], [dense / "sparse"],
        _numbered(colmap / "sparse"), [colmap / "sparse"], [colmap],
    ]  # fmt: skip
    groups = [[m for folder in place if (m := _found(folder)) is not None] for place in places]
    complete = [found for group in groups if (found := [m for m in group if not m[2]])]
    pictured = [group for group in complete if image_base(root, group[0][0])]
    return next(iter(pictured or complete), [m for group in groups for m in group][:1])


def reconstruction(root: Path, named: str | None = None) -> tuple[Model | None, str]:
    """Return the reconstruction ``named``, else the largest of `reconstructions` (None without any), and a note on it."""
    if named is not None:
        return _found(root / named), f"cameras taken from {named} (--reconstruction)"
    if len(models := reconstructions(root)) < 2:
        return (models[0] if models else None), ""
    sizes = [_size(m) for m in models]
    best = models[sizes.index(max(sizes))]
    names = [m[0].relative_to(root).as_posix() for m in models]
    counts = ", ".join(f"{name}: {size}" for name, size in zip(names, sizes))
    chosen = best[0].relative_to(root).as_posix()
    return best, f"{chosen} is the largest reconstruction (images in {counts}); --reconstruction FOLDER takes another"


def _size(model: Model) -> int:
    """Return the number of posed images of a complete reconstruction; 0 for a damaged file, so that another one is taken."""
    with suppress(DataError):
        return len(read_poses(model[0] / f"images.{model[1]}"))
    return 0


def image_base(root: Path, model: Path) -> str | None:
    """Return the image folder of a reconstruction relative to the scene folder, such as ``images`` or ``.``, or None."""
    space = model
    if model != root and root in model.parents:
        space = model.parent if model.name.isdecimal() else model
        space = space.parent if space.name == "sparse" else space
    for place in dict.fromkeys((space, root)):
        for name, others in (("images", "images_*"), ("input", "input")):
            if place.is_relative_to(root) and scenes.has_folder(place, name, others):
                return (place / name).relative_to(root).as_posix()
    for place in dict.fromkeys((model, space, root)):  # as RealityScan exports them
        if place.is_relative_to(root) and any(p.suffix.lower() in SUFFIXES and p.is_file() for p in place.glob("[!.]*")):
            return place.relative_to(root).as_posix()
    return None


def _image_paths(
    scene: SceneFolder, images: Path, base: str, names: list[str], files: list[Path], where: str
) -> tuple[dict[str, Path], list[str]]:
    """Return the image file by name of the reconstruction, and notes for the user; missing files keep the path of their name.

    A name may begin with the image folder. Names without a file are matched without suffix and case; absolute ones, and labels
    with neither suffix nor folder, by file name, if only one file fits. Files of reduced images (images_8) may also have other
    names (LLFF's image000.png): they are matched in sorted order if the counts agree.
    """
    outside = {n for n in names if scenes.is_absolute(n) and not (scene.options.allow_outside and (images / n).is_file())}
    paths = {n: scene.child(images, n, where) for n in names if n not in outside}
    used = {n: p for n, p in paths.items() if p.is_file()}
    lost, taken = [n for n in names if n not in used], set(used.values())
    if not lost:
        return paths, []
    free = {p: p.relative_to(images).as_posix() for p in files if p not in taken}
    by_path, by_name = scenes.by_key(free), scenes.by_key({p: p.name for p in free})
    found: dict[str, Path] = {}
    for n in lost:
        plain = n.replace("\\", "/").removeprefix("./")
        inner = plain.removeprefix(f"{base}/")
        if n in outside:
            match = by_name.get(scenes.name_key(plain.rpartition("/")[2]))
        elif inner != plain and (images / inner).is_file():
            match = scene.child(images, inner, where)
        elif images == scene.root / base and (scene.root / plain).is_file():
            match = scene.child(scene.root, plain, where)
        else:
            match = by_path.get(scenes.name_key(plain)) or by_path.get(scenes.name_key(inner))
            match = match or by_name.get(scenes.name_key(f"{plain}."))  # a label such as frame.0001
        if match is not None:
            found[n] = match
    claims = Counter(found.values())
    found = {n: p for n, p in found.items() if claims[p] == 1 and p not in taken}
    if images != scene.root / base and len(lost) == len(names) == len(files) > len(found):
        pairs = dict(zip(sorted(names), files))
        return pairs, [f"images of {images.name} matched in sorted order: {min(names)} is {pairs[min(names)].name}"]
    for n in (n for n in outside if n not in found):
        elsewhere = scenes.is_absolute(n) and not Path(n).exists()
        paths[n] = images / scenes.missing_name(n) if elsewhere else scene.child(images, n, where)  # which refuses
    return paths | found, scenes.matched_note(found, images.name, scene.root)


def add_views(
    scene: SceneFolder, views: ViewList, base: str, file: Path, names: list[str], rows: Sequence[Posed], labels: bool = False
) -> tuple[dict[str, str], list[str]]:
    """Add the views of the rows of a file whose images are in the folder ``base``; ``labels`` may lack their suffix.

    Returns the names of the views by ``names``, which are all in the file, also of cameras without a row, and notes.
    """
    options = scene.options
    images, factor, resized = scene.images(base)
    flat = PurePosixPath(base).name not in IMAGES
    files = [p for p in list_images(images) if not flat or p.parent == images]
    paths, matched = _image_paths(scene, images, base, names, files, str(file))
    notes, missing = [resized] * bool(resized) + matched, list[str]()
    named: dict[str, str] = {}
    for name, lens, viewmat in rows:
        path = paths[name]
        of_file = scenes.is_absolute(name) or labels
        view = scenes.view_name(path.relative_to(images).as_posix() if of_file and images in path.parents else name)
        if options.excludes(view):
            continue
        if not path.is_file():
            missing.append(name)
            continue
        named[name] = views.claim(view, f"{file}, image {name!r}")
        mask = scene.mask_of(path, images, images / "masks" if flat else None)
        views.add(view, viewmat, partial(scene.image, path, lens, downscale=factor, mask=mask))
    unposed = len(set(files) - set(paths.values()))
    notes += [f"{unposed} files in {images.name} have no pose in the reconstruction and are left out"] * bool(unposed)
    notes += scenes.missing_note(missing, len(rows), "images", file, options.strict)
    return named, notes + views.notes(options) + scene.mask_notes()


@register("colmap")
class ColmapReader(Reader):
    """COLMAP reconstructions, binary or text, with their image folder."""

    description = "sparse/0, sparse, dense/0/sparse, colmap/sparse/0 or the folder with cameras and images .bin/.txt (COLMAP)"
    priority = 10

    def probe(self, folder: Path) -> Probe | None:
        """See `Reader.probe`."""
        if not (models := reconstructions(folder)):
            return None
        base, usual = image_base(folder, models[0][0]), (folder / "sparse" / "0", folder / "sparse", folder)
        lacks = models[0][2] or ([] if base else ["its image folder, images"])
        found = f"the COLMAP reconstruction in {models[0][0].relative_to(folder).as_posix()}"
        # scenes of other formats have such files, too: nerfstudio's have colmap/sparse/0
        other = base not in (None, "images") or not any(_found(place) in models for place in usual)
        return Probe(found, " and ".join(lacks), fallback=other)

    def read(self, folder: Path, options: ReadOptions) -> Scene:
        """See `Reader.read`."""
        choice, chosen = reconstruction(folder, options.reconstruction)
        if choice is None:
            named = options.reconstruction or "sparse/0"
            raise DataError(f"{folder / named}: holds no COLMAP reconstruction; give its folder in the scene, such as sparse/1")
        model, kind, lacks = choice
        if lacks:
            raise DataError(f"{model}: the COLMAP reconstruction lacks {' and '.join(lacks)}; copy the whole folder")
        scene, file = SceneFolder(folder, options), model / f"images.{kind}"
        stored = read_poses(scene.inside(file))
        lenses = read_cameras(scene.inside(model / f"cameras.{kind}"), options.lenses == "native")
        poses, unaligned = without_unaligned(stored, lenses, file, options.strict)
        base, views = image_base(folder, model) or "images", ViewList(options)
        place = model.relative_to(folder).as_posix() if model.is_relative_to(folder) else str(model)
        if not chosen and (base != "images" or place not in ("sparse/0", "sparse", ".")):
            chosen = f"cameras taken from {place}, images from {base}"
        names, rows = [name for name, *_ in stored.values()], list(posed_lenses(poses, lenses, file))
        named, found = add_views(scene, views, base, file, names, rows)
        notes = [note for note in (chosen, *unaligned, *found) if note]
        there = {v.name for v in views.views}  # without those that are left out
        names = {n: named[p[0]] for n, p in poses.items() if named.get(p[0]) in there}
        points, more = self._points(scene, model, kind, names)
        return self.scene(folder, views.views, notes + more, points=points, pixels=scene.pixel_source(by_folder=True))

    def _points(self, scene: SceneFolder, model: Path, kind: str, names: dict[int, str]) -> tuple[PointCloud | None, list[str]]:
        """Return the points of a reconstruction, else those of points3D.ply beside it, and notes."""
        path, ply, bad = model / f"points3D.{kind}", model / "points3D.ply", None if scene.options.strict else list[str]()
        if path.is_file():
            points = read_points(scene.inside(path), names, bad)
            return points, bad or ([] if len(points) else [f"{path.name} holds no points"])
        if ply.is_file():
            points = read_ply_points(scene.inside(ply), bad)
            return points, [f"points taken from {ply.name}, because {path.name} is missing", *(bad or [])]
        return None, [f"{path.name} is missing, so there are no points to start from"]
