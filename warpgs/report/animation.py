"""Writing of frames as an animated image, WebP or GIF, that runs in a loop."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.files import write_bytes

ANIMATIONS = (".webp", ".gif")
MAX_BYTES = 2**30
"""Largest size of all frames together, uncompressed: Pillow holds them all."""
MAX_FPS = 50
"""Frames per second above which browsers slow an animated image down to 10."""
QUALITY = 80
"""Quality of WebP, from 0 to 100."""
PALETTE_PIXELS = 2**18
"""Number of pixels, taken from all frames, from which a GIF's palette is chosen."""


def _pixels(path: Path, frames: Iterable[np.ndarray]) -> list[np.ndarray]:
    """Return frames as 8-bit values, after checking their number and size."""
    result: list[np.ndarray] = []
    for frame in frames:
        pixels = np.round(np.clip(frame, 0, 1) * 255).astype(np.uint8)
        if result and pixels.shape != result[0].shape:
            (h, w), (height, width) = result[0].shape[:2], pixels.shape[:2]
            raise DataError(f"{path}: frame {len(result)} is {width} x {height} px, the first {w} x {h} px")
        result.append(pixels)
        if len(result) * pixels.nbytes > MAX_BYTES:
            raise UsageError(
                f"{path}: an animated image takes at most {MAX_BYTES // pixels.nbytes} frames of this size; write .mp4 or "
                ".webm, or fewer or smaller frames"
            )
    if not result:
        raise DataError(f"{path}: there are no frames to write")
    return result


def _durations(count: int, fps: int, unit: int) -> list[int]:
    """Return how long each frame is shown, in multiples of ``unit`` [ms], so that the sum is right to half a unit."""
    ends = np.round(np.arange(count + 1) * 1000 / (fps * unit)).astype(int) * unit
    return [int(d) for d in np.diff(ends)]


def _with_one_palette(pixels: list[np.ndarray]) -> list:
    """Return frames as Pillow images with one palette, so that colours do not flicker, and with dithering against banding."""
    from PIL import Image

    step = max(1, round((sum(p.shape[0] * p.shape[1] for p in pixels) / PALETTE_PIXELS) ** 0.5))
    sample = np.concatenate([p[::step, ::step].reshape(-1, 3) for p in pixels])
    palette = Image.fromarray(sample[None]).quantize(256, Image.Quantize.MEDIANCUT)
    return [Image.fromarray(p).quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for p in pixels]


def write_animation(path: Path, frames: Iterable[np.ndarray], fps: int) -> int:
    """Write frames [H, W, 3] in [0, 1], all of one size, as an animated WebP or GIF; returns their number.

    Equal frames in a row become one frame that is shown longer.

    Raises:
        DataError: There are no frames, or they differ in size.
        ResourceError: Pillow cannot encode the image, or the file cannot be written.
        UsageError: There are too many frames, or too many per second for browsers.
    """
    from PIL import Image

    if fps > MAX_FPS:
        raise UsageError(f"{path}: browsers show at most {MAX_FPS} frames per second of an animated image, not {fps}")
    pixels, gif = _pixels(path, frames), path.suffix.lower() == ".gif"
    images = _with_one_palette(pixels) if gif else [Image.fromarray(p) for p in pixels]
    durations = _durations(len(images), fps, 10 if gif else 1)
    choices = {"optimize": False} if gif else {"quality": QUALITY, "method": 4}

    data = io.BytesIO()
    kind = "GIF" if gif else "WEBP"
    try:
        images[0].save(data, format=kind, save_all=True, append_images=images[1:], duration=durations, loop=0, **choices)
    except (OSError, ValueError, KeyError) as e:
        raise ResourceError(f"{path}: could not be encoded as {kind} by this Pillow ({e}); write .mp4 instead") from e
    write_bytes(path, data.getbuffer())
    return len(pixels)
