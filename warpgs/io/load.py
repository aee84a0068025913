"""From a folder to a `Scene`: detect, read, bring to the house coordinates, fingerprint."""

from __future__ import annotations

from pathlib import Path

from warpgs.errors import DataError, UsageError
from warpgs.io import colmap, dtu, llff, middlebury, transforms
from warpgs.io.detect import detect
from warpgs.io.folders import pixel_source
from warpgs.io.normalize import fingerprint, normalization_of, normalize_points, normalize_view
from warpgs.io.score_masks import FOLDER, add_score_masks
from warpgs.scene import Scene, View

READERS = {
    "colmap": colmap.load, "transforms": transforms.load, "llff": llff.load, "dtu": dtu.load, "middlebury": middlebury.load,
}  # fmt: skip


def load_scene(
    path: str | Path,
    *,
    downscale: int = 1,
    strict: bool = False,
    allow_outside: bool = False,
    invert_masks: bool = False,
    score_masks: str | Path | None = None,
) -> Scene:
    """Read a scene folder of any supported format.

    Views come sorted by name, undistorted and downscaled, in coordinates that are recentred and rescaled in float64
    (`Scene.normalization` leads back). Everything that was chosen on the way is in `Scene.notes`.

    Args:
        path: The scene folder.
        downscale: Factor by which both image sides shrink; a ready-made folder `images_N` is used where there is one.
        strict: A frame without an image file is an error instead of a note.
        allow_outside: Let the scene name image files outside its folder.
        invert_masks: White in a mask file removes a pixel instead of keeping it.
        score_masks: Folder with object masks for scoring, matched by image id; None for `idrmasks` in the scene folder where
            there is one.

    Returns:
        The scene.

    Raises:
        DataError: Anything in the folder is missing or malformed; the message names file, reason and remedy.
        UsageError: ``downscale`` is below 1.
    """
    if isinstance(downscale, bool) or not isinstance(downscale, int) or downscale < 1:
        raise UsageError(f"--downscale must be a whole number of at least 1, not {downscale!r}")
    options = {"downscale": downscale, "strict": strict, "allow_outside": allow_outside, "invert_masks": invert_masks}
    root = Path(path)
    try:
        return _read(root, options, score_masks)
    except OSError as e:
        # folders without permission, names too long for the file system, disks that fail
        raise DataError(f"{e.filename or root}: cannot be read ({e.strerror or e}); mend its permissions or copy it") from e


def _read(root: Path, options: dict, score_masks: str | Path | None) -> Scene:
    name, notes = detect(root)
    views, points, more = READERS[name](root, **options)
    if len(views) < 2:
        reasons = f" ({'; '.join(more)})" if more else ""
        raise DataError(
            f"{root}: the scene has {len(views)} usable view{'s' if len(views) != 1 else ''}{reasons}; depth needs at least 2. "
            "Add photographs with cameras"
        )
    _check_names(root, views)
    n = normalization_of(views, points)
    views = [normalize_view(v, n) for v in sorted(views, key=lambda v: v.name)]
    if points is not None:
        points = normalize_points(points, n)
    if score_masks is not None or (root / FOLDER).is_dir():
        views, note = add_score_masks(views, Path(score_masks) if score_masks is not None else root / FOLDER)
        more = [*more, note]
    blender = name == "transforms" and transforms.is_blender(root)
    return Scene(
        path=str(root),
        format=name,
        views=tuple(views),
        points=points,
        normalization=n,
        notes=(*notes, *more),
        fingerprint=fingerprint(views),
        background=transforms.WHITE if blender else (0.0, 0.0, 0.0),
        pixels=pixel_source(root, options["downscale"], name in ("colmap", "llff")),
    )


def _check_names(root: Path, views: list[View]) -> None:
    seen: set[str] = set()
    for v in views:
        if v.name in seen:
            raise DataError(f"{root}: the image {v.name!r} is listed twice; remove one of its cameras")
        seen.add(v.name)
