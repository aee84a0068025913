"""Photographs and masks: decoding, orientation, undistortion, resizing, each with the camera kept in step."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpgs.errors import DataError

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp")
EXIF_ORIENTATION = 0x0112


@dataclass(frozen=True)
class Lens:
    """Intrinsics of a photograph as its file has them, and the distortion to undo."""

    K: np.ndarray
    """Intrinsics [px] for ``width`` x ``height``, pixel centres at +0.5, shape [3, 3]."""
    width: int
    """Image width [px]."""
    height: int
    """Image height [px]."""
    distortion: tuple[float, ...] = ()
    """k1, k2, p1, p2[, k3] of the OpenCV model; empty for none."""
    model: str = "PINHOLE"
    """Name of the camera model, for notes."""


@dataclass(frozen=True)
class Photo:
    """A decoded photograph with its intrinsics at its own size."""

    image: np.ndarray
    """Colours in [0, 1], float32, shape [H, W, 3]."""
    mask: np.ndarray | None
    """True where the pixel counts, bool, shape [H, W]; None for everywhere."""
    K: np.ndarray
    """Intrinsics [px], shape [3, 3]."""


def list_images(folder: Path) -> list[Path]:
    """Image files below a folder, sorted by relative POSIX path."""
    files = [p for p in folder.rglob("*") if p.suffix.lower() in SUFFIXES and p.is_file()]
    return sorted(files, key=lambda p: p.relative_to(folder).as_posix())


def decode(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    """Colours in [0, 1], float32 [H, W, 3], and alpha in [0, 1], float32 [H, W], or None; stored raster, not rotated.

    Gray, palette, 8- and 16-bit images and straight alpha are understood.

    Raises:
        DataError: The file is missing, empty, truncated or no image.
    """
    import cv2

    if not path.is_file():
        raise DataError(f"{path}: the image file is missing; restore it, or remove its camera from the scene")
    data = np.fromfile(path, np.uint8)  # not cv2.imread: that fails on non-ASCII paths on some systems
    flags = cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION
    try:
        raw = cv2.imdecode(data, cv2.IMREAD_UNCHANGED if flags < 0 else flags) if data.size else None
    except cv2.error:
        raw = None
    if raw is None:
        raise DataError(f"{path}: the image cannot be decoded; it is empty, truncated or no image. Restore it from its source")
    if raw.dtype == np.uint8:
        values = raw.astype(np.float32) / 255
    elif raw.dtype == np.uint16:
        values = raw.astype(np.float32) / 65535
    elif raw.dtype == np.float32:
        values = np.clip(raw, 0, 1)
    else:
        raise DataError(f"{path}: pixels of type {raw.dtype} are not supported; save it as 8- or 16-bit PNG")
    if values.ndim == 2:
        values = values[..., None]
    channels = values.shape[2]
    alpha = values[..., -1] if channels in (2, 4) else None
    color = np.repeat(values[..., :1], 3, axis=2) if channels <= 2 else values[..., 2::-1]
    return np.ascontiguousarray(color), alpha


def exif_orientation(path: Path) -> int:
    """EXIF orientation 1 to 8; 1 where the file has none."""
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as image:
            value = image.getexif().get(EXIF_ORIENTATION, 1)
    except (OSError, UnidentifiedImageError, SyntaxError, ValueError):
        return 1  # decode() has the last word on whether the file is an image
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


def _turn(array: np.ndarray, orientation: int) -> np.ndarray:
    """Rotate or mirror a raster [H, W, ...] upright as its EXIF orientation asks."""
    if orientation in (5, 6, 7, 8):
        array = np.swapaxes(array, 0, 1)
    flips = {2: (1,), 3: (0, 1), 4: (0,), 6: (1,), 7: (0, 1), 8: (0,)}.get(orientation, ())
    for axis in flips:
        array = np.flip(array, axis)
    return np.ascontiguousarray(array)


def _fits(shape: tuple[int, ...], lens: Lens) -> bool:
    """Whether a raster has the lens's aspect within one pixel."""
    height, width = shape[:2]
    return abs(width * lens.height / lens.width - height) <= 1 or abs(height * lens.width / lens.height - width) <= 1


def _resize(image: np.ndarray, width: int, height: int) -> np.ndarray:
    import cv2

    return cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)


def _undistort(photo: Photo, distortion: tuple[float, ...]) -> Photo:
    import cv2

    height, width = photo.image.shape[:2]
    K = photo.K.copy()
    K[:2, 2] -= 0.5  # OpenCV's pixel centres are at whole numbers
    map_x, map_y = cv2.initUndistortRectifyMap(K, np.array(distortion), None, K, (width, height), cv2.CV_32FC1)
    image = cv2.remap(photo.image, map_x, map_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    inside = (map_x >= -0.5) & (map_x <= width - 0.5) & (map_y >= -0.5) & (map_y <= height - 0.5)
    if photo.mask is not None:
        mask = cv2.remap(photo.mask.astype(np.float32), map_x, map_y, cv2.INTER_LINEAR)
        inside &= mask > 0.5
    return Photo(image, None if inside.all() else inside, photo.K)


def find_mask(image: Path, images_root: Path, invert: bool) -> np.ndarray | None:
    """Mask [H, W] of an image from a folder `masks` beside the image folder: same name as .png, or name plus .png.

    White keeps a pixel; ``invert`` turns that round.

    Raises:
        DataError: The mask file cannot be decoded.
    """
    relative = image.relative_to(images_root)
    folder = images_root.parent / "masks"
    for candidate in (folder / relative.with_suffix(".png"), folder / f"{relative.as_posix()}.png", folder / relative):
        if candidate.is_file():
            color, _ = decode(candidate)
            return (color[..., 0] > 0.5) != invert
    return None


def load_photo(
    path: Path,
    lens: Lens,
    *,
    downscale: int = 1,
    mask: np.ndarray | None = None,
    background: tuple[float, float, float] | None = None,
) -> Photo:
    """Decode a photograph, set it upright if its camera says so, undo distortion, and resample.

    Args:
        path: The image file.
        lens: Its intrinsics, at whatever size; they are scaled to the image.
        downscale: Factor by which both sides shrink (area resampling).
        mask: True where a pixel counts, [H, W] at the size of the file or of the same aspect.
        background: Put behind transparent pixels; None turns transparency into the mask instead.

    Returns:
        The photograph with intrinsics for its final size.

    Raises:
        DataError: The file cannot be decoded, or its size does not fit its camera or its mask.
    """
    image, alpha = decode(path)
    if not _fits(image.shape, lens):
        orientation = exif_orientation(path)
        turned = _turn(image, orientation)
        if orientation == 1 or not _fits(turned.shape, lens):
            raise DataError(
                f"{path}: the image is {image.shape[1]} x {image.shape[0]} px, its camera {lens.width} x {lens.height}: the "
                "aspects differ, so the intrinsics cannot belong to it. Give the images that the cameras were made from."
            )
        image, alpha = turned, None if alpha is None else _turn(alpha, orientation)
    height, width = image.shape[:2]
    K = np.diag([width / lens.width, height / lens.height, 1.0]) @ lens.K
    if mask is not None and mask.shape != (height, width):
        if abs(mask.shape[1] * height - mask.shape[0] * width) > max(height, width):
            raise DataError(f"{path}: its mask is {mask.shape[1]} x {mask.shape[0]} px, the image {width} x {height}")
        mask = _resize(mask.astype(np.float32), width, height) > 0.5
    if alpha is not None and alpha.min() < 1:
        if background is not None:
            image = image * alpha[..., None] + np.float32(background) * (1 - alpha[..., None])
        else:
            mask = (alpha > 0.5) if mask is None else mask & (alpha > 0.5)
    photo = Photo(image, mask, K)
    if any(lens.distortion):
        photo = _undistort(photo, lens.distortion)
    if downscale > 1:
        small_w, small_h = max(1, round(width / downscale)), max(1, round(height / downscale))
        K = np.diag([small_w / width, small_h / height, 1.0]) @ photo.K
        mask = None if photo.mask is None else _resize(photo.mask.astype(np.float32), small_w, small_h) > 0.5
        photo = Photo(_resize(photo.image, small_w, small_h), mask, K)
    return Photo(np.ascontiguousarray(photo.image, np.float32), photo.mask, photo.K)


def image_folder(root: Path, downscale: int, base: str = "images") -> tuple[Path, int, str]:
    """Choose the image folder for a downscale factor: the ready-made `images_N`, else the full one, resampled.

    Returns:
        The folder, the factor left to resample by, and a note for the user (empty where nothing was chosen).

    Raises:
        DataError: There is no image folder.
    """
    ready = root / f"{base}_{downscale}"
    if downscale > 1 and ready.is_dir() and list_images(ready):
        return ready, 1, f"images taken from {ready.name}"
    full = root / base
    if full.is_dir() and list_images(full):
        return full, downscale, f"images area-resampled by {downscale}" if downscale > 1 else ""
    others = [p for p in root.glob(f"{base}_*") if p.name[len(base) + 1 :].isdigit() and list_images(p)]
    if not others:
        raise DataError(f"{root}: there is no folder '{base}' with images; put the photographs there")
    largest = min(others, key=lambda p: int(p.name[len(base) + 1 :]))
    how = f", area-resampled by {downscale}" if downscale > 1 else ""
    return largest, downscale, f"there is no full-size folder '{base}': images taken from {largest.name}{how}"
