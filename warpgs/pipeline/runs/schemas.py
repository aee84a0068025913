"""Schemas of the JSON of a run folder: config.json, the plain values of a checkpoint, metrics.json."""

from __future__ import annotations

from pathlib import PurePosixPath
from typing import Any

import numpy as np

from warpgs.constants import K_TOLERANCE, POSE_TOLERANCE, RULES
from warpgs.io.map_files import AXES
from warpgs.scene import DEPTH_KINDS
from warpgs.schema import (
    Schema,
    SchemaError,
    fields,
    flag,
    items,
    mapping,
    number,
    one_of,
    or_null,
    real,
    text,
    whole,
)

MAX_SIDE = 2**16
"""Largest width and height of a stored camera [px], far above those of any image."""
FOCAL_LENGTHS = 1e-9, 1e12
"""Least and largest focal length of a stored camera [px], or pixels per unit of an orthographic one."""
MAX_TRANSLATION = 1e12
"""Largest entry of the translation of a stored camera [u]: squares of distances stay finite in float32."""


def _view_name(value: Any, place: str) -> None:
    """Allow names of views: relative paths of files."""
    text(value, place)
    path = PurePosixPath(value)
    if path.is_absolute() or path.name in ("", "..") or ".." in path.parts:
        raise SchemaError(f"{place} must be the relative path of an image, not {value[:60]!r}")


def _matrix(rows: int) -> Schema:
    return items(items(number(), rows), rows)


def _intrinsics(value: Any, place: str) -> None:
    """Allow intrinsics without skew, as `rasterize` needs them."""
    _matrix(3)(value, place)
    fixed = ((0, 1, 0), (1, 0, 0), (2, 0, 0), (2, 1, 0), (2, 2, 1))
    if any(abs(value[i][j] - wanted) > K_TOLERANCE for i, j, wanted in fixed):
        raise SchemaError(f"{place} must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    least, most = FOCAL_LENGTHS
    if not all(least <= abs(value[i][i]) <= most for i in (0, 1)):
        raise SchemaError(f"{place} must have focal lengths from {least:g} to {most:g} px")


def _pose(value: Any, place: str) -> None:
    """Allow rigid poses, as `rasterize` needs them."""
    _matrix(4)(value, place)
    pose = np.array(value, np.float64)
    with np.errstate(over="ignore", invalid="ignore"):
        errors = [pose[:3, :3] @ pose[:3, :3].T - np.eye(3), pose[3:] - (0, 0, 0, 1)]
    near = np.abs(pose[:3, 3]).max() <= MAX_TRANSLATION
    if not (near and all(np.abs(e).max() <= POSE_TOLERANCE for e in errors)):  # also where products overflow
        raise SchemaError(
            f"{place} must be a rotation and a translation within {MAX_TRANSLATION:g}, without scale, above the row 0, 0, 0, 1"
        )


_CAMERA = fields(
    {"viewmat": _pose, "K": _intrinsics, "width": whole(1, MAX_SIDE), "height": whole(1, MAX_SIDE)},
    {"model": text, "distortion": items(number())},
    others=False,
)
_SCENE = fields(
    {
        "path": or_null(text), "split": or_null(text), "downscale": whole(1), "strict": flag, "allow_outside": flag,
        "masks": one_of("ignore", "cutout"), "mask_keeps": one_of("white", "black"), "black_is_empty": flag,
        "score_masks": or_null(text), "reader": or_null(text),
    },
    {
        "max_pixels": whole(1), "max_side": whole(0), "lenses": one_of("undistort", "native"),
        "depths": or_null(text), "normals": or_null(text), "depth_kind": one_of(*DEPTH_KINDS),
        "depth_unit": or_null(number(above=0)), "normal_axes": one_of(*AXES), "matcher": or_null(text),
    },
    others=False,
)  # fmt: skip
_PARTS = items(fields({"name": text}))
_RECORD = fields(
    {
        "scene": _SCENE, "fingerprint": text, "train": items(_view_name), "test": items(_view_name), "notes": items(text),
        "normalization": fields({"offset": items(number(), 3), "scale": number(above=0)}),
        "background": items(number(), 3), "config_hash": text, "device": text, "versions": mapping(text),
        "config": fields(
            {"rule": one_of(*RULES), "seed": whole(0), "strategy": text, "loss_terms": _PARTS, "view_modules": _PARTS},
            {"antialiased": flag},
        ),
        "cameras": mapping(_CAMERA, _view_name),
    },
    {"scene_format": text, "transparent": flag, "own_code": mapping(text), "pruned": fields({"source": text})},
)  # fmt: skip


def check_record(record: Any) -> None:
    """Check the contents of config.json.

    Raises:
        SchemaError: A value is missing or invalid.
    """
    _RECORD(record, "")
    if not record["train"]:
        raise SchemaError("train must name a view")
    for name in [*record["train"], *record["test"]]:
        if name not in record["cameras"]:
            raise SchemaError(f"cameras lacks the view {name[:60]!r}")


MODEL_STATE = fields({"step": whole(0)}, {"cameras": mapping(_CAMERA, _view_name)})
"""Schema of a checkpoint's plain values from which a model is read."""
_SHAPE = fields(
    {n: number(0) for n in ("largest", "largest_over_radius", "largest_over_extent", "largest_over_distance")}
    | {n: number(0) for n in ("needles", "needles_by_opacity", "thin")}
    | {"radius": number(above=0), "extent": number(above=0), "beyond": whole(0)}
)
_PHOTOGRAPH = fields({
    "name": _view_name, "compared_with": whole(0), "sharpness": or_null(number(0)), "brightness": or_null(number(0)),
    "channels": or_null(items(number(0), 3)), "moved": or_null(number(0)),
})  # fmt: skip
_COVERED = mapping(
    fields({
        "pixels": whole(0), "share_of_pixels": number(0), "share_of_error": number(0), "psnr": or_null(real),
        "ssim": or_null(real), "expected_psnr": or_null(real),
    }),
    one_of("0", "1", "2+", "background"),
)  # fmt: skip
OPACITY = ("psnr_whole", "psnr_foreground", "alpha_empty", "alpha_object")
"""Scores of views with an alpha channel, defined in `warpgs.pipeline.metrics.evaluate`."""
METRICS = fields(
    {
        "test": mapping(or_null(real)), "train": mapping(or_null(real)),
        "views": items(fields({"name": text, "psnr": or_null(real)}, dict.fromkeys(OPACITY, or_null(real)))),
        "variants": mapping(text), "config_hash": text, "steps": whole(0),
        "protocol": fields({
            "split": text, "training_views": whole(0), "held_out_views": whole(0), "ground_truth": text,
            "resolution": items(text), "score_masks": whole(0),
        }),
    },
    {
        "gaussians": whole(0), "batch": whole(1), "ranks": whole(1), "seconds": fields({"total": number(0)}), "shape": _SHAPE,
        "photographs": items(_PHOTOGRAPH),
        "view_modules": mapping(fields({"summary": text})),
        "coverage": fields({
            "classes": _COVERED, "views": items(fields({"name": text, "classes": _COVERED})), "tolerance": number(0),
            "depth_differences": items(number(0)), "photo_psnr": or_null(items(or_null(real))), "summary": text,
        }),
    },
)  # fmt: skip
"""Schema of metrics.json and of eval.json."""
