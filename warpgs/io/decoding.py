"""Decoding of image files: read the header, check that the file is complete, then decode the pixels."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from warpgs.errors import DataError, ResourceError
from warpgs.input_files import read_input, read_start, unread_reason
from warpgs.io.image_formats import avif, jpeg, png
from warpgs.io.image_formats.kinds import format_of
from warpgs.io.unread_formats import unread_format

MAX_PIXELS = 100_000_000
"""Default limit on the pixels of an image; decoded, an image of this size takes 1.2 GB."""
FILE_BYTES_PER_PIXEL, EXTRA_FILE_BYTES = 16, 2**26
"""Bytes that a pixel may take in a file (four channels as float32), and bytes for everything else in the file."""
BYTES_PER_PIXEL = 32
"""Most memory that decoding takes per pixel [bytes]: four channels as float32, and the colours and alpha made of them."""


def read_image_file(path: Path, max_pixels: int = MAX_PIXELS) -> bytes:
    """Return the bytes of an image file; files too large for ``max_pixels`` pixels are rejected.

    Raises:
        DataError: The file is missing, cannot be read, or is not a regular file.
    """
    try:
        return read_input(path, FILE_BYTES_PER_PIXEL * max_pixels + EXTRA_FILE_BYTES)
    except OSError as e:
        raise _unreadable(path, e) from e


def read_image_start(path: Path, count: int) -> bytes:
    """Return the first bytes of an image file, at most ``count``.

    Raises:
        DataError: The file is missing, cannot be read, or is not a regular file.
    """
    try:
        return read_start(path, count)
    except OSError as e:
        raise _unreadable(path, e) from e


def _unreadable(path: Path, error: OSError) -> DataError:
    if not os.path.exists(path):  # False for broken and circular links
        what = "is a broken link" if path.is_symlink() else "the image file is missing"
        return DataError(f"{path}: {what}; restore it, or remove its camera from the scene")
    return DataError(f"{path}: the image cannot be read ({unread_reason(error)}); fix its permissions or copy it again")


def _raster(path: Path, data: bytes, max_pixels: int) -> np.ndarray:
    """Return the pixels as stored, [H, W] or [H, W, C] with colours in BGR order, of any type that OpenCV has."""
    import cv2

    pixels = 0
    unread = unread_format(path, data[:32])
    if unread is not None:
        raise DataError(f"{path}: is {unread}")
    try:
        _, module = format_of(data)
        width, height = module.size(data)
        pixels = width * height
        if pixels > max_pixels:
            raise DataError(
                f"{path}: the image is {width} x {height} px, more than the limit of {max_pixels:,} pixels; shrink it, or "
                f"raise the limit with --max-pixels {pixels} (decoding then needs {BYTES_PER_PIXEL * pixels / 2**30:.1f} GiB)"
            )
        if not pixels:
            raise ValueError(f"it has {width} x {height} px")
        raster: np.ndarray | None = None
        if module in (jpeg, avif):
            raster = module.decode(data)
        else:
            module.check(data)
        if raster is None:
            # IMREAD_UNCHANGED also ignores the EXIF orientation: the camera, not the tag, determines how the raster lies
            raster = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
        if raster is None or raster.shape[:2] != (height, width):
            raise ValueError("its pixels cannot be read")
    except (ValueError, cv2.error) as e:
        if isinstance(e, cv2.error) and e.code == cv2.Error.StsNoMem:
            raise ResourceError(_too_large(path, pixels)) from e
        reason = "OpenCV cannot read it" if isinstance(e, cv2.error) else str(e)
        raise DataError(
            f"{path}: the image cannot be decoded: {reason}. Restore it from its source; if it looks right, save it as PNG"
        ) from e
    except MemoryError as e:
        raise ResourceError(_too_large(path, pixels)) from e
    return raster


def _too_large(path: Path, pixels: int) -> str:
    needed = BYTES_PER_PIXEL * pixels / 2**30
    return f"{path}: decoding the image needs {needed:.1f} GiB of free memory; shrink the image, or end other programs"


def decode_png(path: Path, max_pixels: int = MAX_PIXELS) -> np.ndarray:
    """Decode a PNG to its numbers as stored, uint8 or uint16, shape [H, W] or [H, W, C] with colours in RGB order.

    Raises:
        DataError: The file is missing, not a PNG, too large, or damaged.
        ResourceError: There is not enough memory for the image.
    """
    data = read_image_file(path, max_pixels)
    if not data.startswith(png.SIGNATURE):
        raise DataError(f"{path}: is not a PNG file; save it as 16-bit PNG or NPY")
    raw = _raster(path, data, max_pixels)
    return raw if raw.ndim == 2 else np.ascontiguousarray(raw[..., [2, 1, 0, 3][: raw.shape[2]]])


def decode(path: Path, max_pixels: int = MAX_PIXELS, data: bytes | None = None) -> tuple[np.ndarray, np.ndarray | None]:
    """Decode an image file as stored, without rotation by its EXIF tag.

    Gray, palette, 8- and 16-bit images and straight alpha are supported.

    Args:
        path: A JPEG, PNG, BMP, TIFF, WebP or AVIF file, with any suffix.
        max_pixels: Largest number of pixels that its header may announce.
        data: Bytes of the file, if they have been read already.

    Returns:
        Colours in [0, 1], float32, shape [H, W, 3]; and alpha in [0, 1], float32, shape [H, W], or None.

    Raises:
        DataError: The file is missing, of another format, too large, or damaged, as far as its format reveals damage.
        ResourceError: There is not enough memory for the image.
    """
    raw = _raster(path, read_image_file(path, max_pixels) if data is None else data, max_pixels)
    if raw.dtype in (np.uint8, np.uint16):
        values = raw.astype(np.float32)
        values /= np.iinfo(raw.dtype).max
    elif raw.dtype == np.float32:
        values = np.clip(raw, 0, 1)
        if not np.isfinite(raw).all():
            raise DataError(f"{path}: some pixels are not finite; save it as 8- or 16-bit PNG")
    else:
        raise DataError(f"{path}: pixels of type {raw.dtype} are not supported; save it as 8- or 16-bit PNG")
    del raw  # free it before copies are made
    if values.ndim == 2:
        values = values[..., None]
    channels = values.shape[2]
    if channels > 4:
        raise DataError(f"{path}: has {channels} channels; save it as gray, RGB or RGBA")
    alpha = np.ascontiguousarray(values[..., -1]) if channels in (2, 4) else None
    color = np.repeat(values[..., :1], 3, axis=2) if channels <= 2 else values[..., 2::-1]
    return np.ascontiguousarray(color), alpha
