"""Images of a scene: decoded, turned as the camera was, resized, masked."""

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import numpy as np

from warpgs import geometry
from warpgs.errors import DataError, UsageError, expect, explained
from warpgs.io.image_files import MAX_PIXELS, decode, read_exif, read_image_file
from warpgs.scene import DEPTH_KINDS, GivenDepth, View
from warpgs.schema import Checked

BLACK = (0.0, 0.0, 0.0)
REDUCED = "reduced to "
"""Beginning of the note on an image that `load_image` reduced to its longest side."""
SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".avif", ".heic", ".heif", ".hif")
MIN_SIDE = 4
"""Smallest shorter side of an image [px]; below it there is nothing to fit."""
MAX_INTRINSIC = 1e9
"""Intrinsics and image sides must be below this value [px]."""
MIN_FOCAL = 1e-3
"""Smallest focal length as a fraction of the image side: a field of view of 179.8 degrees."""
MAX_DISTORTION = 1e4
"""Distortion coefficients must be below this value."""
MIN_FOLD = 1e-9
"""Inverse of a squared radius; a fold of the lens beyond that radius lies outside any image."""


DEFAULT_MAX_SIDE = 1600
"""Default of the longest side of an image [px]: 12 MP of a phone would take hours on a CPU."""


def image_scale(downscale: int | None, max_side: int | None) -> tuple[int, int]:
    """Return the factor and the longest side [px] (0 for no limit) that follow from two settings, each None if not given."""
    if max_side is None:
        max_side = DEFAULT_MAX_SIDE if downscale is None else 0
    return 1 if downscale is None else downscale, max_side


@dataclass(frozen=True, kw_only=True)
class SceneOptions:
    """Options for reading a scene folder."""

    downscale: int | None = None
    """Factor by which both image sides shrink; None for 1."""
    strict: bool = False
    """Treat a frame without an image file, or with a pose or camera that is not finite, as an error."""
    reconstruction: str | None = None
    """Folder of the COLMAP reconstruction inside the scene folder, such as sparse/1. None: the largest at the usual places."""
    exclude: str | None = None
    """Images to leave out: names or patterns such as blurry*, with or without folder and suffix, separated by commas."""
    allow_outside: bool = False
    """Allow names and links that point to files outside the scene folder."""
    masks: Annotated[str, ("ignore", "cutout")] = "ignore"
    """Treatment of masked-out pixels: ignore (left out of fit and scores) or cutout (transparent)."""
    mask_keeps: Annotated[str, ("white", "black")] = "white"
    """Colour of a mask file that keeps a pixel: white or black."""
    black_is_empty: bool = True
    """Make dark pixels around the object transparent, if every image shows an object on a black background."""
    score_masks: str | None = None
    """Folder of object masks for scoring, matched by image id; None for the scene's own idrmasks, if any."""
    max_pixels: int = MAX_PIXELS
    """Largest number of pixels of a stored image or mask."""
    max_side: int | None = None
    """Largest image side [px], 0 for no limit. None: no limit with --downscale; otherwise 1600, or 800 in a fit on a CPU."""
    lenses: Annotated[str, ("undistort", "native")] = "undistort"
    """Treatment of lens distortion: undistort (images are resampled to a pinhole) or native (the model is rendered through the
    lens). Fisheyes need native."""
    depths: str | None = None
    """Folder of depth maps, 16-bit PNG or NPY, with the names of the images. They place the first Gaussians and guide the fit.
    Default: the maps that transforms.json names; with the value none, these maps are ignored."""
    normals: str | None = None
    """Folder of normal maps, RGB PNG of (n + 1) / 2 or NPY, with the names of the images."""
    depth_kind: Annotated[str, DEPTH_KINDS] = "metric"
    """Meaning of the depth maps: metric (lengths in units of the cameras), relative (lengths of unknown scale and shift) or
    disparity (inverse lengths of unknown scale and shift, as networks give)."""
    depth_unit: float | None = None
    """Length of one unit of a metric depth map, in units of the cameras. None: 0.001 for integer maps, 1 for float maps."""
    normal_axes: Annotated[str, ("opencv", "opengl")] = "opencv"
    """Camera axes of the normals: opencv (y down, z forward) or opengl (y up, z back)."""


@dataclass(frozen=True, kw_only=True)
class ReadOptions(SceneOptions, Checked, group="--"):
    """Options as a reader gets them: checked, with the image sizes that follow from the defaults."""

    downscale: int = 1
    """Factor, at least 1, by which both image sides shrink."""
    max_side: int = 0
    """Largest image side [px], after ``downscale``; 0 for no limit."""
    on_image: Callable[[str], object] | None = None
    """Called by a `ViewList` with the name of each view, in order, once its image is decoded; None for no call."""
    excluded: list[str] = field(default_factory=list)
    """Names of the views that ``exclude`` has left out so far."""

    def excludes(self, name: str) -> bool:
        """Return whether ``exclude`` leaves out the view of this name, and count it then."""
        out = any(matches(name, pattern) for pattern in self.patterns())
        if out:
            self.excluded.append(name)
        return out

    def patterns(self) -> list[str]:
        """Return the names and patterns of ``exclude``."""
        return [p.strip() for p in (self.exclude or "").split(",") if p.strip()]

    def __post_init__(self) -> None:
        for name, least, needs in (
            ("downscale", 1, "of at least 1"), ("max_side", 0, "of pixels, 0 for no limit"), ("max_pixels", 1, "of at least 1"),
        ):  # fmt: skip
            number = getattr(self, name)
            if isinstance(number, bool) or not isinstance(number, int) or number < least:
                raise UsageError(f"--{name.replace('_', '-')} must be a whole number {needs}, not {number!r}")
        super().__post_init__()
        unit = self.depth_unit
        if unit is not None and (isinstance(unit, bool) or not isinstance(unit, (int, float)) or not 0 < unit < math.inf):
            raise UsageError(f"--depth-unit must be a finite number above 0, not {unit!r}")


def matches(name: str, pattern: str) -> bool:
    """Return whether a view's name matches a name or glob pattern, whole or by its end, with suffix or without."""
    end = "/".join(name.split("/")[-1 - pattern.count("/") :])
    return any(n == pattern or fnmatchcase(n, pattern) for n in (name, end, end.rpartition(".")[0]))


@dataclass(frozen=True)
class Lens:
    """Intrinsics and distortion of an image file."""

    K: np.ndarray
    """Intrinsics [px] for ``width`` x ``height``, pixel centres at +0.5, shape [3, 3]."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    distortion: tuple[float, ...] = ()
    """k1, k2, p1, p2[, k3[, k4, k5, k6]] of the OpenCV model, or k1, k2, k3, k4 of a fisheye; empty for none."""
    model: str = "PINHOLE"
    """Name of the camera model, for notes."""
    fisheye: bool = False
    """True for OpenCV's fisheye model."""

    def checked(self, where: str) -> "Lens":
        """Return this lens after a check of its numbers; ``where`` names file and image in errors.

        Raises:
            DataError: A number is not finite, not positive or too large.
        """
        f, c = self.K[[0, 1], [0, 1]], self.K[:2, 2]
        size, terms = np.array([self.width, self.height]), self.distortion
        with explained(f"{where}: impossible camera", "calibrate again, or fix the file", ValueError):
            expect(((size >= 1) & (size <= MAX_INTRINSIC)).all(), f"the camera's image size {self.width} x {self.height} px")
            expect(((f >= MIN_FOCAL * size) & (f < MAX_INTRINSIC)).all(), f"focal lengths {f.tolist()} px")
            expect((np.abs(c) < MAX_INTRINSIC).all(), f"the principal point {c.tolist()} px is not finite or too large")
            expect((np.abs(terms) < MAX_DISTORTION).all(), f"distortion {terms} of the {self.model} lens")
        return self


@dataclass(frozen=True)
class LoadedImage:
    """A decoded image with its intrinsics at its own size."""

    image: np.ndarray
    """Colours in [0, 1], float32, shape [H, W, 3], over the background where transparent."""
    mask: np.ndarray | None
    """True for pixels that are used, bool, shape [H, W]; None for all pixels."""
    K: np.ndarray
    """Intrinsics [px], shape [3, 3]."""
    done: tuple[str, ...] = ()
    """Changes of the pixels to report, as phrases that continue "1 image ..."."""
    alpha: np.ndarray | None = None
    """Opacity in [0, 1], float32, shape [H, W]; None if the image is opaque."""
    kept: float | None = None
    """Fraction of the pixels that a mask file keeps, in [0, 1]; None without a mask file."""
    camera_model: str = "pinhole"
    """Camera model of the pixels, as `Camera.model`."""
    distortion: np.ndarray | None = None
    """Coefficients of the camera model, as `Camera.distortion`."""
    orientation: int = 1
    """EXIF orientation by which the stored image was rotated, 1 to 8; 1 for no rotation."""
    full_size: tuple[int, int] = (0, 0)
    """Height and width [px] before the image was resized, upright."""
    undone: Lens | None = None
    """Lens whose distortion was removed at ``full_size``; None without distortion."""
    depth: GivenDepth | None = None
    """Given depth of the image's pixels, metric depth in file units; None without given depth."""
    normals: np.ndarray | None = None
    """Given normals of the image's pixels, as `View.normals`; None without given normals."""


def list_images(folder: Path) -> list[Path]:
    """Return the image files below a folder, sorted by relative POSIX path."""
    # hidden files and folders are leavings of other programs ("._image.jpg", ".cache"), not images
    names = (p.relative_to(folder) for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file())
    return [folder / name for name in sorted(names, key=Path.as_posix) if all(part[0] != "." for part in name.parts)]


def turn_upright(array: np.ndarray, orientation: int) -> np.ndarray:
    """Rotate or mirror a raster [H, W, ...] upright by its EXIF orientation."""
    if orientation in (5, 6, 7, 8):
        array = np.swapaxes(array, 0, 1)
    for axis in {2: (1,), 3: (0, 1), 4: (0,), 6: (1,), 7: (0, 1), 8: (0,)}.get(orientation, ()):
        array = np.flip(array, axis)
    return np.ascontiguousarray(array)


def _fits(shape: tuple[int, ...], lens: Lens) -> bool:
    """Return True where a raster has the aspect of the lens within one pixel."""
    height, width = shape[:2]
    return abs(width * lens.height / lens.width - height) <= 1 or abs(height * lens.width / lens.height - width) <= 1


def _resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    import cv2

    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def _fold_radius2(distortion: tuple[float, ...]) -> float:
    """Return the squared radius in the image plane beyond which the radial polynomial turns back; inf where it never does."""
    k1, k2, k3 = distortion[0], distortion[1], distortion[4] if len(distortion) > 4 else 0.0
    # roots of 1 + 3 k1 x + 5 k2 x^2 + 7 k3 x^3 through u = 1 / x, whose first coefficient is never small
    roots = np.roots([1.0, 3 * k1, 5 * k2, 7 * k3])
    largest = float(max(roots[np.abs(roots.imag) < 1e-9 * (1 + np.abs(roots.real))].real, default=0.0))
    return 1 / largest if largest > MIN_FOLD else np.inf


def undistortion_maps(K: np.ndarray, lens: Lens, width: int, height: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the columns and rows [H, W] in the distorted image of a pinhole image's pixels, in OpenCV's convention."""
    import cv2

    K = K.copy()
    K[:2, 2] -= 0.5  # OpenCV's pixel centres are at whole numbers
    return cv2.initUndistortRectifyMap(K, np.array(lens.distortion), None, K, (width, height), cv2.CV_32FC1)


def nearest_unmasked(raster: np.ndarray, mask: np.ndarray | None) -> np.ndarray:
    """Return a raster [H, W, ...] with masked pixels filled from the nearest unmasked one, or with 0 if all are masked."""
    import cv2

    if mask is None or mask.all():
        return raster
    if not mask.any():
        return np.zeros_like(raster)
    labels = cv2.distanceTransformWithLabels((~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)[1]
    filled = raster.copy()
    # labels count the unmasked pixels row by row, from 1
    filled[~mask] = raster.reshape(-1, *raster.shape[2:])[np.flatnonzero(mask)[labels[~mask] - 1]]
    return filled


def without_masked(view: View) -> View:
    """Return a view without what is under its mask: the nearest unmasked colours and opacities, no depth, no normals."""
    mask, depth = view.mask, view.depth
    if mask is None or mask.all():
        return view
    alpha = None if view.alpha is None else nearest_unmasked(view.alpha, mask)
    normals = None if view.normals is None else np.where(mask[..., None], view.normals, 0)
    if depth is not None:
        depth = replace(depth, values=np.where(mask, depth.values, 0))
    return replace(view, image=nearest_unmasked(view.image, mask), alpha=alpha, depth=depth, normals=normals)


def _undistort(loaded: LoadedImage, lens: Lens) -> LoadedImage:
    """Resample to a pinhole of the same K; pixels that the lens never saw are masked out."""
    import cv2

    height, width = loaded.image.shape[:2]
    map_x, map_y = undistortion_maps(loaded.K, lens, width, height)
    K = loaded.K.copy()
    K[:2, 2] -= 0.5
    inside = (map_x >= -0.5) & (map_x <= width - 0.5) & (map_y >= -0.5) & (map_y <= height - 0.5)
    # beyond the fold of the polynomial, the map returns into the image, but to the pixel of another ray
    x2 = ((np.arange(width) - K[0, 2]) / K[0, 0]) ** 2
    y2 = ((np.arange(height) - K[1, 2]) / K[1, 1]) ** 2
    inside &= y2[:, None] + x2 < _fold_radius2(lens.distortion)
    if loaded.mask is not None:
        inside &= cv2.remap(loaded.mask.astype(np.float32), map_x, map_y, cv2.INTER_LINEAR) > 0.5

    def moved(raster: np.ndarray) -> np.ndarray:
        return cv2.remap(nearest_unmasked(raster, loaded.mask), map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)

    image, alpha = moved(loaded.image), None if loaded.alpha is None else moved(loaded.alpha)
    done = (*loaded.done, f"undistorted ({lens.model})")
    return replace(loaded, image=image, mask=None if inside.all() else inside, done=done, alpha=alpha, undone=lens)


@functools.lru_cache(maxsize=4)
def _reached(model: str, distortion: tuple[float, ...], intrinsics: tuple[float, ...], width: int, height: int) -> np.ndarray:
    """Return a mask [H, W], True where some light reaches a pixel through the lens; ``intrinsics`` are fx, fy, cx and cy."""
    fx, fy, cx, cy = intrinsics
    x, y = np.meshgrid((np.arange(width) + 0.5 - cx) / fx, (np.arange(height) + 0.5 - cy) / fy)
    with np.errstate(all="ignore"):
        return np.asarray(np.isfinite(geometry.from_plane(model, np.array(distortion), np.stack([x, y], -1))).all(-1))


def _native(loaded: LoadedImage, lens: Lens) -> LoadedImage:
    """Keep the pixels and record the camera model; pixels that the lens does not reach are masked out."""
    model, count = ("fisheye", 4) if lens.fisheye else ("opencv", 8)
    distortion, K = np.pad(np.array(lens.distortion, np.float64), (0, count - len(lens.distortion))), loaded.K
    mask = _reached(model, tuple(distortion), (K[0, 0], K[1, 1], K[0, 2], K[1, 2]), *loaded.image.shape[1::-1])
    if loaded.mask is not None:
        mask = mask & loaded.mask
    done = (*loaded.done, f"kept with the distortion of their lens ({lens.model})")
    return replace(loaded, mask=None if mask.all() else mask, done=done, camera_model=model, distortion=distortion)


def _shrink(path: Path, loaded: LoadedImage, downscale: int, max_side: int) -> LoadedImage:
    """Resample by the factor, or to ``max_side`` if the result would be larger; the intrinsics follow the sizes exactly."""
    height, width = loaded.image.shape[:2]
    factor, flags, done = float(downscale), f"--downscale {downscale}", loaded.done
    if max_side and round(max(width, height) / downscale) > max_side:
        factor, flags = max(width, height) / max_side, f"--max-side {max_side}"
        done = (*done, f"{REDUCED}{max_side} px on the longer side; change it with --max-side, 0 for full size")
    if factor == 1:
        return loaded
    small_w, small_h = round(width / factor), round(height / factor)
    if min(small_w, small_h) < MIN_SIDE:
        raise UsageError(f"{flags} leaves {small_w} x {small_h} px of {path}; keep at least {MIN_SIDE} px of both sides")
    K = np.diag([small_w / width, small_h / height, 1.0]) @ loaded.K
    mask = None if loaded.mask is None else _resize(loaded.mask.astype(np.float32), small_w, small_h) > 0.5
    hides = loaded.mask if loaded.undone is None else None  # what the mask of an undistorted image hides is filled already
    alpha = None if loaded.alpha is None else _resize(nearest_unmasked(loaded.alpha, hides), small_w, small_h)
    return LoadedImage(_resize(nearest_unmasked(loaded.image, hides), small_w, small_h), mask, K, done, alpha, loaded.kept)


def _fit_mask(path: Path, mask: np.ndarray, stored: tuple[int, int], upright: tuple[int, int], orientation: int) -> np.ndarray:
    """Return the mask at the upright size (height, width), rotated if it has the orientation of the stored raster.

    A mask is resampled as gray; a bool mask stays bool.
    """
    if stored != upright and mask.shape == stored:
        mask = turn_upright(mask, orientation)
    height, width = upright
    if mask.shape == upright:
        return mask
    # rounding a size may change it by one pixel of the smaller raster
    if abs(mask.shape[1] * height - mask.shape[0] * width) > max(height, width, *mask.shape):
        raise DataError(f"{path}: its mask is {mask.shape[1]} x {mask.shape[0]} px, of another aspect. Make it from this image")
    resized = _resize(mask.astype(np.float32), width, height)
    return resized > 0.5 if mask.dtype == bool else resized


def _upright(path: Path, lens: Lens, image: np.ndarray, data: bytes) -> int:
    """Return the EXIF orientation to apply: 1 (none) where the raster fits the camera as stored, else the tag's."""
    if _fits(image.shape, lens):
        return 1
    orientation = read_exif(data)[0]
    if orientation not in (5, 6, 7, 8) or not _fits(image.shape[1::-1], lens):
        sizes = f"the image is {image.shape[1]} x {image.shape[0]} px, its camera {lens.width} x {lens.height}"
        raise DataError(f"{path}: {sizes}: the aspects differ. Give the images that the cameras were made from.")
    return orientation


def _with_mask(path: Path, loaded: LoadedImage, cutout: bool) -> LoadedImage:
    """Return an image with its mask applied (with ``cutout`` as opacity) and with colours multiplied by opacity."""
    image, mask, alpha, done, kept = loaded.image, loaded.mask, loaded.alpha, list(loaded.done), None
    if mask is not None:
        kept = float(mask.mean(dtype=np.float64))
        done.append("cut out by a mask file" if cutout else "masked by a mask file")
    if cutout and mask is not None:
        alpha, mask = mask.astype(np.float32) if alpha is None else alpha * mask, None
    if alpha is not None and alpha.min() < 1:
        image *= alpha[..., None]  # until it is resampled
        if not alpha.any():
            done.append("wholly transparent, showing nothing")
        elif kept is None or not cutout:
            done.append("transparent in part, by the alpha channel")
    else:
        alpha = None
    return LoadedImage(image, mask, loaded.K, tuple(done), alpha, kept)


def _over_background(loaded: LoadedImage, background: tuple[float, float, float]) -> LoadedImage:
    """Return an image with colours, premultiplied by their opacity, over a background."""
    image, alpha = np.ascontiguousarray(loaded.image, np.float32), loaded.alpha
    if alpha is not None:
        alpha = np.clip(alpha, 0, 1)  # the mean of ones may be rounded above 1
        for channel, value in enumerate(background):
            image[..., channel] += np.float32(value) * (1 - alpha)
    return replace(loaded, image=image, alpha=alpha)


def load_image(
    path: Path,
    lens: Lens | Callable[[int, int], Lens],
    options: ReadOptions,
    mask: np.ndarray | None = None,
    background: tuple[float, float, float] = BLACK,
) -> LoadedImage:
    """Decode an image, rotate it upright by EXIF, remove distortion, and resample; see `SceneFolder.image` for the arguments.

    Colours are resampled in proportion to their opacity, so that the colours of transparent pixels do not affect others.
    """
    cutout, native = options.masks == "cutout", options.lenses == "native"
    data = read_image_file(path, options.max_pixels)
    image, alpha = decode(path, options.max_pixels, data)
    stored = image.shape[:2]
    if not isinstance(lens, Lens):
        lens = lens(stored[1], stored[0])
    orientation = _upright(path, lens, image, data)
    if orientation != 1:
        image, alpha = turn_upright(image, orientation), None if alpha is None else turn_upright(alpha, orientation)
    height, width = image.shape[:2]
    K = np.diag([width / lens.width, height / lens.height, 1.0]) @ lens.K
    done: tuple[str, ...] = () if orientation == 1 else ("rotated by the EXIF orientation",)
    if not 0.99 < (ratio := lens.width / width) < 1.01:
        done += (f"of {1 / ratio:.3g} times the size of their camera: the intrinsics are scaled to the image",)
    if mask is not None:
        mask = _fit_mask(path, mask if cutout else mask > 0.5, stored, (height, width), orientation)
    loaded = _with_mask(path, LoadedImage(image, mask, K, done, alpha), cutout)
    if not native and (lens.fisheye or len(lens.distortion) > 5):
        raise DataError(f"{path}: images of {lens.model} lenses cannot be undistorted; keep the lens with --lenses native")
    undone = lens if not native and any(lens.distortion) else None
    if undone is not None:
        loaded = _undistort(loaded, undone)
    loaded = _shrink(path, loaded, options.downscale, options.max_side)
    if native and (lens.fisheye or any(lens.distortion)):
        loaded = _native(loaded, lens)
    if loaded.mask is not None and not loaded.mask.any() and loaded.kept != 0:
        raise DataError(f"{path}: no pixel is left after its mask, its lens distortion and --downscale; check all three")
    loaded = replace(loaded, orientation=orientation, full_size=(height, width), undone=undone)
    return _over_background(loaded, background)


DARK = 16 / 255
"""A pixel is dark if its brightest channel is below this value, in [0, 1]."""
DARK_FRACTION = 0.3
"""An image with a dark border shows an object on black if at least this fraction of its pixels is dark."""

HOLE = 0.001
"""An enclosed dark region is a hole in the object if it covers at least this fraction of the image."""


def dark_pixels(image: np.ndarray) -> np.ndarray | None:
    """Return the dark pixels, bool [H, W], of an image [H, W, 3] that shows an object on black; None for any other image.

    In such an image, at least `DARK_FRACTION` of the pixels and half of the border are dark, but not all pixels.
    """
    border = np.concatenate([image[0], image[-1], image[:, 0], image[:, -1]]).max(-1) < DARK
    if border.mean() < 0.5:  # as in most photographs, whose other pixels take 40 ms per million
        return None
    dark = np.asarray(image.max(-1) < DARK)
    return dark if dark.mean() >= DARK_FRACTION and not dark.all() else None


def empty_pixels(dark: np.ndarray) -> np.ndarray:
    """Return the dark pixels without an object in front of them, bool [H, W].

    The region of adjacent dark pixels (4 neighbours) around such a pixel touches the border, or covers at least `HOLE` of the
    image.
    """
    import cv2

    _, labels, found, _ = cv2.connectedComponentsWithStats(dark.astype(np.uint8), connectivity=4)
    empty = found[:, cv2.CC_STAT_AREA] >= HOLE * dark.size
    empty[np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])] = True
    return np.asarray(dark & empty[labels])


def cut_from_black(views: list[View]) -> tuple[list[View], str]:
    """Make the dark pixels around an object and in its holes transparent, if all views show an object on black.

    All other pixels get an opacity of 1, and so do dark specks and cracks that the object encloses. If any view has an alpha
    channel or a mask, or shows something else, all views stay unchanged.
    """
    done, empty = [], 0.0
    for v in views:
        dark = dark_pixels(v.image) if v.alpha is None and v.mask is None else None
        if dark is None:
            return views, ""
        nothing = empty_pixels(dark)
        empty += float(nothing.mean()) / len(views)
        alpha = 1 - nothing.astype(np.float32)
        done.append(replace(v, image=v.image * alpha[..., None], alpha=alpha, alpha_estimated=True))
    return done, f"images show an object on black: {empty:.1%} become transparent; --no-black-is-empty keeps them"
