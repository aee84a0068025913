"""`load_scene`: a folder becomes a scene, recentred and rescaled, with its views split."""

import functools
import hashlib
import itertools
import re
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path, PurePosixPath

import numpy as np

from warpgs.errors import DataError, UsageError, did_you_mean, expect, explained, listed, similar_folder
from warpgs.geometry import camera_extent, matmul, near_cameras
from warpgs.io import folder as scenes
from warpgs.io.folder import Probe, Reader, SceneFolder
from warpgs.io.image_files import MAX_PIXELS, READ, unread_note
from warpgs.io.images import ReadOptions, SceneOptions, cut_from_black, image_scale, list_images, matches
from warpgs.io.maps import check_found
from warpgs.plugins import returned
from warpgs.scene import Normalization, PointCloud, Scene, View, checked_scene

MIN_EXTENT = 1e-9
"""Extent of a camera set [file units] below which all cameras are taken to be in one place."""
MAX_COORDINATE = 1e12
"""Largest coordinate of a camera centre [file units] and of a point [u]; a file with a larger one is rejected."""


def far_off_note(views: list[View], points: PointCloud | None) -> list[str]:
    """Return a note that names the cameras far off the rest, if there are any."""
    near = near_cameras(np.array([v.camera.center for v in views]), None if points is None else points.points)
    names = [v.name for v, n in zip(views, near) if not n]
    which = f"{len(names)} of {len(views)} cameras are far off the rest and do not set the scale"
    return [f"{which}: {listed(names, 5)}; their poses may be wrong: estimate them again"] * bool(names)


def normalization_of(views: list[View], points: PointCloud | None, where: str) -> Normalization:
    """Return the similarity that puts the mean camera centre at the origin and the farthest camera at a distance of 1 / 1.1.

    Cameras far off the rest are ignored (`near_cameras`): otherwise, one wrong pose would put the scene before the near plane.
    If all cameras are in one place, points set the scale: the median of their largest offsets along an axis becomes 1. Without
    points the scale is unchanged.
    """
    centers = np.array([v.camera.center for v in views])
    far = np.abs(centers).max(axis=1)
    if not (far < MAX_COORDINATE).all():
        worst = int(np.argmax(far))
        raise DataError(f"{where}, image {views[worst].name!r}: its centre is beyond {MAX_COORDINATE:.0e} units; remove it")
    centers = centers[near_cameras(centers, None if points is None else points.points)]
    offset = centers.mean(0)
    extent = 1.1 * float(np.linalg.norm(centers - offset, axis=1).max())
    if extent < MIN_EXTENT:
        extent = 1.0
        if points is not None and len(points):
            with np.errstate(over="ignore"):
                median = float(np.median(np.abs(points.points - offset).max(axis=1)))
            extent = median if MIN_EXTENT < median < MAX_COORDINATE else 1.0
    return Normalization(offset, 1 / extent)


def normalize_view(view: View, n: Normalization) -> View:
    """Return the view with camera (float64) and metric depth in scene coordinates; rotation and intrinsics stay."""
    viewmat = view.camera.viewmat.copy()
    viewmat[:3, 3] = n.scale * (matmul(viewmat[:3, :3], n.offset) + viewmat[:3, 3])
    depth = view.depth
    if depth is not None and depth.kind == "metric":
        depth = replace(depth, values=depth.values * np.float32(n.scale))
    return replace(view, camera=replace(view.camera, viewmat=viewmat), depth=depth)


def normalize_points(points: PointCloud, n: Normalization, where: str) -> PointCloud:
    """Return the points in scene coordinates (float64)."""
    with np.errstate(over="ignore", invalid="ignore"):
        moved = n.scale * (points.points - n.offset)
    far = int((~(np.abs(moved) < MAX_COORDINATE).all(axis=1)).sum())
    if far:
        raise DataError(f"{where}: {far} of {len(moved)} points are not finite, or too far from the cameras; remove them")
    return replace(points, points=moved)


def fingerprint(views: Iterable[View]) -> str:
    """Return the SHA-256, hexadecimal, over names, cameras, pixels, masks and given maps of the views in their order."""
    digest = hashlib.sha256()
    for v in views:
        # cameras to 1e-9: their last bits depend on the machine's linear algebra
        cameras = [np.round(m, 9) + 0.0 for m in (v.camera.viewmat, v.camera.K)]
        maps = () if v.depth is None else (v.depth.values, v.depth.confidence)
        arrays = [*cameras, v.image] + [m for m in (v.mask, v.score_mask, v.alpha, *maps, v.normals) if m is not None]
        # name and shapes are delimited, so that bytes moved from one field to the next cannot give the same hash
        lens = () if v.camera.distortion is None else tuple(np.round(v.camera.distortion, 9).tolist())
        model = () if v.camera.model == "pinhole" else (v.camera.model, *lens)
        model += () if v.depth is None else (v.depth.kind, v.depth.confidence is None)
        digest.update(repr((v.name, [(a.shape, str(a.dtype)) for a in arrays], *model)).encode("utf-8", "surrogateescape"))
        for array in arrays:
            digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()


DTU_TRAIN = (25, 22, 28, 40, 44, 48, 0, 8, 13)
"""Training ids of pixelNeRF's DTU protocol; the first 3, 6 or 9 are used."""
DTU_TEST = (1, 2, 9, 10, 11, 12, 14, 15, 23, 24, 26, 27, 29, 30, 31, 32, 33, 34, 35, 41, 42, 43, 45, 46, 47)
DTU_VIEWS = 49
"""Number of views to which the ids refer: the first 49 of a scan; some scans have 64."""
BLENDER_TRAIN = (2, 16, 26, 55, 73, 76, 86, 93)
"""Training ids of DietNeRF's 8-view Blender protocol; tests are every 8th of the test frames."""

SPECS = "llff:K, mip360:K, dtu:3|6|9, blender:8, every:N, all, or train=NAMES;test=NAMES"


@dataclass(frozen=True)
class Split:
    """Names of the training views and of the held-out views; disjoint."""

    train: tuple[str, ...]
    test: tuple[str, ...]

    def __post_init__(self):
        if both := set(self.train) & set(self.test):
            raise DataError(f"views {listed(sorted(both), 5)} are in training and in test; name each once")
        if not self.train:
            raise DataError("the split leaves no training view; name at least one")


def _every_8th(names: list[str], count: int, spec: str) -> Split:
    pool = [n for i, n in enumerate(names) if i % 8]
    if not 1 <= count <= len(pool):
        raise DataError(f"split {spec}: needs {count} views, {len(pool)} of {len(names)} remain without every 8th; take fewer")
    # np.round goes half to even, as the published id tables do
    return Split(tuple(pool[i] for i in np.round(np.linspace(0, len(pool) - 1, count)).astype(int)), tuple(names[::8]))


def _dtu(names: list[str], count: int, spec: str) -> Split:
    if count not in (3, 6, 9):
        raise UsageError(f"split {spec!r}: the DTU protocol has 3, 6 or 9 training views; use dtu:3, dtu:6 or dtu:9")
    found = scenes.protocol_ids(names, DTU_TRAIN[:count] + DTU_TEST, DTU_VIEWS, f"split {spec}")
    return Split(tuple(found[i] for i in DTU_TRAIN[:count]), tuple(found[i] for i in DTU_TEST))


def _frame_number(name: str) -> tuple[int, str]:
    digits = re.findall(r"[0-9]{1,12}", PurePosixPath(name).stem)
    return int(digits[-1]) if digits else -1, name


def _blender(names: list[str], count: int, spec: str) -> Split:
    if count != len(BLENDER_TRAIN):
        raise UsageError(f"split {spec!r}: the Blender protocol has {len(BLENDER_TRAIN)} training views; use blender:8")
    # r_10 sorts before r_2 by name; the ids count frames
    train, test = (sorted((n for n in names if n.split("/")[0] == s), key=_frame_number) for s in ("train", "test"))
    if len(train) <= max(BLENDER_TRAIN) or not test:
        raise DataError(f"split {spec}: needs 100 frames in train, 200 in test, not {len(train)} and {len(test)}; use every:N")
    return Split(tuple(train[i] for i in BLENDER_TRAIN), tuple(test[::8]))


def _finder(names: list[str], spec: str) -> Callable[[str], str]:
    """Return a function that finds views by name or name end, with suffix or without; the strictest kind of match decides."""
    bare = {n: str(PurePosixPath(n).with_suffix("")) for n in names}

    @functools.cache
    def by_end(plain: bool, count: int) -> dict[str, list[str]]:
        """Return names of more than ``count`` parts by their last ``count`` parts; if it is 0, all names by the whole name."""
        table: dict[str, list[str]] = {}
        for name in names:
            head, *tail = (bare[name] if plain else name).rsplit("/", count) if count else (bare[name] if plain else name,)
            if len(tail) == count:
                table.setdefault("/".join(tail) if count else head, []).append(name)
        return table

    def find(wanted: str) -> str:
        for count, plain in itertools.product((0, wanted.count("/") + 1), (False, True)):
            matches = by_end(plain, count).get(wanted, [])
            if len(matches) == 1:
                return matches[0]
            if matches:
                raise DataError(f"split {spec}: {wanted!r} could be any of {listed(matches, 5)}; give the whole name")
        near = did_you_mean(wanted, names, 0.3) or f"the views are {listed(names, 3)}"
        raise DataError(f"split {spec}: no view {wanted!r}; {near}")

    return find


def check_spec(spec: str) -> None:
    """Check that the specification of a split can be understood, before a scene is read."""
    if not isinstance(spec, str):
        raise UsageError(f"split must be text, not {type(spec).__name__}; use {SPECS}")
    if "=" in spec:
        _named(spec)
    elif spec == "every:1":
        raise UsageError("split 'every:1' holds out every view and leaves none to train; use every:2 or more, or all")
    elif spec != "all" and not re.fullmatch(r"(llff|mip360|dtu|blender|every):([1-9][0-9]{0,5})", spec):
        raise UsageError(f"split {spec[:80]!r} is not understood; use {SPECS}")


def _named(spec: str) -> dict[str, str]:
    """Return the names that a specification lists for train and for test."""
    parts: dict[str, str] = {}
    for part in filter(str.strip, spec.split(";")):
        key, sep, values = (x.strip() for x in part.partition("="))
        if key not in ("train", "test") or not sep or key in parts:
            raise UsageError(f"split {spec[:80]!r} is not understood; use {SPECS}")
        parts[key] = values
    return parts


def _explicit(names: list[str], spec: str) -> Split:
    parts: dict[str, tuple[str, ...]] = {}
    find = _finder(names, spec)
    for key, values in _named(spec).items():
        found = [find(v.strip()) for v in values.split(",") if v.strip()]
        if twice := sorted(n for n, count in Counter(found).items() if count > 1):
            raise DataError(f"split {spec}: {key} names {twice[0]} twice; name every view once")
        parts[key] = tuple(found)
    named = {name for part in parts.values() for name in part}
    others = tuple(n for n in names if n not in named)
    return Split(parts.get("train", others), parts.get("test", others))


def split_views(scene: Scene, spec: str) -> Split:
    """Return the split of a scene that a specification names.

    ``llff:K`` and ``mip360:K``: every 8th of the sorted views is held out, and K of the others, evenly spaced, train. ``dtu:K``
    and ``blender:8``: the published ids. ``every:N``: every Nth is held out, the others train. ``all``: none is held out.
    ``train=a,b;test=c``: names, with or without suffix; if one part is missing, it consists of all other views.
    """
    return split_names(sorted(v.name for v in scene.views), spec)


def split_names(names: list[str], spec: str) -> Split:
    """Return the split of views with these sorted names, as `split_views` does."""
    check_spec(spec)
    if spec == "all":
        return Split(tuple(names), ())
    if "=" in spec:
        return _explicit(names, spec)
    kind, number = spec.split(":")
    count = int(number)
    if kind == "every":
        return Split(tuple(n for i, n in enumerate(names) if i % count), tuple(names[::count]))
    return {"llff": _every_8th, "mip360": _every_8th, "dtu": _dtu, "blender": _blender}[kind](names, count, spec)


def held_out_split(scene: Scene) -> tuple[str, str]:
    """Return the default split of a study, which needs held-out views, and a note.

    Every 8th view is held out if there are at least 9, else the middle view. No view is held out if there are only two, or if
    the name of the middle view cannot be written in a specification.
    """
    names = sorted(v.name for v in scene.views)
    if len(names) >= 9:
        return "every:8", "no --split given: every 8th view is held out (--split every:8)"
    middle = names[len(names) // 2]
    if len(names) == 2 or set(middle) & set(",;=") or middle != middle.strip():
        return "all", "no --split given: every view trains, none is held out (--split all)"
    return f"test={middle}", f"no --split given: {middle} is held out"


def coincident_views(scene: Scene, split: Split) -> list[tuple[str, str]]:
    """Return pairs (held-out view, training view) with the same camera: a copy of the training image would score well.

    Two cameras count as the same if all entries of their poses differ by less than a thousandth; lengths are in camera extents.
    """
    unit = np.array([[1, 1, 1, 1 / max(camera_extent([v.camera for v in scene.views]), 1e-9)]] * 3 + [[1] * 4])
    poses = {v.name: v.camera.viewmat * unit for v in scene.views}
    trained = np.stack([poses[b] for b in split.train])
    same = ((a, np.abs(trained - poses[a]).max((1, 2)) < 1e-3) for a in split.test)
    return [(a, split.train[i]) for a, found in same for i in np.flatnonzero(found)]


FOLDER = "idrmasks"
"""Default subfolder of a scene: the name under which DTU's masks are published."""
ASPECT_TOLERANCE = 0.02
"""Largest relative difference of aspects: undistorted DTU images differ by about a percent from the originals' masks."""


def _fit(path: Path, mask: np.ndarray, view: View) -> np.ndarray:
    import cv2

    height, width = view.image.shape[:2]
    if not abs((mask.shape[1] / mask.shape[0]) / (width / height) - 1) <= ASPECT_TOLERANCE:
        raise DataError(f"{path}: its aspect is not that of {view.name}, {width} x {height} px; give the masks of these images")
    if mask.shape != (height, width):
        mask = cv2.resize(mask.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA) > 0.5
    if view.mask is not None:  # pixels outside the lens or under a mask file have no reference
        mask = mask & view.mask
    if not mask.any():
        raise DataError(f"{path}: the mask leaves no pixel of {view.name} to score; white keeps a pixel")
    return mask


def add_score_masks(views: list[View], folder: Path, scene: SceneFolder) -> tuple[list[View], str]:
    """Give every view its object mask, matched by image id and never by sorted order.

    The masks lie in ``folder`` or in its subfolder `mask`, named by id counted from 0 (000.png, 001.png, ...); the images
    are named by the same ids, or by DTU's own names, in which `rect_001_...` is id 0.
    """
    inner = folder / "mask"
    folder = inner if inner.is_dir() else folder
    files = list_images(folder) if folder.is_dir() else []
    names = [v.name for v in views]
    numbers, ids = scenes.image_ids([f.name for f in files]) or [], scenes.image_ids(names) or []
    masks = dict(zip(numbers, files))
    fix = "give a folder with 000.png, 001.png, ... by image id to --score-masks (an image rect_001_... is id 0)"
    with explained(f"{folder}: these masks do not fit", fix, ValueError):
        expect(files, "the folder contains none")
        expect(numbers, "the masks have no distinct numbers")
        expect(ids, f"the images ({names[0]}, ...) have no distinct numbers")
        missing = sorted(set(ids) - set(masks))
        expect(not missing, f"no mask for image id {listed(missing, 8)}")
        shifted = min(ids) == 1 and 0 in masks and not scenes.named_by_dtu(names)
        expect(not shifted, "the images start with 1, the masks with 0: let both count from 0, or remove mask 0")
    done = [replace(v, score_mask=_fit(masks[i], scene.mask(masks[i]) > 0.5, v)) for i, v in zip(ids, views)]
    return done, f"scores use only pixels inside the masks in {folder}, matched by image id; the fit ignores these masks"


def load_scene(
    path: str | Path,
    *,
    reader: str | type[Reader] | Reader | None = None,
    downscale: int | None = None,
    max_side: int | None = None,
    strict: bool = False,
    reconstruction: str | None = None,
    exclude: str | None = None,
    allow_outside: bool = False,
    masks: str = "ignore",
    mask_keeps: str = "white",
    black_is_empty: bool = True,
    score_masks: str | Path | None = None,
    max_pixels: int = MAX_PIXELS,
    lenses: str = "undistort",
    depths: str | Path | None = None,
    normals: str | Path | None = None,
    depth_kind: str = "metric",
    depth_unit: float | None = None,
    normal_axes: str = "opencv",
    progress: Callable[[str], object] | None = None,
) -> Scene:
    """Read a scene folder of any supported format.

    Views are sorted by name, downscaled and, with ``lenses="undistort"``, undistorted. Coordinates are recentred and rescaled
    in float64; `Scene.normalization` stores the similarity. `Scene.notes` lists all automatic choices.

    Args:
        path: The scene folder.
        reader: Name of a format (colmap, transforms, llff, dtu, middlebury, metashape, realityscan), or a `Reader` of your own:
            an object, a class, ``module:Class`` or ``path/to/file.py:Class``. None for the built-in reader that recognises the
            folder.
        downscale: Factor by which both image sides shrink; a folder `images_N` is used if it exists. None for 1.
        max_side: Largest image side [px], 0 for no limit; larger images are reduced to it, and the intrinsics with them. None
            means 1600 if ``downscale`` is None, too, and no limit otherwise.
        strict: True to treat a frame without an image file, or numbers that are not finite, as an error instead of a note.
        reconstruction: Folder of the COLMAP reconstruction inside the scene folder, such as ``sparse/1``. None for the largest
            one at the usual places (docs/scenes.md).
        exclude: Images to leave out: names or patterns such as ``blurry*``, with or without folder and suffix, separated by
            commas.
        allow_outside: True to allow names and links that point to files outside the scene folder.
        masks: Treatment of masked-out pixels: ignore (left out of fit and scores) or cutout (transparent, gray pixels partly:
            `View.alpha`).
        mask_keeps: Colour of a mask file that keeps a pixel: white or black.
        black_is_empty: True to make dark pixels around an object and in its holes transparent, if every image shows an object
            on black and none has an alpha channel or a mask.
        score_masks: Folder with object masks for scoring, matched by image id; None for `idrmasks` in the scene folder, if it
            exists.
        max_pixels: Largest number of pixels that an image or a mask may have as stored.
        lenses: Treatment of lens distortion: undistort (images are resampled to a pinhole) or native (images are unchanged, and
            ``Camera.model`` is opencv or fisheye with ``Camera.distortion``). Fisheyes need native.
        depths: Folder of depth maps, 16-bit PNG or NPY, with the names of the images (docs/scenes.md, "Depth and normals");
            None for the maps named in transforms.json, ``none`` to ignore these.
        normals: Folder of normal maps, as for ``depths``.
        depth_kind: Meaning of the depth maps: metric (lengths in units of the cameras), relative (lengths up to a scale and a
            shift of each view) or disparity (inverse lengths up to a scale and a shift).
        depth_unit: Length of one unit of a metric depth map in units of the cameras; None means 0.001 for integers and 1 for
            floats.
        normal_axes: Axes of the normals: opencv (y down, z forward) or opengl (y up, z back) of the camera.
        progress: Called with a line for the user for each image, by the thread that called; None for no messages.

    Returns:
        The scene.

    Raises:
        DataError: A file of the folder is missing or malformed; the message names file, reason and fix.
        ResourceError: There is not enough memory to decode an image.
        UsageError: A number is out of range, a choice or the reader is unknown, an image would become too small, or a camera
            model does not support a given map.
    """
    folders = {name: None if p is None else str(p) for name, p in (("depths", depths), ("normals", normals))}
    options = SceneOptions(
        downscale=downscale, max_side=max_side, strict=strict, reconstruction=reconstruction, exclude=exclude,
        allow_outside=allow_outside, masks=masks, mask_keeps=mask_keeps,
        black_is_empty=black_is_empty, score_masks=None if score_masks is None else str(score_masks), max_pixels=max_pixels,
        lenses=lenses, depth_kind=depth_kind, depth_unit=depth_unit, normal_axes=normal_axes, **folders,
    )  # fmt: skip
    return read_folder(path, options, reader, progress)


def read_folder(
    path: str | Path,
    options: SceneOptions,
    reader: str | type[Reader] | Reader | None = None,
    progress: Callable[[str], object] | None = None,
    *,
    hashed: bool = True,
) -> Scene:
    """Read a scene folder, as `load_scene` does; without its fingerprint if ``hashed`` is False."""
    root, (factor, side), numbers = Path(path), image_scale(options.downscale, options.max_side), itertools.count(1)
    on_image = None if progress is None else lambda name: progress(f"reading {root}: image {next(numbers)}")
    given = {f.name: getattr(options, f.name) for f in fields(SceneOptions)}
    checked = ReadOptions(**given | {"downscale": factor, "max_side": side, "on_image": on_image})
    # folders without permission, names too long for the file system, disks that fail
    with explained(f"{root}: cannot be read", "fix its permissions or copy it"):
        if not root.is_dir():
            fix = "give a folder of photographs, or of images with their cameras"
            found = f"is a file; {fix}" if root.is_file() else f"no such folder; {similar_folder(root) or fix}"
            raise DataError(f"{root}: {found}")
        if checked.reconstruction is None:
            chosen, notes = detect(root) if reader is None else (_accepted(root, scenes.find_reader(reader)), [])
        elif reader in (None, "colmap"):
            chosen, notes = scenes.find_reader("colmap"), []
        else:
            raise UsageError("--reconstruction requires a COLMAP scene; leave it out, or give --reader colmap")
        scene = _finished(root, chosen, chosen.read(root, checked), notes, checked)
        return replace(scene, fingerprint=fingerprint(scene.views)) if hashed else scene


def detect(root: Path) -> tuple[Reader, list[str]]:
    """Return the reader of the first complete format of a scene folder, and notes on the formats passed over."""
    readers = scenes.all_readers()
    found = [(r, p) for r in readers if (p := _probe(r, root)) is not None]
    complete = [r for r, p in sorted(found, key=lambda row: row[1].fallback) if not p.missing]
    broken = [f"{p.found} lacks {p.missing}" for _, p in found if p.missing]
    if not complete and broken:
        raise DataError(f"{root}: {broken[0]}, and no other format was found. Copy the whole reconstruction")
    if not complete:
        images = bool(list_images(root))
        if not images and (unread := unread_note(root)):
            raise DataError(f"{root}: {unread}")
        photographs = "" if images else f"no photographs ({READ}) and "
        remedy = ". It holds images without cameras; `warpgs poses` finds the cameras" if images else ""
        known = ", ".join(r.description for r in readers)
        raise DataError(f"{root}: {photographs}no scene format found. Looked for: {known}{remedy}")
    taken, *others = complete
    notes = [f"{lack}; {taken.name} is complete and is used instead" for lack in broken]
    notes += [f"the folder also holds {' and '.join(r.name for r in others)}: {taken.name} is used"] if others else []
    return taken, notes


def _probe(reader: Reader, root: Path) -> Probe | None:
    """Return what a reader finds in a folder."""
    found: Probe | None = returned(reader, "probe", reader.probe(root), (Probe, type(None)), "a Probe, or None")
    return found


def _accepted(root: Path, reader: Reader) -> Reader:
    """Return a reader that the user chose; DataError where its format is not in the folder or not complete."""
    if (probe := _probe(reader, root)) is None:
        others = [p.found for r in scenes.all_readers() if (p := _probe(r, root)) is not None]
        there = f"; the folder holds {' and '.join(others)}" if others else ""
        raise DataError(f"{root}: the reader {reader.name} finds no scene of its format{there}. Choose another reader")
    if probe.missing:
        raise DataError(f"{root}: {probe.found} lacks {probe.missing}. Copy the whole scene")
    return reader


def _exclusions(options: ReadOptions, names: list[str]) -> list[str]:
    """Return the note on views that `--exclude` left out; DataError for a pattern without a view, with similar ``names``."""
    out = options.excluded
    for pattern in options.patterns():
        if not any(matches(name, pattern) for name in out):
            near = did_you_mean(pattern, names, 0.3) or f"the views are {listed(names, 3)}"
            raise DataError(f"--exclude {pattern[:80]}: no view has this name; {near}")
    return [f"left out by --exclude: {len(out)} image{'s' if len(out) != 1 else ''}: {listed(out)}"] if out else []


MIN_BASELINE = 1e-3
"""Spread of the cameras, as a fraction of their distance from the points, below which parallax is less than a pixel."""


SPARSE = 16
"""Distance of the pixels that are compared first where all pixels of photographs are compared [px]."""


def _varies(image: np.ndarray) -> bool:
    """Return whether an image [H, W, 3] has more than one colour."""
    return bool((image.min((0, 1)) < image.max((0, 1))).any())


def doubtful_notes(views: list[View], points: PointCloud | None) -> list[str]:
    """Return notes on cameras and photographs, in file units, that are possible but most likely wrong."""
    notes = []
    centers = np.array([v.camera.center for v in views])
    middle = centers.mean(0)
    spread = float(np.linalg.norm(centers - middle, axis=1).max())
    distance = 0.0
    if points is not None and len(points):
        with np.errstate(over="ignore", invalid="ignore"):
            distance = float(np.median(np.linalg.norm(points.points - middle, axis=1)))
    if spread < max(MIN_EXTENT, MIN_BASELINE * min(distance, MAX_COORDINATE)):
        notes.append(f"all cameras are within {spread:.2g} units of one place, without depth: move between photographs")
    off = [v for v in views if not all(0 <= v.camera.K[i, 2] <= n for i, n in ((0, v.camera.width), (1, v.camera.height)))]
    if off:
        notes.append(f"principal points of {len(off)} views, as of {off[0].name}, are outside the image; calibrate again")
    # most photographs differ, and vary, in a few pixels already
    equal: dict[bytes, list[str]] = {}
    few = [v.image[::SPARSE, ::SPARSE] for v in views]
    often = Counter(pixels.tobytes() for pixels in few)
    for v in (v for v, pixels in zip(views, few) if often[pixels.tobytes()] > 1 and v.image.min() < v.image.max()):
        # views that show nothing are alike
        equal.setdefault(hashlib.sha256(np.ascontiguousarray(v.image).data).digest(), []).append(v.name)
    if blank := [v.name for v, pixels in zip(views, few) if not (_varies(pixels) or _varies(v.image))]:
        notes.append(f"{len(blank)} of {len(views)} photographs have a single colour, such as {blank[0]}; --exclude them")
    if same := [names for names in equal.values() if len(names) > 1]:
        count = sum(map(len, same))
        notes.append(f"{count} of {len(views)} photographs have equal pixels, as {same[0][0]} and {same[0][1]}; remove copies")
    return notes


def _finished(root: Path, reader: Reader, scene: Scene, notes: list[str], options: ReadOptions) -> Scene:
    """Check a scene that a reader returned; return it sorted, in scene coordinates, with score masks."""
    own = f"the reader {reader.name} must return a Scene in file coordinates, without a Normalization; fix it"
    scene = checked_scene(returned(reader, "read", scene, Scene, "a Scene"), f"{root}, ")
    if scene.normalization.scale != 1 or scene.normalization.offset.any():
        raise UsageError(own)
    views, points, more = [v for v in scene.views if not options.excludes(v.name)], scene.points, scene.notes
    more = (*more, *_exclusions(options, [v.name for v in views]))
    if len(views) < 2:
        raise DataError(f"{root}: has {len(views)} usable views, not at least 2 ({'; '.join(more)}). Add images with cameras")
    if options.black_is_empty and not any(scene.background):
        views, note = cut_from_black(views)
        more = (*more, note) if note else more
    more = (*more, *check_found(views, options), *doubtful_notes(views, points))
    n: Normalization = normalization_of(views, points, str(root))
    more = (*more, *far_off_note(views, points))
    if n.origin.any():
        at = ", ".join(f"{v:.12g}" for v in n.origin)
        more = (*more, f"map coordinates: files of Gaussians, meshes and cameras are relative to {at}, which they state")
    views = [normalize_view(v, n) for v in sorted(views, key=lambda v: v.name)]
    if points is not None:
        points = normalize_points(points, n, str(root))
    if options.score_masks is not None or (root / FOLDER).is_dir():
        # links in a folder that the user names must stay inside it; links in the scene's own folder, inside the scene
        masks, bound = (root / FOLDER, root) if options.score_masks is None else (Path(options.score_masks),) * 2
        plain = replace(options, mask_keeps="white", depths=None, normals=None)
        views, note = add_score_masks(views, masks, SceneFolder(bound, plain))
        more = (*more, note)
    return replace(
        scene, path=str(root), format=reader.name, views=tuple(views), points=points, normalization=n, notes=(*notes, *more)
    )
