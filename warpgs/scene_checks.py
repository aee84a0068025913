"""Checks of scenes made in Python or by a reader: every field of views, cameras, maps and points, once, before they are used.

A correct scene is returned as the same object. Tensors, other float types and strides of images, maps and points are converted
to what the fields of `warpgs.scene` ask for. Anything else is a `DataError` that names the view, the field and the fix.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sized
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from warpgs.constants import K_TOLERANCE, POSE_TOLERANCE
from warpgs.errors import DataError
from warpgs.scene import DEPTH_KINDS, Camera, GivenDepth, Normalization, PointCloud, Scene, View

Record = TypeVar("Record", Camera, GivenDepth, View, PointCloud, Normalization, Scene)
SLACK = 1e-3
"""Accepted distance of a value from its range, a quarter of an 8-bit level: resampling and rounding may overshoot."""
MOST = float(np.finfo(np.float32).max)
"""Largest depth, and largest scale."""
COEFFICIENTS = {"pinhole": 0, "orthographic": 0, "opencv": 8, "fisheye": 4}
"""Number of coefficients of distortion by camera model; a model of the user's own is checked when it is rendered."""
MIN_FOCAL = 0.01
"""Smallest focal length of a pinhole in image sides: 179 degrees. Smaller ones are usually not in pixels."""
INTRINSICS = "give [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels"


def checked_scene(scene: Scene, where: str = "") -> Scene:
    """Return a scene whose fields are all valid.

    Raises:
        DataError: A field is invalid; the message starts with ``where``.
    """
    of = f"{where}scene."
    for name in ("path", "format", "fingerprint", "pixels"):
        _check(of + name, getattr(scene, name), str, "give a str, '' if unknown")
    for name in ("views", "notes"):
        _check(of + name, getattr(scene, name), (tuple, list), f"give a tuple, ({name[:-1]}, ...)")
    for i, note in enumerate(scene.notes):
        _check(f"{of}notes[{i}]", note, str, "give str(note)")
    views, points, background, n = checked_views(scene.views, where), scene.points, scene.background, scene.normalization
    twice = [name for name, count in Counter(v.name for v in views).items() if count > 1]
    if twice:
        raise DataError(f"{where}view {twice[0]!r}: name must be unique; got two views of this name; rename or remove one")
    if points is not None:
        points = _checked_points(f"{of}points", points, {v.name for v in views})
    numbers = isinstance(background, (tuple, list)) and all(isinstance(c, (int, float, np.number)) for c in background)
    given = np.asarray(background, np.float64) if numbers else background
    colors = _numbers(f"{of}background", given, (3,), "give (red, green, blue)", kind=np.float64)
    _check(f"{of}normalization", n, Normalization, "give Normalization(offset, scale)")
    offset = _numbers(f"{of}normalization.offset", n.offset, (3,), "give three numbers", -math.inf, math.inf, np.float64)
    if not (isinstance(n.scale, (int, float, np.number)) and 0 < n.scale <= MOST):
        raise _wrong(f"{of}normalization.scale", "a number above 0", repr(n.scale), "give scene units per file unit, or 1.0")
    return _with(
        scene,
        views=scene.views if [*map(id, scene.views)] == [*map(id, views)] else tuple(views),
        notes=tuple(scene.notes),
        points=points,
        background=background if isinstance(background, tuple) else tuple(map(float, colors)),
        normalization=_with(n, offset=offset),
    )


def checked_views(views: Iterable[View], where: str = "") -> list[View]:
    """Return views whose fields are all valid, in their order.

    Raises:
        DataError: A field is invalid; the message starts with ``where``.
    """
    if isinstance(views, (View, Scene, np.ndarray)) or not isinstance(views, Iterable):
        fix = "give scene.views" if isinstance(views, Scene) else "give [view]"
        raise _wrong(f"{where}views", "a list of View", type(views).__name__, fix)
    return [_checked_view(f"{where}views[{i}]", v, where) for i, v in enumerate(views)]


def _checked_view(what: str, view: View, where: str) -> View:
    """Return a valid view; ``what`` names it until its own name is known."""
    _check(what, view, View, "give View(name, camera, image)")
    _check(f"{what}.name", view.name, str, "give str(name)")
    if not view.name:
        raise _wrong(f"{what}.name", "the path of its image", "''", "give each view its own, such as 'a.png'")
    of = f"{where}view {view.name!r}: "
    camera = _checked_camera(f"{of}camera", view.camera)
    size, depth, alpha, normals = (camera.height, camera.width), view.depth, view.alpha, view.normals
    image = _numbers(f"{of}image", view.image, (*size, 3))
    masks = {name: _checked_mask(of + name, getattr(view, name), size) for name in ("mask", "score_mask")}
    if alpha is not None:
        alpha = _numbers(f"{of}alpha", alpha, size)
    _check(f"{of}alpha_estimated", view.alpha_estimated, (bool, np.bool_), "give True or False")
    if depth is not None:
        _check(f"{of}depth", depth, GivenDepth, "give GivenDepth(depth)")
        if not isinstance(depth.kind, str) or depth.kind not in DEPTH_KINDS:
            fix = f"give {', '.join(DEPTH_KINDS[:-1])} or {DEPTH_KINDS[-1]}"
            raise _wrong(f"{of}depth.kind", "the meaning of the values", repr(depth.kind), fix)
        sure = depth.confidence
        sure = None if sure is None else _numbers(f"{of}depth.confidence", sure, size)
        depth = _with(depth, values=_numbers(f"{of}depth.values", depth.values, size, high=MOST), confidence=sure)
    if normals is not None:
        normals = _checked_normals(f"{of}normals", normals, camera)
    return _with(view, camera=camera, image=image, **masks, alpha=alpha, depth=depth, normals=normals)


def _checked_camera(what: str, camera: Camera) -> Camera:
    """Return a valid camera of one view, with numpy arrays."""
    _check(what, camera, Camera, "give Camera(viewmat, K, width, height)")
    for name in ("width", "height"):
        pixels = getattr(camera, name)
        if not isinstance(pixels, (int, np.integer)) or isinstance(pixels, bool) or not 1 <= pixels < 2**31:
            raise _wrong(f"{what}.{name}", "a whole number of pixels", repr(pixels), f"give int({name}), at least 1")
    _check(f"{what}.model", camera.model, str, "give its name, such as 'pinhole'")

    def matrix(name: str, value: Any, shape: tuple[int, ...], fix: str) -> np.ndarray:
        return _numbers(f"{what}.{name}", value, shape, fix, -math.inf, math.inf, None)

    viewmat = matrix("viewmat", camera.viewmat, (4, 4), "give camera_from_world, [R t] above the row 0, 0, 0, 1")
    K, R, row = matrix("K", camera.K, (3, 3), INTRINSICS), viewmat[:3, :3].astype(np.float64), viewmat[3]
    with np.errstate(over="ignore", invalid="ignore"):
        off = float(np.abs(R @ R.T - np.eye(3)).max())
    for good, needs, got, fix in (
        (
            np.abs(row - (0, 0, 0, 1)).max() <= POSE_TOLERANCE,
            "a pose above 0, 0, 0, 1",
            row.tolist(),
            "transpose it: viewmat.T",
        ),
        (off <= POSE_TOLERANCE, "rigid", f"R R^T off by {off:.2g} from the identity", "divide its scale out of R and t"),
        (np.linalg.det(R) > 0, "a rotation", "a mirrored pose (determinant -1)", "for OpenGL axes, negate rows y and z"),
    ):
        if not good:
            raise _wrong(f"{what}.viewmat", needs, str(got), fix)
    if not max(abs(K[0, 1]), abs(K[1, 0]), *np.abs(K[2] - (0, 0, 1))) <= K_TOLERANCE:
        raise _wrong(
            f"{what}.K",
            "without skew, above 0, 0, 1",
            str(K.tolist()),
            f"divide K by K[2, 2], or undistort skewed images; {INTRINSICS}",
        )
    focal, sides = np.abs([K[0, 0], K[1, 1]]), np.array([camera.width, camera.height])
    if not focal.all() or (camera.model in ("pinhole", "opencv") and (focal < MIN_FOCAL * sides).any()):
        fix = "multiply normalised intrinsics by width (first row) and height (second row)"
        raise _wrong(f"{what}.K", "in pixels", f"focal lengths {K[0, 0]:g} and {K[1, 1]:g}", fix)
    lens, count = camera.distortion, COEFFICIENTS.get(camera.model)
    if count == 0 and lens is not None:
        raise _wrong(f"{what}.distortion", f"None for model {camera.model}", "a value", "give None, or model='opencv'")
    if count:
        given = np.zeros(0) if lens is None else lens
        lens = matrix("distortion", given, (count,), f"give {count} coefficients, np.zeros({count}) for an ideal lens")
    return _with(camera, viewmat=viewmat, K=K, distortion=lens)


def _checked_mask(what: str, value: Any, shape: tuple[int, int]) -> np.ndarray | None:
    """Return a valid mask as a contiguous array, the same object if it is one; None for None."""
    if value is None:
        return None
    noun, needs = what.rpartition(" ")[2], f"bool, True where used, shape {list(shape)}"
    mask = _plain(what, value, needs, f"np.asarray({noun}) > 0")
    if mask.shape != shape:
        raise _wrong(what, needs, f"shape {list(mask.shape)}", _shape_fix(noun, mask.shape, shape))
    if mask.dtype != bool:
        raise _wrong(what, needs, f"{mask.dtype}", f"give {noun} > 0")
    if not mask.any():
        raise _wrong(what, needs, "False everywhere", f"give ~{noun} if it is inverted, else None")
    return np.ascontiguousarray(mask)


def _checked_normals(what: str, value: Any, camera: Camera) -> np.ndarray:
    """Return valid normals of a camera [H, W, 3]: at most of length 1, most of them towards the camera."""
    normals = _numbers(what, value, (camera.height, camera.width, 3), low=-1)
    squares = np.einsum("...i,...i", normals, normals)
    if squares.max() > (1 + 10 * SLACK) ** 2:
        fix = "divide normals by their length; decode colours first, 2 * normals - 1"
        raise _wrong(what, "unit vectors, or 0 where missing", f"a length of {math.sqrt(squares.max()):.4g}", fix)
    if camera.model == "pinhole":
        K, x, y = camera.K, np.arange(0, camera.width, 4) + 0.5, np.arange(0, camera.height, 4)[:, None] + 0.5
        part = normals[::4, ::4]  # enough for a fraction of the pixels
        along = part[..., 0] * ((x - K[0, 2]) / K[0, 0]) + part[..., 1] * ((y - K[1, 2]) / K[1, 1]) + part[..., 2]
        if np.count_nonzero(along > 0) > 0.5 * np.count_nonzero(squares[::4, ::4]):
            fix = "for OpenGL axes, give normals * np.float32([1, -1, -1])"
            raise _wrong(what, "turned towards the camera, in OpenCV axes", "most of them facing away", fix)
    return normals


def _checked_points(what: str, cloud: PointCloud, names: set[str]) -> PointCloud:
    """Return a valid point cloud; ``names`` are those of the views."""
    _check(what, cloud, PointCloud, "give PointCloud(points, colors)")
    xyz, tracks, unbounded = cloud.points, cloud.tracks, (-math.inf, math.inf, np.float64)
    count = len(xyz) if isinstance(xyz, Sized) and getattr(xyz, "shape", True) else 0  # 0 for an array without axes
    points = _numbers(f"{what}.points", xyz, (count, 3), "give a row x, y, z for each point", *unbounded)
    colors = _numbers(f"{what}.colors", cloud.colors, (count, 3), "give a row r, g, b for each point")
    if tracks is not None:
        _check(f"{what}.tracks", tracks, (tuple, list), "give a frozenset of view names for each point, or None")
        seen = set().union(*tracks) if all(isinstance(t, (set, frozenset)) for t in tracks) else None
        if seen is None or len(tracks) != count or (seen and not seen & names):
            needs, got = f"{count} sets of View.name", f"{len(tracks)}, such as {next(iter(tracks), None)!r}"
            raise _wrong(f"{what}.tracks", needs, got, "give a frozenset of view names for each point, or None")
    return _with(cloud, points=points, colors=colors)


def _numbers(
    what: str, value: Any, shape: tuple[int, ...], fix: str = "", low: float = 0.0, high: float = 1.0, kind: Any = np.float32
) -> np.ndarray:
    """Return an array in [low, high] as a contiguous array of a ``kind``, the same object if it is one.

    If ``kind`` is None, float32 and float64 stay as they are.
    """
    noun = what.rpartition(" ")[2]
    span = "finite" if high == math.inf else "finite, at least 0" if high == MOST else f"in [{low:g}, {high:g}]"
    needs = f"{np.dtype(kind)}, {span}, shape {list(shape)}"  # float64 for None
    array = _plain(what, value, needs, f"np.asarray({noun}, np.{np.dtype(kind)})")
    if array.shape != shape:
        raise _wrong(what, needs, f"shape {list(array.shape)}", fix or _shape_fix(noun, array.shape, shape))
    real = array.dtype in (np.float32, np.float64) if kind is None else array.dtype.kind == "f"
    least, most = (float(array.min()), float(array.max())) if array.size and array.dtype.kind in "fiu" else (0, 0)
    if not (real and low - SLACK <= least and most <= high + SLACK and math.isfinite(least) and math.isfinite(most)):
        got = f"{array.dtype} from {least:.6g} to {most:.6g}" if array.dtype.kind in "fiu" else f"{array.dtype}"
        raise _wrong(what, needs, got, _value_fix(noun, real, least, most, low, high))
    return array if kind is None else np.ascontiguousarray(array, kind)


def _plain(what: str, value: Any, needs: str, fix: str) -> np.ndarray:
    """Return a numpy array, or a tensor as one; readers know no torch, so tensors are recognised by their methods."""
    if hasattr(value, "detach") and hasattr(value, "numpy"):
        try:
            return np.asarray(value.detach().cpu().numpy())
        except (TypeError, RuntimeError) as e:  # bfloat16, sparse
            raise _wrong(what, needs, f"a tensor of {value.dtype}", "give a dense tensor, or .float()") from e
    if isinstance(value, np.ma.MaskedArray):
        raise _wrong(what, needs, "MaskedArray", f"give {what.rpartition(' ')[2]}.data, and its mask as View.mask")
    if not isinstance(value, np.ndarray):
        raise _wrong(what, needs, type(value).__name__, "give an array" if value is None else f"give {fix}")
    return value


def _check(what: str, value: object, kind: type | tuple[type, ...], fix: str) -> None:
    """Check that a value is of a type."""
    if not isinstance(value, kind):
        name = kind[0].__name__ if isinstance(kind, tuple) else kind.__name__
        raise _wrong(what, f"of type {name}", type(value).__name__, fix)


def _wrong(what: str, needs: str, got: str, fix: str) -> DataError:
    """Return the error for the field ``what``."""
    return DataError(f"{what} must be {needs}; got {got}; {fix}")


def _with(record: Record, **fields: Any) -> Record:
    """Return a record with other fields; the same object if all of them are the same."""
    changed = {name: value for name, value in fields.items() if value is not getattr(record, name)}
    return replace(record, **changed) if changed else record


def _value_fix(noun: str, real: bool, least: float, most: float, low: float, high: float) -> str:
    """Return the fix for an array of another type, or with values from ``least`` to ``most`` outside of [low, high]."""
    if not math.isfinite(least + most):
        replaced = f"replace NaN and infinity: np.nan_to_num({noun}, posinf=0, neginf=0)"
        return "estimate it again, or remove what is not finite" if high == math.inf else replaced
    if not real and low == -1:
        return f"decode colours: {noun} / np.float32(127.5) - 1"
    if not real and high == MOST:
        return f"give {noun} * np.float32(unit); unit is 0.001 for millimetres if cameras are in metres"
    if high == 1 and least >= low and most > (16 if real else 1):
        full = 255 if most <= 256 else 65535
        return f"divide by its full scale, such as {full}" if real else f"divide by {full}: {noun}.astype(np.float32) / {full}"
    if not real:
        return f"give {noun}.astype(np.float{64 if high == math.inf else 32})"
    if low == 0 and high == 1 and least < -0.1:
        return f"undo its normalisation, such as ({noun} + 1) / 2 for [-1, 1]"
    return f"set missing values to 0: np.maximum({noun}, 0)" if high == MOST else f"clip it: np.clip({noun}, {low:g}, {high:g})"


def _shape_fix(noun: str, found: tuple[int, ...], shape: tuple[int, ...]) -> str:
    """Return the fix for an array of another shape than the camera's [H, W] or [H, W, 3]."""
    size, color = shape[:2], len(shape) == 3
    if found[:2] == size and len(found) == 3:
        return f"give {noun}[..., :3], and opacity as alpha" if color and found[2] > 3 else f"keep one channel: {noun}[..., 0]"
    if color and found in (size, (1, *size)):
        return f"repeat the gray: np.repeat({noun}.reshape({size[0]}, {size[1]}, 1), 3, -1)"
    if found[1:3] == size:
        return f"give {noun}[0]" if found[0] == 1 else f"put channels last: np.moveaxis({noun}, 0, -1)"
    if found[:2] == size[::-1]:
        return f"transpose it, np.swapaxes({noun}, 0, 1), or swap camera.width and camera.height"
    return f"resize it to the camera's {size[1]} x {size[0]} px, or scale width, height and K of the camera to the image"
