"""Scenes in a transforms.json, and files of cameras alone."""

import json
import math
import posixpath
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from warpgs import schema
from warpgs.errors import DataError, expect, explained
from warpgs.files import is_within, read_file
from warpgs.geometry import matmul, pose_of, seen_pixels
from warpgs.io import colmap, folder as scenes
from warpgs.io.colmap import PARSING
from warpgs.io.folder import Probe, Reader, SceneFolder, ViewList, register
from warpgs.io.images import BLACK, SUFFIXES, Lens, ReadOptions, list_images
from warpgs.io.maps import SUFFIXES as MAPS, NamedMaps
from warpgs.scene import ORIGIN, Camera, PointCloud, Scene, View, checked_origin

BLENDER_FILES = tuple(f"transforms_{split}.json" for split in ("train", "val", "test"))
MODELS = ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "FULL_OPENCV", "PERSPECTIVE")
"""Lenses of the five distortion terms of OpenCV. FULL_OPENCV has no others here; PERSPECTIVE is nerfstudio's name for all."""
FISHEYE = "OPENCV_FISHEYE"
UNSUPPORTED_TERMS = ("k4", "k5", "k6", "is_fisheye", "fisheye_crop_radius")
"""Keys of lens models that the five distortion terms of OpenCV cannot express; for native lenses, a fisheye's k4 is read."""
WHITE = (1.0, 1.0, 1.0)
MAX_BYTES = 32 * 2**20
"""Largest file [bytes]; ten thousand frames take about ten million bytes."""
MAX_DEPTH = 16
"""Largest depth of nested lists and objects; real files have six."""
MAX_FOLDERS = 16
"""Largest number of names of a path that are compared with those in the scene folder."""


def files_of(root: Path) -> list[Path]:
    """Return the JSON files of the scene that exist: transforms.json, or Blender's three."""
    single = root / "transforms.json"
    return [single] if single.is_file() else [root / f for f in BLENDER_FILES if (root / f).is_file()]


def _json(path: Path, fix: str) -> Any:
    """Return the values of a JSON file of bounded size."""
    with explained(f"{path}: cannot be read as JSON", fix, (ValueError, RecursionError)):
        text = read_file(path, None, MAX_BYTES, fix).decode("utf-8-sig", "surrogateescape")
        schema.check_parts(text)
        return json.loads(text)


def read_json(path: Path) -> dict:
    """Return the parsed file with its list of frames."""
    values = _json(path, "write it again")
    with explained(f"{path}: is nested deeper than {MAX_DEPTH} levels", "write it again", schema.SchemaError):
        schema.check_depth(values, MAX_DEPTH)
    if not isinstance(values, dict) or not isinstance(values.get("frames"), list):
        raise DataError(f"{path}: has no list 'frames'; write it again")
    return values


def _number(frame: dict, shared: dict, key: str, where: str) -> float | None:
    """Return a number of the frame, else of the file; None if both lack it, DataError if it is not finite."""
    if (value := frame.get(key, shared.get(key))) is None:
        return None
    with explained(f"{where}: not a number", "write it without quotes", schema.SchemaError):
        schema.number()(value, key)
    return float(value)


def lens_of(frame: dict, shared: dict, width: int, height: int, where: str, native: bool = False) -> Lens:
    """Return the intrinsics of a frame; the frame's own values override the shared values of the file."""
    model = str(frame.get("camera_model", shared.get("camera_model", "OPENCV"))).upper()
    kept = ", or fit them with --lenses native" if not native else ""
    known = (*MODELS, FISHEYE) if native else MODELS
    if model not in known:
        raise DataError(f"{where}: camera model {model[:40]} is not supported. Undistort the images{kept * (model == FISHEYE)}")
    fisheye = native and bool(model == FISHEYE or frame.get("is_fisheye", shared.get("is_fisheye")))
    number = partial(_number, frame, shared, where=where)
    width, height = (own if (given := number(key)) is None else int(given) for key, own in (("w", width), ("h", height)))
    f, c = [], []
    for axis, side in (("x", width), ("y", height)):
        focal, angle, center = number(f"fl_{axis}"), number(f"camera_angle_{axis}"), number(f"c{axis}")
        if focal is None and angle is not None:
            if not 0 < angle < math.pi:
                raise DataError(f"{where}: camera_angle_{axis} is {angle} rad, not between 0 and pi")
            focal = 0.5 * side / math.tan(0.5 * angle)
        f.append(focal)
        c.append(side / 2 if center is None else center)
    distortion = [number(k) or 0.0 for k in (("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3"))]
    unread = ("k5", "k6", "fisheye_crop_radius", "p1", "p2") if fisheye else UNSUPPORTED_TERMS
    other = [k for k in unread if frame.get(k, shared.get(k))]
    if other:
        raise DataError(f"{where}: {other[0]} is not supported here. Undistort the images{kept * (other[0] == 'is_fisheye')}")
    fx = f[0] if f[0] is not None else f[1]
    if fx is None:
        raise DataError(f"{where}: has neither fl_x nor camera_angle_x, so its focal length is unknown; add one of them")
    K = np.array([[fx, 0, c[0]], [0, fx if f[1] is None else f[1], c[1]], [0, 0, 1.0]])
    name = FISHEYE if fisheye else model
    return Lens(K, width, height, tuple(distortion) if any(distortion) else (), name, fisheye).checked(where)


def matrix_of(frame: dict, where: str) -> np.ndarray:
    """Return the transform_matrix of a frame, shape [3, 4] or [4, 4]."""
    with explained(f"{where}: transform_matrix is missing or not made of rows of numbers", "correct it", PARSING):
        # through object, so that ragged rows and huge integers are caught here and strings are not parsed
        rows = [[float(x) if not isinstance(x, (str, bool)) else math.nan for x in row] for row in frame["transform_matrix"]]
        matrix = np.array(rows, np.float64)
    if matrix.shape not in ((3, 4), (4, 4)):
        raise DataError(f"{where}: transform_matrix must be [4, 4], not {list(matrix.shape)}; write the file again")
    return matrix


def _image_path(scene: SceneFolder, folder: Path, name: object, where: str) -> Path:
    """Return the image file of a frame; Blender's file names have no suffix."""
    path = scene.child(folder, name, where, root=scene.root)
    if path.suffix.lower() in SUFFIXES:
        return path
    candidates = [path.with_name(path.name + s) for s in SUFFIXES]
    return next((c for c in candidates if c.is_file()), candidates[0])


def _inner_names(name: str) -> list[str]:
    """Return the names in a scene folder that a name outside of it may mean: the ends of its path, longest first."""
    parts = [p for p in posixpath.normpath(name.replace("\\", "/")).split("/")[-MAX_FOLDERS:] if p not in ("", ".", "..")]
    ends = ["/".join(parts[i:]) for i in range(len(parts))]
    ends += [f"images/{parts[-1]}"] if parts else []
    return [e if Path(e).suffix.lower() in (*SUFFIXES, *MAPS, ".ply") else f"{e}.png" for e in ends]


def _image_paths(scene: SceneFolder, file: Path, frames: list[Any]) -> tuple[dict[str, Path], list[str]]:
    """Return the image file by name of the frames, and notes for the user; missing files keep the path of their name.

    Names without a file are matched without suffix and case, and those of another machine by the end of their path, if only
    one file fits.
    """
    folder, paths, refused = file.parent, dict[str, Path](), dict[str, DataError]()
    for number, frame in enumerate(frames):
        where = f"{file}, frame {number}"
        if not isinstance(frame, dict):
            raise DataError(f"{where}: expected an object with file_path and transform_matrix; write the file again")
        name = frame.get("file_path")
        try:
            paths[name] = _image_path(scene, folder, name, where)
        except DataError as e:
            if not isinstance(name, str):
                raise
            refused[name] = e
    taken = {p for p in paths.values() if p.is_file()}
    lost = [*(n for n, p in paths.items() if p not in taken), *refused]
    files = {p: p.relative_to(folder).as_posix() for p in list_images(folder)} if lost else {}
    found, fits = dict[str, Path](), scenes.by_key({p: n for p, n in files.items() if p not in taken})
    ends = Counter(end for n in (*paths, *refused) for end in {*map(scenes.name_key, _inner_names(n))}) if lost else Counter()
    for n in lost:
        names = _inner_names(n) if n in refused or scenes.is_absolute(n) else [scenes.view_name_of(paths[n], folder)]
        unique = (e for e in names if ends[scenes.name_key(e)] < 2)  # an end of two names is neither's
        matches = [folder / e if folder / e in files else fits.get(scenes.name_key(e)) for e in unique]
        found |= dict([(n, p) for p in matches if p is not None][:1])
    claims = Counter(found.values())
    found = {n: p for n, p in found.items() if claims[p] == 1 and p not in taken}
    for n, error in refused.items():
        if n not in found and (not scenes.is_absolute(n) or Path(n).exists()):
            raise error
        paths[n] = folder / scenes.missing_name(n)
    return paths | found, scenes.matched_note(found, file.name, scene.root)


Named = Callable[[object, str], Path]
"""A function that returns the path of a file other than a photograph from its name and the place of that name."""


def _named_file(scene: SceneFolder, folder: Path, taken: set[Path], moved: dict[str, Path], name: object, where: str) -> Path:
    """Return the path of a `Named` file; one outside of the scene is found by the end of its path, and stored in ``moved``."""
    ends = [p for e in _inner_names(str(name))[:-1] if (p := folder / e).is_file() and p not in taken]
    path = folder / str(name).replace("\\", "/")
    if ends and not path.is_file() and (scenes.is_absolute(str(name)) or not is_within(path, scene.root)):
        moved[str(name)] = ends[0]
        return ends[0]
    return scene.child(folder, name, where, root=scene.root)


def _named_maps(scene: SceneFolder, named: Named, shared: dict, frame: dict, where: str) -> NamedMaps:
    """Return the maps that a frame names under nerfstudio's keys."""

    def path(key: str, flag: str) -> Path | None:
        if not frame.get(key) or getattr(scene.options, flag) is not None:
            return None
        found = scene.inside(named(frame[key], f"{where}, {key}"))
        if found.suffix.lower() not in MAPS:
            raise DataError(f"{where}: {key} is {found.name}, but maps must be {' or '.join(MAPS)}; --{flag} none skips it")
        return found

    unit = _number(frame, shared, "depth_unit_scale_factor", where)
    if unit is not None and not unit > 0:
        raise DataError(f"{where}: depth_unit_scale_factor is {unit}; it must be above 0")
    return NamedMaps(path("depth_file_path", "depths"), path("normal_file_path", "normals"), unit)


def _points(scene: SceneFolder, file: Path, named: Named, shared: dict, views: list[View]) -> tuple[PointCloud | None, str]:
    """Return the points that the file names, in the coordinates of its cameras, and a note.

    The cameras include ``applied_transform``. nerfstudio's first versions stored points without it, later ones with it, under
    the same keys; so the form whose colours agree with the images is taken, and the later one in doubt.
    """
    where, name = f"{file}, ply_file_path", shared["ply_file_path"]
    try:
        path = scene.inside(named(name, where))
    except DataError as e:
        return None, f"no points to start from: {e}"
    if not path.is_file():
        return None, f"{str(name)[:80]} is missing, so there are no points to start from"
    bad: list[str] | None = None if scene.options.strict else []
    points = colmap.read_ply_points(path, bad)
    taken = "; ".join([f"points taken from {path.name}", *(bad or [])])
    if shared.get("applied_transform") is None or not len(points):
        return points, taken
    matrix = matrix_of({"transform_matrix": shared["applied_transform"]}, f"{file}, applied_transform")[:3]
    scale = _number({}, shared, "applied_scale", str(file))
    moved = (1.0 if scale is None else scale) * (matmul(points.points, matrix[:, :3].T) + matrix[:, 3])
    other = PointCloud(moved, points.colors)
    if _disagreement(other, views) < CLEARLY * _disagreement(points, views):
        return other, f"{taken}, moved by applied_transform, since the colours of the images agree then"
    return points, f"{taken}, without applied_transform, since the colours of the images agree so"


CLEARLY = 0.8
"""Largest ratio of two disagreements that decides: they differ by a factor of 2 to 5 if only one fits."""
COMPARED_VIEWS, COMPARED_POINTS = 16, 2000
"""Largest numbers of views and of points whose colours are compared."""


def _disagreement(points: PointCloud, views: list[View]) -> float:
    """Return the mean difference of the points' colours from the images, 0 to 1; a point outside of an image counts as 1."""
    some = slice(None, None, max(1, len(points) // COMPARED_POINTS))
    positions, colors = points.points[some], points.colors[some]
    errors = []
    for view in views[:: max(1, len(views) // COMPARED_VIEWS)]:
        seen, rows, columns, _ = seen_pixels(view.camera, positions)
        near = np.abs(view.image[rows, columns] - colors[seen]).mean(1).sum() if len(seen) else 0.0
        errors.append((near + len(positions) - len(seen)) / len(positions))
    return float(np.mean(errors)) if errors else 0.0


@register("transforms")
class TransformsReader(Reader):
    """Scenes with transforms.json, or Blender's transforms_train/val/test.json.

    Frames without a file are skipped and named in the notes; `ReadOptions.strict` makes them an error. The background of
    transparent images is white for Blender, else black.
    """

    description = "transforms.json or transforms_train.json (nerfstudio, instant-ngp, Blender)"
    priority = 20

    def probe(self, folder: Path) -> Probe | None:
        """See `Reader.probe`."""
        files = files_of(folder)
        return Probe(files[0].name) if files else None

    def read(self, folder: Path, options: ReadOptions) -> Scene:
        """See `Reader.read`."""
        background = BLACK if (folder / "transforms.json").is_file() else WHITE  # in Blender's layout
        scene, views, notes = SceneFolder(folder, options), ViewList(options), []
        missing, total, points = list[str](), 0, None
        for file in files_of(folder):
            shared = read_json(scene.inside(file))
            total += len(shared["frames"])
            origin = checked_origin(shared.get(ORIGIN, (0, 0, 0)), str(file))
            paths, matched = _image_paths(scene, file, shared["frames"])
            moved = dict[str, Path]()
            named = partial(_named_file, scene, file.parent, {*paths.values()}, moved)
            for number, frame in enumerate(shared["frames"]):
                where, path = f"{file}, frame {number}", paths[frame["file_path"]]
                if options.excludes(scenes.view_name_of(path, folder)):
                    continue
                if not path.is_file():
                    missing.append(str(frame["file_path"]))
                    continue
                name = views.claim(scenes.view_name_of(path, folder), where)
                where = f"{where} ({name})"
                viewmat = scenes.about(scenes.from_camera_to_world(matrix_of(frame, where), where, opengl=True), origin)
                if frame.get("mask_path"):
                    if not (mask_file := named(frame["mask_path"], f"{where}, mask")).is_file():
                        raise DataError(f"{where}: its mask {mask_file} is missing; restore it, or remove mask_path")
                    mask = partial(scene.mask, mask_file)
                else:
                    mask = scene.mask_of(path, folder / "images")
                lens = partial(lens_of, frame, shared, where=where, native=options.lenses == "native")
                maps = _named_maps(scene, named, shared, frame, where)
                views.add(name, viewmat, partial(scene.image, path, lens, mask=mask, background=background, named=maps))
            if shared.get("ply_file_path"):
                points, note = _points(scene, file, named, shared, views.views)
                notes.append(note)
            notes += matched + scenes.matched_note(moved, file.name, folder, "file")
            if unused := [key for s in ("train", "val", "test") if shared.get(key := f"{s}_filenames")]:  # of nerfstudio
                notes.append(f"{' and '.join(unused)} of {file.name} choose no views; --split 'train=NAMES;test=NAMES' does")
        notes += scenes.missing_note(missing, total, "frames", files_of(folder)[0], options.strict)
        if outside := sum(v.name.startswith("outside/") for v in views.views):
            notes.append(f"{outside} images are outside the scene folder; their views are named outside/...")
        notes += scenes.resampling_note(options.downscale) + views.notes(options) + scene.mask_notes()
        pixels = scene.pixel_source(by_folder=False)
        return self.scene(folder, views.views, notes, background=background, pixels=pixels, points=points)


Row = tuple[str, np.ndarray, Lens]
"""Name, camera_from_world [4, 4] and lens of a camera."""


def read_cameras(path: Path) -> tuple[dict[str, Camera], list[str]]:
    """Return the cameras of a file or of a COLMAP folder by name, in file units, and notes for the user.

    Lenses become pinholes, because renders have no distortion; a note reports lenses with distortion. A repeated name gets a
    number.
    """
    notes = list[str]()
    if path.is_dir():
        rows = _colmap(path, notes)
    else:
        values = _json(path, "check the path, or write the file again")
        drawn = isinstance(values, dict) and isinstance(values.get("camera_path"), list)
        rows = _inria(path, values) if isinstance(values, list) else _drawn(path, values) if drawn else _transforms(path)
    found: dict[str, Camera] = {}
    numbers: dict[str, int] = {}
    bent = 0
    for name, viewmat, lens in rows:
        free, number = name, numbers.get(name, 2)
        while free in found:  # each number of a name is tried once
            free, number = f"{name}-{number}", number + 1
        numbers[name] = number
        found[free] = Camera(viewmat, lens.K, lens.width, lens.height)
        bent += any(lens.distortion)
    if not found:
        raise DataError(f"{path}: holds no camera. Give cameras.json, transforms.json, or the folder of a scene")
    return found, notes + ([f"the lens distortion of {bent} of {len(found)} cameras is not rendered"] if bent else [])


def stated_origin(path: Path) -> np.ndarray:
    """Return the origin [3] that a file or a COLMAP folder of cameras states, 0 without one."""
    if path.is_dir():
        model, kind, _ = colmap_folder(path) or (path, "", [])
        return colmap.origin_stated(model / f"images.{kind}")
    values = _json(path, "check the path, or write the file again")
    first = values[0] if isinstance(values, list) and values else values
    return checked_origin((first if isinstance(first, dict) else {}).get(ORIGIN, (0, 0, 0)), str(path))


def _inria(path: Path, rows: list[Any]) -> Iterator[Row]:
    """Yield the cameras of rows with a camera-to-world rotation in OpenCV axes and the camera centre."""
    for i, row in enumerate(rows):
        where = f"{path}, camera {i}"
        with explained(f"{where}: needs rotation, position, width, height, fx and fy as numbers", "correct it", PARSING):
            rotation, position = np.array(row["rotation"], np.float64), np.array(row["position"], np.float64)
            pose = pose_of(rotation.reshape(3, 3), position.reshape(3))
            width, height, fx, fy = (float(row[key]) for key in ("width", "height", "fx", "fy"))
            lens = Lens(np.array([[fx, 0, width / 2], [0, fy, height / 2], [0, 0, 1]]), int(width), int(height))
            name, origin = str(row.get("img_name", i)), checked_origin(row.get(ORIGIN, (0, 0, 0)), where)
        yield name, scenes.about(scenes.from_camera_to_world(pose, where, opengl=False), origin), lens.checked(where)


def _drawn(path: Path, values: dict[str, Any]) -> Iterator[Row]:
    """Yield the cameras of a path of nerfstudio's viewer: camera-to-world in OpenGL axes, vertical field of view [deg]."""
    if (kind := values.get("camera_type", "perspective")) != "perspective":
        raise DataError(f"{path}: camera_type is {str(kind)[:40]}, but renders are pinholes; export a perspective path")
    for i, frame in enumerate(values["camera_path"]):
        where = f"{path}, camera_path {i}"
        with explained(f"{where}: needs camera_to_world, fov, render_width and render_height", "export it again", PARSING):
            pose = np.array(frame["camera_to_world"], np.float64).reshape(4, 4)
            width, height, fov = int(values["render_width"]), int(values["render_height"]), float(frame["fov"])
            expect(0 < fov < 180, "fov")
        focal = 0.5 * height / math.tan(0.5 * math.radians(fov))
        lens = Lens(np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]), width, height)
        yield f"{i:05d}", scenes.from_camera_to_world(pose, where, opengl=True), lens.checked(where)


def _transforms(path: Path) -> Iterator[Row]:
    """Yield the cameras of frames; the file must give its image size."""
    shared = read_json(path)
    origin = checked_origin(shared.get(ORIGIN, (0, 0, 0)), str(path))
    for i, frame in enumerate(shared["frames"]):
        where = f"{path}, frame {i}"
        if not isinstance(frame, dict):
            raise DataError(f"{where}: expected an object with file_path and transform_matrix. Write the file again")
        if any(frame.get(key, shared.get(key)) is None for key in ("w", "h")):
            raise DataError(f"{where}: gives no w and h, so the image size is unknown. Add them, or give the scene's folder")
        lens = lens_of(frame, shared, 0, 0, where)
        viewmat = scenes.from_camera_to_world(matrix_of(frame, where), where, opengl=True)
        yield str(frame.get("file_path", i)), scenes.about(viewmat, origin), lens


def colmap_folder(folder: Path) -> tuple[Path, str, list[str]] | None:
    """Return the `colmap.reconstruction` in a scene folder, sparse or sparse/0; None without one."""
    return colmap.reconstruction(folder)[0] or colmap.reconstruction(folder / "0")[0]


def _colmap(folder: Path, notes: list[str]) -> Iterator[Row]:
    """Yield the cameras of a reconstruction, sorted by name; ``notes`` get a note on those that are left out."""
    model, kind, lacks = colmap_folder(folder) or (folder, "", ["all"])
    if lacks:
        raise DataError(f"{folder}: lacks COLMAP's files cameras and images. Give cameras.json, transforms.json or a scene")
    lenses, file = colmap.read_cameras(model / f"cameras.{kind}"), model / f"images.{kind}"
    poses, notes[:] = colmap.without_unaligned(colmap.read_poses(file), lenses, file, strict=False)
    for name, lens, viewmat in colmap.posed_lenses(poses, lenses, file):
        yield name, viewmat, lens
