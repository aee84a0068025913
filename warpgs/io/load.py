"""Loading of a `Scene` from a folder: choose a reader, read, bring to scene coordinates, fingerprint."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from warpgs.errors import DataError, UsageError
from warpgs.io.black_background import cut_from_black
from warpgs.io.decoding import MAX_PIXELS
from warpgs.io.folders import SceneFolder
from warpgs.io.given_maps import check_found
from warpgs.io.image_formats.kinds import READ
from warpgs.io.images import list_images
from warpgs.io.map_files import NO_MAPS, MapOptions
from warpgs.io.normalize import fingerprint, normalization_of, normalize_points, normalize_view
from warpgs.io.readers import Reader, ReadOptions, all_readers, find_reader, image_scale
from warpgs.io.score_masks import FOLDER, add_score_masks
from warpgs.io.unread_formats import unread_note
from warpgs.scene import Normalization, Scene
from warpgs.scene_checks import checked_scene
from warpgs.suggestion import similar_folder


def load_scene(
    path: str | Path,
    *,
    reader: str | type[Reader] | Reader | None = None,
    downscale: int | None = None,
    max_side: int | None = None,
    strict: bool = False,
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
        reader: Name of a format (colmap, transforms, llff, dtu, middlebury), or a `Reader` of your own: an object, a class,
            ``module:Class`` or ``path/to/file.py:Class``. None for the built-in reader that recognises the folder.
        downscale: Factor by which both image sides shrink; a folder `images_N` is used if it exists. None for 1.
        max_side: Largest image side [px], 0 for no limit; larger images are reduced to it, and the intrinsics with them. None
            means 1600 if ``downscale`` is None, too, and no limit otherwise.
        strict: True to treat a frame without an image file as an error instead of a note.
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
        progress: Called with a line for the user before each image is decoded; None for no messages.

    Returns:
        The scene.

    Raises:
        DataError: A file of the folder is missing or malformed; the message names file, reason and fix.
        ResourceError: There is not enough memory to decode an image.
        UsageError: A number is out of range, a choice or the reader is unknown, an image would become too small, or a camera
            model does not support a given map.
    """
    root, (factor, side) = Path(path), image_scale(downscale, max_side)
    given = [None if p is None else Path(p) for p in (depths, normals)]
    maps = MapOptions(given[0], given[1], depth_kind, depth_unit, normal_axes)
    options = ReadOptions(
        factor, strict, allow_outside, masks, mask_keeps, black_is_empty, max_pixels, max_side=side,
        lenses=lenses, maps=maps, on_image=_counted(root, progress),
    )  # fmt: skip
    try:
        _check_folder(root)
        chosen, notes = detect(root) if reader is None else (_accepted(root, find_reader(reader)), [])
        return _finished(root, chosen, chosen.read(root, options), notes, score_masks, options)
    except OSError as e:
        # folders without permission, names too long for the file system, disks that fail
        raise DataError(f"{e.filename or root}: cannot be read ({e.strerror or e}); fix its permissions or copy it") from e


def _counted(root: Path, progress: Callable[[str], object] | None) -> Callable[[Path], None]:
    """Return a function that reports the number of the image that is read next."""
    numbers = itertools.count(1)

    def on_image(file: Path) -> None:
        if progress is not None:
            progress(f"reading {root}: image {next(numbers)}")

    return on_image


def detect(root: Path) -> tuple[Reader, list[str]]:
    """Return the reader of the first complete format of a scene folder, and notes on the formats passed over.

    Raises:
        DataError: The folder contains no known format, or only an incomplete one; the message names the files to look for.
    """
    readers = all_readers()
    found = [(r, p) for r in readers if (p := r.probe(root)) is not None]
    complete = [r for r, p in found if not p.missing]
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
    if others:
        notes.append(f"the folder also holds {' and '.join(r.name for r in others)}: {taken.name} is used")
    return taken, notes


def _check_folder(root: Path) -> None:
    if root.is_file():
        raise DataError(f"{root}: is a file; give a folder of photographs, or of images with their cameras")
    if not root.is_dir():
        hint = similar_folder(root) or "give a folder of photographs, or of images with their cameras"
        raise DataError(f"{root}: no such folder; {hint}")


def _accepted(root: Path, reader: Reader) -> Reader:
    """Return a reader that the user chose; DataError where its format is not in the folder or not complete."""
    probe = reader.probe(root)
    if probe is None:
        others = [p.found for r in all_readers() if (p := r.probe(root)) is not None]
        there = f"; the folder holds {' and '.join(others)}" if others else ""
        wanted = f" ({reader.description})" if reader.description else ""
        raise DataError(f"{root}: the reader {reader.name} finds no scene of its format{wanted}{there}. Choose another reader")
    if probe.missing:
        raise DataError(f"{root}: {probe.found} lacks {probe.missing}. Copy the whole scene")
    return reader


def _finished(
    root: Path, reader: Reader, scene: Scene, notes: list[str], score_masks: str | Path | None, options: ReadOptions
) -> Scene:
    """Check a scene that a reader returned; return it sorted, in scene coordinates, with score masks and fingerprint."""
    own = f"the reader {reader.name} must return a Scene in file coordinates, without a Normalization; fix it"
    if not isinstance(scene, Scene):
        raise UsageError(own)
    scene = checked_scene(scene, f"{root}, ")
    if scene.normalization.scale != 1 or scene.normalization.offset.any():
        raise UsageError(own)
    views, points, more = list(scene.views), scene.points, scene.notes
    if len(views) < 2:
        reasons = f" ({'; '.join(more)})" if more else ""
        raise DataError(
            f"{root}: the scene has {len(views)} usable view{'s' if len(views) != 1 else ''}{reasons}; depth needs at least 2. "
            "Add images with cameras"
        )
    if options.black_is_empty and not any(scene.background):
        views, note = cut_from_black(views)
        more = (*more, note) if note else more
    more = (*more, *check_found(views, options.maps, options.allow_outside))
    n: Normalization = normalization_of(views, points, str(root))
    views = [normalize_view(v, n) for v in sorted(views, key=lambda v: v.name)]
    if points is not None:
        points = normalize_points(points, n, str(root))
    if score_masks is not None or (root / FOLDER).is_dir():
        # links in a folder that the user names must stay inside it; links in the scene's own folder, inside the scene
        masks, bound = (root / FOLDER, root) if score_masks is None else (Path(score_masks), Path(score_masks))
        plain = replace(options, mask_keeps="white", maps=NO_MAPS)
        views, note = add_score_masks(views, masks, SceneFolder(bound, plain))
        more = (*more, note)
    return replace(
        scene,
        path=str(root),
        format=reader.name,
        views=tuple(views),
        points=points,
        normalization=n,
        notes=(*notes, *more),
        fingerprint=fingerprint(views),
    )
