"""Writing of frames as a film: VP9 in .mp4 or .webm, or an animated .webp or .gif."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.files import replacing
from warpgs.report.animation import ANIMATIONS, write_animation
from warpgs.runtime.file_names import utf8_name
from warpgs.runtime.native_output import hidden_stderr

VIDEOS = (".mp4", ".webm")
SUFFIXES = (*VIDEOS, *ANIMATIONS)
"""Formats of films."""


def write_film(path: Path, frames: Iterable[np.ndarray], fps: int = 30) -> int:
    """Write frames [H, W, 3] in [0, 1], all of one size, as a film in the format that the path's suffix names.

    A video (.mp4, .webm) is VP9, which OpenCV's wheels bring and current browsers play; an odd height loses a row, an odd width
    a column. An animated image (.webp, .gif) runs in a loop. The film is decoded before it replaces an older one, because the
    encoder does not report a full disk.

    Returns:
        The number of frames.

    Raises:
        DataError: There are no frames, or they differ in size.
        ResourceError: This OpenCV has no VP9 encoder, or the file cannot be written.
        UsageError: The suffix is not in `SUFFIXES`, or an animated image would be too large or too fast.
    """
    suffix = path.suffix.lower()
    if suffix in ANIMATIONS:
        return write_animation(path, frames, fps)
    if suffix not in VIDEOS:
        raise UsageError(f"{path}: a film must end in one of {', '.join(SUFFIXES)}, got {suffix or 'no suffix'}")
    sizes: list[tuple[int, int]] = []

    def check(film: Path) -> None:
        found = _decoded_sizes(film)
        if found != sizes:
            raise ResourceError(
                f"{path}: cannot be written; only {sum(f == s for f, s in zip(found, sizes))} of {len(sizes)} frames could be "
                "read back. The disk is full, or the encoder failed; the old file is untouched. Free some disk space, or "
                "write elsewhere"
            )

    with replacing(path, check, suffix=suffix) as temporary, utf8_name(temporary) as name:
        _encode(path, name, frames, fps, sizes)
    return len(sizes)


def _encode(path: Path, temporary: str, frames: Iterable[np.ndarray], fps: int, sizes: list[tuple[int, int]]) -> None:
    """Write frames to a temporary file, and the size of each, [width, height], to a list."""
    import cv2

    writer = None
    try:
        for frame in frames:
            height, width = (s // 2 * 2 for s in frame.shape[:2])
            if writer is None:
                # for .webm OpenCV warns on stderr of an unknown tag, but writes VP9
                with hidden_stderr() if path.suffix.lower() == ".webm" else contextlib.nullcontext():
                    writer = cv2.VideoWriter(temporary, cv2.VideoWriter_fourcc(*"vp09"), fps, (width, height))
                if not writer.isOpened():
                    raise ResourceError(f"{path}: cannot be written; the folder is not writable, or OpenCV lacks a VP9 encoder")
            sizes.append((width, height))
            # OpenCV drops a frame of another size silently.
            if sizes[-1] != sizes[0]:
                w, h = sizes[0]
                raise DataError(f"{path}: frame {len(sizes) - 1} is {width} x {height} px, the first {w} x {h} px")
            pixels = np.round(np.clip(frame[:height, :width], 0, 1) * 255).astype(np.uint8)
            writer.write(np.ascontiguousarray(pixels[..., ::-1]))
    finally:
        if writer is not None:
            writer.release()
    if not sizes:
        raise DataError(f"{path}: there are no frames to write")


def _decoded_sizes(path: Path) -> list[tuple[int, int]]:
    """Return the size of each frame, [width, height], that can be decoded."""
    import cv2

    with utf8_name(path) as name:
        film, sizes = cv2.VideoCapture(name), []
        try:
            while (read := film.read())[0]:
                sizes.append((read[1].shape[1], read[1].shape[0]))
        finally:
            film.release()
    return sizes
