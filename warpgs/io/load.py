"""From a folder to a `Scene`: detect, read, bring to the house coordinates, fingerprint."""

from __future__ import annotations

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np

from warpgs.errors import DataError, UsageError
from warpgs.io import colmap, dtu, llff, middlebury, transforms
from warpgs.io.detect import detect
from warpgs.scene import Camera, Normalization, PointCloud, Scene, View

READERS = {
    "colmap": colmap.load, "transforms": transforms.load, "llff": llff.load, "dtu": dtu.load, "middlebury": middlebury.load,
}  # fmt: skip
SMALLEST_EXTENT = 1e-9
"""Camera sets smaller than this [file units] count as one place."""


def normalization_of(views: list[View], points: PointCloud | None) -> Normalization:
    """Put the mean camera centre at the origin and make 1.1 times the largest distance from it one unit.

    Where all cameras stand in one place, the points' median distance takes that role, else 1.
    """
    centers = np.array([v.camera.center for v in views])
    offset = centers.mean(0)
    extent = 1.1 * float(np.linalg.norm(centers - offset, axis=1).max())
    if extent < SMALLEST_EXTENT:
        far = np.linalg.norm(points.points - offset, axis=1) if points is not None and len(points) else np.ones(1)
        extent = max(float(np.median(far)), SMALLEST_EXTENT)
    return Normalization(offset, 1 / extent)


def _normalized(view: View, n: Normalization) -> View:
    viewmat = view.camera.viewmat.copy()
    viewmat[:3, 3] = n.scale * (viewmat[:3, :3] @ n.offset + viewmat[:3, 3])
    return replace(view, camera=replace(view.camera, viewmat=viewmat))


def fingerprint(views: list[View]) -> str:
    """SHA-256 over names, cameras and pixels."""
    digest = hashlib.sha256()
    for v in views:
        digest.update(v.name.encode("utf-8", "surrogateescape"))
        for array in (v.camera.viewmat, v.camera.K, v.image, *([] if v.mask is None else [v.mask])):
            digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()


def load_scene(
    path: str | Path, *, downscale: int = 1, strict: bool = False, allow_outside: bool = False, invert_masks: bool = False
) -> Scene:
    """Read a scene folder of any supported format.

    Views come sorted by name, undistorted and downscaled, in coordinates that are recentred and rescaled in float64
    (`Scene.normalization` leads back). Everything that was chosen on the way is in `Scene.notes`.

    Args:
        path: The scene folder.
        downscale: Factor by which both image sides shrink; a ready-made folder `images_N` is used where there is one.
        strict: A frame without an image file is an error instead of a note.
        allow_outside: Let a transforms.json name files outside the folder.
        invert_masks: White in a mask file removes a pixel instead of keeping it.

    Returns:
        The scene.

    Raises:
        DataError: Anything in the folder is missing or malformed; the message names file, reason and remedy.
        UsageError: ``downscale`` is below 1.
    """
    if downscale < 1:
        raise UsageError(f"--downscale must be at least 1, not {downscale}")
    root = Path(path)
    name, notes = detect(root)
    views, points, more = READERS[name](
        root, downscale=downscale, strict=strict, allow_outside=allow_outside, invert_masks=invert_masks
    )
    notes += more
    if len(views) < 2:
        raise DataError(
            f"{root}: the scene has {len(views)} usable view{'s' if len(views) != 1 else ''}; depth needs at least 2. Add photographs"
        )
    _check_names(root, views)
    n = normalization_of(views, points)
    views = [_normalized(v, n) for v in sorted(views, key=lambda v: v.name)]
    if points is not None:
        points = replace(points, points=n.scale * (points.points - n.offset))
    background = transforms.WHITE if name == "transforms" and not (root / "transforms.json").is_file() else (0.0, 0.0, 0.0)
    return Scene(str(root), name, tuple(views), points, n, tuple(notes), fingerprint(views), background)


def _check_names(root: Path, views: list[View]) -> None:
    seen: set[str] = set()
    for v in views:
        if v.name in seen:
            raise DataError(f"{root}: the image {v.name!r} is listed twice; remove one of its cameras")
        seen.add(v.name)


def scale_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same camera for another image size [px]."""
    K = np.diag([width / camera.width, height / camera.height, 1.0]) @ camera.K
    return Camera(camera.viewmat, K, width, height)
