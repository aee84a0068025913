"""Frames to an mp4 film."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from warpgs.errors import DataError, ResourceError


def write_mp4(path: Path, frames: Iterable[np.ndarray], fps: int = 30) -> int:
    """Write frames [H, W, 3] in [0, 1], all of one size, as an MPEG-4 film; odd sides lose a row or column.

    Returns:
        The number of frames.

    Raises:
        DataError: There are no frames.
        ResourceError: This OpenCV has no MPEG-4 encoder, or the file cannot be written.
    """
    import cv2

    temporary = path.with_name(f"{path.stem}.tmp.mp4")
    writer, count = None, 0
    try:
        for frame in frames:
            height, width = (s // 2 * 2 for s in frame.shape[:2])
            if writer is None:
                writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter_fourcc(*"mp4v"), fps, (width, height))
                if not writer.isOpened():
                    raise ResourceError(
                        f"{path}: cannot be written; the folder is not writable, or OpenCV lacks an MPEG-4 encoder"
                    )
            pixels = np.round(np.clip(frame[:height, :width], 0, 1) * 255).astype(np.uint8)
            writer.write(np.ascontiguousarray(pixels[..., ::-1]))
            count += 1
    finally:
        if writer is not None:
            writer.release()
    if count == 0:
        raise DataError(f"{path}: there are no frames to write")
    temporary.replace(path)
    return count
