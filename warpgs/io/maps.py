"""Maps beside the photographs: depth, normals and masks that the user gives."""

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from warpgs.errors import DataError, UsageError, expect, explained
from warpgs.files import inside, read_input
from warpgs.geometry import CENTRAL
from warpgs.io.image_files import BYTES_PER_PIXEL, EXTRA_FILE_BYTES, MAX_PIXELS, decode_png
from warpgs.io.images import LoadedImage, ReadOptions, turn_upright, undistortion_maps
from warpgs.scene import GivenDepth, View

SUFFIXES = (".png", ".npy")
NONE = "none"
"""Value in place of a folder, to ignore maps."""
CONFIDENCE = ".confidence"
"""Ending of a confidence map's file name, before its suffix."""
MILLIMETRES = 0.001
"""Default length of a unit of integers: RGB-D cameras store depth in millimetres, with poses in metres."""
MAX_DEPTH = 1e12
"""Largest depth [file units]; maps with larger values are rejected."""
UNIT_TOLERANCE = 0.1
"""Largest difference of a normal's length from 1; eight bits round by less than 0.01."""
NO_NORMAL = 0.5
"""Length below which a vector counts as missing, such as gray in an image of normals."""
MAX_STRAY = 0.05
"""Largest fraction of a map's normals that may have another length, or face away from the camera."""


def map_files(folder: Path, flag: str, allow_outside: bool) -> dict[str, Path]:
    """Return the maps of a folder by the names of their images; links in it point outside only with ``allow_outside``."""
    if not folder.is_dir():
        raise DataError(f"{folder}: no such folder; name the folder of maps with {flag}")
    files: dict[str, Path] = {}
    for file in sorted(folder.rglob("[!.]*")):
        if file.suffix.lower() in SUFFIXES and file.is_file():
            key = file.relative_to(folder).with_suffix("").as_posix()
            if key in files:
                raise DataError(f"{file}: {files[key].name} is for the same image; remove one of them")
            files[key] = file if allow_outside else inside(file, folder, "the folder of maps")
    if all(key.endswith(CONFIDENCE) for key in files):
        raise DataError(f"{folder}: holds no maps; add NPY (float32) or 16-bit PNG, named like the images")
    return files


def _find(files: dict[str, Path], image: Path) -> tuple[Path | None, Path | None]:
    """Return the files of map and confidence of an image; None for a missing one.

    A map is named by the end of the image's path: for `a/b.jpg` it is `a/b.png` or `b.png`; the longest match is used.
    """
    for i in range(1 if image.is_absolute() else 0, len(image.parts)):
        tail = PurePosixPath(*image.parts[i:])
        for key in (tail.with_suffix("").as_posix(), tail.as_posix()):
            if key in files and not key.endswith(CONFIDENCE):
                return files[key], files.get(key + CONFIDENCE)
    return None, None


def read_array(path: Path, most: int, fix: str) -> np.ndarray:
    """Return the array of an NPY file of at most ``most`` bytes."""
    with explained(f"{path}: cannot be read as a numpy array", fix, Exception):  # numpy raises a dozen types
        found = np.load(io.BytesIO(read_input(path, most)), allow_pickle=False)
    if not isinstance(found, np.ndarray):
        raise DataError(f"{path}: is an archive of arrays, not one array; {fix}")
    return found


def read_numbers(path: Path, max_pixels: int = MAX_PIXELS) -> np.ndarray:
    """Return the numbers of a PNG or NPY file, uint8, uint16 or float32, shape [H, W] or [H, W, C]."""
    if path.suffix.lower() != ".npy":
        return decode_png(path, max_pixels)
    found = read_array(path, BYTES_PER_PIXEL * max_pixels + EXTRA_FILE_BYTES, "save the map alone")
    if found.dtype.kind not in "fu" or found.dtype.itemsize > 8:
        raise DataError(f"{path}: its numbers are {found.dtype}; save float32, or uint16 in millimetres")
    while found.ndim > 2 and found.shape[0] == 1:
        found = found[0]
    if found.ndim not in (2, 3) or 0 in found.shape or (found.ndim == 3 and found.shape[2] > 4):
        raise DataError(f"{path}: must be an array [height, width] or [height, width, 3], not {list(found.shape)}")
    if found.shape[0] * found.shape[1] > max_pixels:
        raise DataError(f"{path}: has more than {max_pixels:,} pixels; shrink it, or raise --max-pixels")
    native = found.dtype.newbyteorder("=")
    with np.errstate(over="ignore", invalid="ignore"):
        return found.astype(native if native in (np.uint8, np.uint16) else np.float32)


def _gray(path: Path, raw: np.ndarray, what: str) -> np.ndarray:
    """Return the one channel of a map [H, W]; a gray map may be stored in three equal channels."""
    if raw.ndim == 2:
        return raw
    if raw.shape[2] == 1 or (raw.shape[2] == 3 and (raw == raw[..., :1]).all()):
        return raw[..., 0]
    raise DataError(f"{path}: is a colour image of {raw.shape[2]} channels, not a {what}; save NPY or gray 16-bit PNG")


def read_depth(path: Path, options: ReadOptions) -> np.ndarray:
    """Return a depth map in units of the cameras, or in unknown units if relative; float32 [H, W], 0 for missing values."""
    raw = _gray(path, read_numbers(path, options.max_pixels), "depth map")
    metric = options.depth_kind == "metric"
    if raw.dtype == np.uint8 and metric:
        raise DataError(f"{path}: has 8 bits, too few for metric depth; save 16, or give --depth-kind relative or disparity")
    values = np.where(np.isfinite(raw), raw, 0).astype(np.float32)
    if metric:
        with np.errstate(over="ignore"):
            values = values * np.float32(options.depth_unit or (MILLIMETRES if raw.dtype.kind == "u" else 1.0))
    with explained(f"{path}: no depth map", "write it again with 0 for gaps, or remove it: maps are optional", ValueError):
        expect(values.any(), "all values are 0 or not finite")
        expect(values.min() >= 0, f"{int((values < 0).sum()):,} depths are negative, down to {values.min():.4g}")
        expect(values.max() < MAX_DEPTH, f"depths go up to {values.max():.4g}, beyond {MAX_DEPTH:.0e}")
    return values


def read_confidence(path: Path, shape: tuple[int, ...], max_pixels: int = MAX_PIXELS) -> np.ndarray:
    """Return a map of confidence in [0, 1], float32 [H, W], of the ``shape`` of its depth map.

    uint8 and uint16 maps are divided by 2 if they hold only the levels 0, 1 and 2, else by the largest value of their type.
    """
    raw = _gray(path, read_numbers(path, max_pixels), "map of confidence")
    if raw.shape != shape:
        raise DataError(f"{path}: is {raw.shape[1]} x {raw.shape[0]} px, its depth map {shape[1]} x {shape[0]}; resize one")
    values = raw.astype(np.float32)
    if raw.dtype.kind == "u":
        values /= 2 if 0 < int(raw.max()) <= 2 else np.iinfo(raw.dtype).max
    if not ((values >= 0) & (values <= 1)).all():
        raise DataError(f"{path}: confidence must be in [0, 1], but ranges from {values.min():.4g} to {values.max():.4g}")
    return values


def read_normals(path: Path, options: ReadOptions) -> np.ndarray:
    """Return unit normals in the camera's axes (x right, y down, z forward), float32 [H, W, 3]; 0 for missing values."""
    raw = read_numbers(path, options.max_pixels)
    if raw.ndim != 3 or raw.shape[2] != 3:
        raise DataError(f"{path}: is {list(raw.shape)}, not of three channels; save RGB (n + 1) / 2, or NPY [height, width, 3]")
    black = (raw == 0).all(-1)
    values = raw.astype(np.float32)
    if raw.dtype.kind == "u":
        values = values * np.float32(2 / np.iinfo(raw.dtype).max) - 1
    usable = np.isfinite(values).all(-1) & ~black
    with np.errstate(over="ignore"):
        lengths = np.linalg.norm(np.where(usable[..., None], values, 0), axis=-1)
    known = usable & (lengths >= NO_NORMAL)
    with explained(f"{path}: no normals", "save (n + 1) / 2 as PNG, or n as NPY, or remove it: maps are optional", ValueError):
        expect(known.any(), "every pixel is black, not finite or short")
        stray = float((~(np.abs(lengths[known] - 1) <= UNIT_TOLERANCE)).mean())
        expect(stray <= MAX_STRAY, f"{stray:.0%} of its vectors are not unit normals")
    known &= np.abs(lengths - 1) <= UNIT_TOLERANCE
    normals = np.where(known[..., None], values / np.where(known, lengths, 1)[..., None], 0).astype(np.float32)
    if options.normal_axes == "opengl":
        normals = normals * np.array([1, -1, -1], np.float32)
    return normals


SAME_SURFACE = 0.05
"""Largest relative difference between neighbours that are taken for one surface when a map is enlarged."""


def resized(values: np.ndarray, width: int, height: int) -> np.ndarray:
    """Return a map [H, W] or [H, W, C] at another size; 0 marks missing values.

    In a reduced map, a pixel takes the known value nearest to its centre, which keeps sparse depths. An enlarged map is
    interpolated between known neighbours on one surface; elsewhere a pixel takes the nearest value.
    """
    import cv2

    rows, columns = values.shape[:2]
    if (rows, columns) == (height, width):
        return values
    if height * width >= rows * columns:
        nearest = cv2.resize(values, (width, height), interpolation=cv2.INTER_NEAREST)
        known = (values != 0) if values.ndim == 2 else (values != 0).any(-1)
        between = cv2.resize(values, (width, height), interpolation=cv2.INTER_LINEAR)
        whole = cv2.resize(known.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR) > 1 - 1e-6
        off = np.abs(between - nearest)
        off, size = (off, np.abs(nearest)) if values.ndim == 2 else (off.max(-1), np.ones((height, width), np.float32))
        smooth = whole & (off <= SAME_SURFACE * size)
        return np.where(smooth if values.ndim == 2 else smooth[..., None], between, nearest)
    at = np.nonzero(values if values.ndim == 2 else values.any(-1))
    row, column = (np.asarray((i + 0.5) * new / old) for i, new, old in zip(at, (height, width), (rows, columns)))
    i, j = np.minimum(row.astype(int), height - 1), np.minimum(column.astype(int), width - 1)
    order = np.argsort(-((row - i - 0.5) ** 2 + (column - j - 0.5) ** 2), kind="stable")  # the nearest is written last
    found = np.zeros((height, width, *values.shape[2:]), values.dtype)
    found[i[order], j[order]] = values[at[0][order], at[1][order]]
    return found


def in_pixels_of(loaded: LoadedImage, values: np.ndarray, path: Path) -> np.ndarray:
    """Rotate, undistort and resize a map like its image; the result has shape [h, w] or [h, w, C] of the image's final size."""
    import cv2

    height, width = loaded.full_size
    rows, columns = values.shape[:2]
    if loaded.orientation in (5, 6, 7, 8) and _same_aspect(values.shape, (width, height)):
        if values.ndim == 3:
            raise DataError(f"{path}: EXIF rotates its image, and normals are not rotated with it; save both upright")
        values = turn_upright(values, loaded.orientation)
    elif not _same_aspect(values.shape, (height, width)):
        raise DataError(f"{path}: is {columns} x {rows} px, its image {width} x {height}; give a map of the whole image")
    final = loaded.image.shape[:2]
    if loaded.undone is not None:
        values = resized(values, width, height)
        K = np.diag([width / final[1], height / final[0], 1.0]) @ loaded.K
        columns_of, rows_of = undistortion_maps(K, loaded.undone, width, height)
        values = cv2.remap(values, columns_of, rows_of, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    values = resized(values, final[1], final[0])
    if loaded.mask is not None:
        values = np.where(loaded.mask if values.ndim == 2 else loaded.mask[..., None], values, 0)
    return np.ascontiguousarray(values, np.float32)


def _same_aspect(shape: tuple[int, ...], size: tuple[int, int]) -> bool:
    """Return True where a raster has the aspect of a size (height, width), within a pixel of the smaller one."""
    return abs(shape[1] * size[0] - shape[0] * size[1]) <= max(*size, *shape[:2])


DEPTHS, NORMALS = "--depths", "--normals"


@dataclass(frozen=True)
class NamedMaps:
    """Maps that the files of a scene name for an image."""

    depth: Path | None = None
    """Depth map."""
    normals: Path | None = None
    """Normal map."""
    unit: float | None = None
    """Length of one unit of the depth map in units of the cameras, if the scene specifies it."""


NOTHING_NAMED = NamedMaps()
"""No maps."""


class GivenMaps:
    """Depth and normal maps of a scene, from the folders that the user names or the files that the scene names."""

    def __init__(self, options: ReadOptions):
        """List the files of the folders in ``options``."""
        self.options = options
        named = (options.depths, DEPTHS), (options.normals, NORMALS)
        outside = options.allow_outside
        self.depths, self.normals = ({} if p in (None, NONE) else map_files(Path(p), flag, outside) for p, flag in named)

    def attached(self, loaded: LoadedImage, image: Path, named: NamedMaps = NOTHING_NAMED) -> LoadedImage:
        """Return an image with its maps, at the image's size; the user's folder has priority over maps named in the scene."""
        depth, confidence, options = named.depth, None, self.options
        if options.depths is not None:
            depth, confidence = _find(self.depths, image)
        elif depth is not None and options.depth_unit is None:
            options = replace(options, depth_unit=named.unit)
        normals = named.normals if options.normals is None else _find(self.normals, image)[0]
        if depth is not None:
            loaded = replace(loaded, depth=self._depth(loaded, depth, confidence, options))
        return loaded if normals is None else replace(loaded, normals=self._normals(loaded, normals))

    def _depth(self, loaded: LoadedImage, path: Path, confidence: Path | None, options: ReadOptions) -> GivenDepth:
        if loaded.camera_model not in CENTRAL or loaded.camera_model == "fisheye":
            raise UsageError(f"{path}: no depth for {loaded.camera_model} lenses; omit --lenses native, or give {DEPTHS} none")
        stored = read_depth(path, options)
        values, sure = in_pixels_of(loaded, stored, path), None
        if confidence is not None:
            known = read_confidence(confidence, stored.shape, options.max_pixels)
            sure = in_pixels_of(loaded, np.where(stored > 0, known, 0), confidence)
            values = np.where(sure > 0, values, 0)
        if not values.any():
            raise DataError(f"{path}: no pixel has a depth after mask, confidence and --downscale; remove it: it is optional")
        return GivenDepth(values, options.depth_kind, sure)

    def _normals(self, loaded: LoadedImage, path: Path) -> np.ndarray:
        if loaded.camera_model != "pinhole":
            raise UsageError(f"{path}: no normals for {loaded.camera_model} lenses; omit --lenses native, or {NORMALS} none")
        normals = in_pixels_of(loaded, read_normals(path, self.options), path)
        size = np.linalg.norm(normals, axis=-1, keepdims=True)
        normals = np.divide(normals, size, out=np.zeros_like(normals), where=size > 0.5)
        height, width = normals.shape[:2]
        K = loaded.K
        x, y = np.meshgrid((np.arange(width) + 0.5 - K[0, 2]) / K[0, 0], (np.arange(height) + 0.5 - K[1, 2]) / K[1, 1])
        along = normals[..., 0] * x + normals[..., 1] * y + normals[..., 2]
        known = normals.any(-1)
        away = float((along[known] > 0).mean()) if known.any() else 1.0
        if not known.any():
            raise DataError(f"{path}: no pixel inside the mask has a normal; remove the file: normals are optional")
        if away > 0.5:
            raise DataError(f"{path}: {away:.0%} of its normals face away from the camera; give the other --normal-axes")
        return np.where((along <= 0)[..., None], normals, 0).astype(np.float32)


def check_found(views: Sequence[View], options: ReadOptions) -> list[str]:
    """Return notes on the maps of a scene's views."""
    notes = []
    for name, (path, flag) in {"depth": (options.depths, DEPTHS), "normals": (options.normals, NORMALS)}.items():
        having = [v for v in views if getattr(v, name) is not None]
        if path not in (None, NONE) and not having:
            names = [key for key in map_files(Path(path), flag, True) if not key.endswith(CONFIDENCE)]
            raise DataError(f"{path}: none of its {len(names)} maps, as {names[0]!r}, has the name of an image; rename them")
        if not having:
            continue
        where = f"from {Path(path)}" if path is not None else f"listed in the scene's file; to ignore them, use {flag} none"
        what, about = "normals", f"{'OpenCV' if options.normal_axes == 'opencv' else 'OpenGL'} axes"
        if name == "depth":
            share = float(np.mean([(v.depth.values > 0).mean() for v in having if v.depth is not None]))
            unit = "a unit is 0.001 for integers, else 1" if options.depth_unit is None else f"a unit is {options.depth_unit:g}"
            kinds = {
                "metric": f"metric ({unit}; change it with --depth-unit)", "relative": "depth of unknown scale and shift",
                "disparity": "inverse depth of unknown scale and shift",
            }  # fmt: skip
            what, about = "depth maps", f"{share:.1%} of their pixels, {kinds[options.depth_kind]}"
        notes.append(f"{what}: {len(having)} of {len(views)} views, {about}, {where}")
    return notes
