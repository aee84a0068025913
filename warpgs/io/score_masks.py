"""Object masks that limit where a render is scored, but hide nothing from the fit, as in DTU's published protocol."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from warpgs.errors import DataError
from warpgs.io.folders import SceneFolder
from warpgs.io.image_ids import image_ids, named_by_dtu
from warpgs.io.images import list_images
from warpgs.scene import View

FOLDER = "idrmasks"
"""Default subfolder of a scene: the name under which DTU's masks are published."""
ASPECT_TOLERANCE = 0.02
"""Largest relative difference of aspects: undistorted DTU images differ by about a percent from the originals' masks."""


def _by_id(files: list[Path], folder: Path) -> dict[int, Path]:
    ids = image_ids([f.name for f in files])
    if ids is None:
        raise DataError(f"{folder}: the masks have no distinct numbers; name them 000.png, 001.png, ... by id")
    return dict(zip(ids, files))


def _fit(path: Path, mask: np.ndarray, view: View) -> np.ndarray:
    import cv2

    height, width = view.image.shape[:2]
    ratio = (mask.shape[1] / mask.shape[0]) / (width / height)
    if not abs(ratio - 1) <= ASPECT_TOLERANCE:
        raise DataError(
            f"{path}: the mask is {mask.shape[1]} x {mask.shape[0]} px, its image {view.name} {width} x {height}: the "
            "aspects differ by more than two percent. Give the masks of these images"
        )
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

    Args:
        views: The scene's views, at their final size.
        folder: The folder with the masks; white keeps a pixel.
        scene: The scene folder that opens the masks.

    Returns:
        The views with ``score_mask`` set, inside the view's own mask where it has one, and a note for the user.

    Raises:
        DataError: No masks are found; a mask is missing (the message names the ids) or does not fit; or it is unclear whether
            the images count from 0 or from 1.
    """
    inner = folder / "mask"
    folder = inner if inner.is_dir() else folder
    files = list_images(folder) if folder.is_dir() else []
    if not files:
        raise DataError(f"{folder}: contains no masks; name the folder that contains 000.png, 001.png, ... with --score-masks")
    masks, ids = _by_id(files, folder), image_ids([v.name for v in views])
    if ids is None:
        raise DataError(
            f"{folder}: masks are matched by image id, but the images ({views[0].name}, ...) have no numbers that tell "
            "them apart; name them by id"
        )
    missing = sorted(set(ids) - set(masks))
    if missing:
        shown = ", ".join(map(str, missing[:8])) + (", ..." if len(missing) > 8 else "")
        raise DataError(
            f"{folder}: no mask for image id {shown} (ids are counted from 0; an image rect_001_... is id 0); the "
            f"masks run from {files[0].name} to {files[-1].name}. Restore the missing ones"
        )
    if min(ids) == 1 and 0 in masks and not named_by_dtu([v.name for v in views]):
        raise DataError(
            f"{folder}: the images start with 1 ({views[ids.index(1)].name}), the masks with 0, so the masks may be off by "
            f"one; rename the images so that they count from 0, or remove mask 0"
        )
    done = [replace(v, score_mask=_fit(masks[i], scene.mask(masks[i]) > 0.5, v)) for i, v in zip(ids, views)]
    return done, f"scores use only pixels inside the masks in {folder}, matched by image id; the fit ignores these masks"
