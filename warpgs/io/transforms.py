"""transforms.json scenes: nerfstudio, instant-ngp and Blender; camera-to-world matrices with OpenGL axes."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np

from warpgs.errors import DataError
from warpgs.io.images import SUFFIXES, Lens, decode, find_mask, load_photo
from warpgs.io.poses import from_camera_to_world
from warpgs.scene import Camera, PointCloud, View

BLENDER_FILES = tuple(f"transforms_{split}.json" for split in ("train", "val", "test"))
WHITE = (1.0, 1.0, 1.0)


def files_of(root: Path) -> list[Path]:
    """The JSON files of the scene: transforms.json, or Blender's three."""
    single = root / "transforms.json"
    return [single] if single.is_file() else [root / f for f in BLENDER_FILES if (root / f).is_file()]


def _reject_constant(name: str):
    raise ValueError(f"{name} is not a number that a camera can have")


def read_json(path: Path) -> dict:
    """Parsed file with a list of frames; DataError where it is malformed or holds NaN or Infinity."""
    try:
        values = json.loads(path.read_text("utf-8-sig"), parse_constant=_reject_constant)
    except (OSError, ValueError, RecursionError) as e:
        raise DataError(f"{path}: cannot be read ({e})") from e
    if not isinstance(values, dict) or not isinstance(values.get("frames"), list):
        raise DataError(f"{path}: has no list 'frames'; it is no transforms file")
    return values


def _resolve(root: Path, folder: Path, name: object, allow_outside: bool, where: str) -> Path:
    if not isinstance(name, str) or not name:
        raise DataError(f"{where}: a frame has no file_path")
    base = folder / name
    candidates = [base] if base.suffix.lower() in SUFFIXES else [base.with_name(base.name + s) for s in SUFFIXES]
    path = next((c for c in candidates if c.is_file()), candidates[0])
    if not allow_outside and not path.resolve().is_relative_to(root.resolve()):
        raise DataError(f"{where}: {name!r} leads out of the scene folder; move the file inside, or pass --allow-outside")
    return path


def _number(frame: dict, shared: dict, key: str) -> float | None:
    value = frame.get(key, shared.get(key))
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
        raise ValueError(f"{key} is {value!r}, not a finite number")
    return float(value)


def lens_of(frame: dict, shared: dict, raster: tuple[int, int], where: str) -> Lens:
    """Intrinsics of a frame, its own before the shared ones; ``raster`` is the image's width and height [px].

    Raises:
        DataError: There is no focal length, a number is not finite, or the lens model is not supported.
    """
    model = str(frame.get("camera_model", shared.get("camera_model", "OPENCV")))
    if model not in ("OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL"):
        raise DataError(f"{where}: camera model {model} is not supported; undistort the images to PINHOLE")
    try:
        width = _number(frame, shared, "w") or raster[0]
        height = _number(frame, shared, "h") or raster[1]
        fx, fy = _number(frame, shared, "fl_x"), _number(frame, shared, "fl_y")
        angle_x, angle_y = _number(frame, shared, "camera_angle_x"), _number(frame, shared, "camera_angle_y")
        cx, cy = _number(frame, shared, "cx"), _number(frame, shared, "cy")
        distortion = [_number(frame, shared, k) or 0.0 for k in ("k1", "k2", "p1", "p2", "k3")]
        if _number(frame, shared, "k4"):
            raise ValueError("k4 belongs to a fisheye or rational lens, which is not supported")
    except ValueError as e:
        raise DataError(f"{where}: {e}") from e
    if fx is None and angle_x:
        fx = 0.5 * width / math.tan(0.5 * angle_x)
    if fx is None:
        raise DataError(f"{where}: has neither fl_x nor camera_angle_x, so its focal length is unknown")
    if fy is None:
        fy = 0.5 * height / math.tan(0.5 * angle_y) if angle_y else fx
    if not (fx > 0 and fy > 0):
        raise DataError(f"{where}: focal lengths {fx}, {fy} must be positive")
    K = np.array([[fx, 0, width / 2 if cx is None else cx], [0, fy, height / 2 if cy is None else cy], [0, 0, 1.0]])
    return Lens(K, int(width), int(height), tuple(distortion) if any(distortion) else (), model)


def _frame_view(frame: dict, shared: dict, path: Path, name: str, where: str, options: dict) -> tuple[View, bool]:
    color, _ = decode(path)
    lens = lens_of(frame, shared, (color.shape[1], color.shape[0]), where)
    matrix = np.array(frame.get("transform_matrix"), dtype=object)
    try:
        matrix = matrix.astype(np.float64)
    except (TypeError, ValueError) as e:
        raise DataError(f"{where}: transform_matrix is not made of numbers") from e
    if matrix.shape not in ((3, 4), (4, 4)):
        raise DataError(f"{where}: transform_matrix must be [4, 4], not {list(matrix.shape)}")
    mask = options["mask"](frame, path)
    photo = load_photo(path, lens, downscale=options["downscale"], mask=mask, background=options["background"])
    viewmat = from_camera_to_world(matrix, where, opengl=True)
    camera = Camera(viewmat, photo.K, photo.image.shape[1], photo.image.shape[0])
    return View(name, camera, photo.image, photo.mask), bool(lens.distortion)


def load(
    root: Path, *, downscale: int, strict: bool, allow_outside: bool, invert_masks: bool
) -> tuple[list[View], PointCloud | None, list[str]]:
    """Read a scene folder with transforms.json, or Blender's transforms_train/val/test.json.

    Frames without a file are skipped and named in the notes; ``strict`` makes them an error. Transparent Blender images are
    put over white.

    Returns:
        Views in file coordinates with OpenCV axes, None for points, notes.

    Raises:
        DataError: A file is malformed, a path leads out of the folder, or (strict) an image is missing.
    """
    views, notes, missing, distorted, total = [], [], [], False, 0
    files = files_of(root)
    blender = files[0].name != "transforms.json"

    def mask_of(frame: dict, path: Path) -> np.ndarray | None:
        if "mask_path" in frame:
            mask_path = _resolve(root, root, frame["mask_path"], allow_outside, str(files[0]))
            return (decode(mask_path)[0][..., 0] > 0.5) != invert_masks
        inside = path.resolve().is_relative_to((root / "images").resolve())
        return find_mask(path, root / "images", invert_masks) if inside else None

    options = {"downscale": downscale, "background": WHITE if blender else None, "mask": mask_of}
    for file in files:
        shared = read_json(file)
        if shared.get("ply_file_path"):
            notes.append(f"the points of {shared['ply_file_path']} are not read")
        for i, frame in enumerate(shared["frames"]):
            where = f"{file}, frame {i}"
            if not isinstance(frame, dict):
                raise DataError(f"{where}: is no object")
            path = _resolve(root, file.parent, frame.get("file_path"), allow_outside, where)
            total += 1
            if not path.is_file():
                missing.append(str(frame["file_path"]))
                continue
            relative = path.resolve().is_relative_to(root.resolve())
            name = path.resolve().relative_to(root.resolve()).as_posix() if relative else path.as_posix()
            view, bent = _frame_view(frame, shared, path, name, f"{where} ({name})", options)
            views.append(view)
            distorted |= bent
    if missing:
        text = (
            f"{len(missing)} of {total} frames have no image file: {', '.join(missing[:5])}{' ...' if len(missing) > 5 else ''}"
        )
        if strict:
            raise DataError(f"{files[0]}: {text}. Restore them, or leave out --strict to go on without them")
        notes.append(f"skipped: {text}")
    if distorted:
        notes.append("lens distortion (OPENCV) undone")
    if downscale > 1:
        notes.append(f"images area-resampled by {downscale}")
    return sorted(views, key=lambda v: v.name), None, notes
