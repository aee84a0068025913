"""Frames of a video: the sharpest frame of each of several equally long parts."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from warpgs.errors import DataError
from warpgs.files import write_bytes
from warpgs.input_files import read_start, unread_reason
from warpgs.runtime.file_names import utf8_name
from warpgs.runtime.native_output import hidden_stderr

SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
"""Suffixes of video files."""
SHARPNESS_SIDE = 640
"""Longer side at which frames are compared for sharpness [px]: small enough to average out noise and compression artefacts."""
MAX_FRAMES = 100_000
"""Longest video that is read [frames]: an hour at 25 a second."""
MAX_FRAME_PIXELS = 2**26
"""Largest frame that is read [px]: 8K has half of that."""
MAX_TOTAL_PIXELS = 2**40
"""Largest number of pixels of all frames that are read: an hour and a half of 4K at 25 frames a second."""
START = 12
"""First bytes of a file, which identify its container."""
BOXES = (b"ftyp", b"moov", b"mdat", b"wide", b"free", b"skip", b"pnot")
"""First boxes of MP4 and MOV files (ISO/IEC 14496-12, QuickTime)."""


def is_video(path: Path) -> bool:
    """Return whether a path is a file with the suffix of a video."""
    return path.suffix.lower() in SUFFIXES and path.is_file()


def _frames(path: Path) -> Iterator[np.ndarray]:
    """Yield the frames of a video, uint8 BGR [H, W, 3], upright."""
    import cv2

    _check_container(path)
    with utf8_name(path) as name, hidden_stderr():  # for a broken file, both would print the error, too
        capture = cv2.VideoCapture(name, cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            raise DataError(
                f"{path}: OpenCV cannot read it as a video; convert it to an mp4 file with H.264, or give its frames"
            )
        size = capture.get(cv2.CAP_PROP_FRAME_WIDTH) * capture.get(cv2.CAP_PROP_FRAME_HEIGHT)
        if not 0 < size <= MAX_FRAME_PIXELS:
            raise DataError(f"{path}: its frames have {size:,.0f} pixels, not 1 to {MAX_FRAME_PIXELS:,}; convert the video")
        total = 0
        for _ in range(MAX_FRAMES):
            there, frame = capture.read()
            if not there:
                return
            total += frame.shape[0] * frame.shape[1]
            if total > MAX_TOTAL_PIXELS:
                raise DataError(f"{path}: has more than {MAX_TOTAL_PIXELS:,} pixels in all frames; cut it shorter or shrink it")
            yield frame
    finally:
        capture.release()
    raise DataError(f"{path}: has more than {MAX_FRAMES:,} frames; cut it shorter")


def _check_container(path: Path) -> None:
    """Raise a DataError if a file is not a video container: FFmpeg would follow a playlist to other files."""
    try:
        start = read_start(path, START)
    except OSError as e:
        raise DataError(f"{path}: the video cannot be read ({unread_reason(e)}); fix its permissions or copy it again") from e
    avi, matroska = start[:4] == b"RIFF" and start[8:] == b"AVI ", start[:4] == b"\x1a\x45\xdf\xa3"
    if not (avi or matroska or start[4:8] in BOXES):
        raise DataError(f"{path}: OpenCV cannot read it as a video; convert it to an mp4 file with H.264, or give its frames")


def sharpness(frame: np.ndarray) -> float:
    """Return the variance of the Laplacian of a frame, uint8 BGR [H, W, 3], at a size at which noise averages out."""
    import cv2

    gray = cv2.cvtColor(frame, cv2.COLOR_BGR2GRAY)
    scale = SHARPNESS_SIDE / max(gray.shape)
    if scale < 1:
        gray = cv2.resize(gray, (0, 0), fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(gray.astype(np.float64), cv2.CV_64F).var())


def sharpest(values: list[float], count: int) -> list[int]:
    """Return indices of at most ``count`` frames: the sharpest of each of ``count`` equal parts, the first if several are."""
    bounds = np.linspace(0, len(values), min(count, len(values)) + 1).round().astype(int)
    return [a + int(np.argmax(values[a:b])) for a, b in itertools.pairwise(bounds)]


def write_frames(path: Path, folder: Path, count: int, progress: Callable[[str], object]) -> int:
    """Write the sharpest frame of each of ``count`` equal parts of a video as PNG files, named by their number.

    Args:
        path: The video file.
        folder: Folder to write into.
        count: Number of frames to write; all frames if the video has fewer.
        progress: Called with a line for the user for each frame.

    Returns:
        The number of frames that the video has.

    Raises:
        DataError: The video cannot be read, or is too long.
        ResourceError: The disk is full.
    """
    import cv2

    values = []
    for i, frame in enumerate(_frames(path)):
        progress(f"looking for sharp frames: {i + 1} read")
        values.append(sharpness(frame))
    if not values:
        raise DataError(f"{path}: holds no frame that OpenCV can read; record it again, or give its frames as images")
    wanted = set(sharpest(values, count))
    for i, frame in enumerate(_frames(path)):
        if i in wanted:
            progress(f"writing frames: frame {i}")
            _, png = cv2.imencode(".png", frame, [cv2.IMWRITE_PNG_COMPRESSION, 1])
            write_bytes(folder / f"frame_{i:06d}.png", png.tobytes())
    return len(values)
