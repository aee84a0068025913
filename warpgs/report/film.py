"""Writing of frames as an mp4 film."""

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
        DataError: There are no frames, or they differ in size.
        ResourceError: This OpenCV has no MPEG-4 encoder, or the file cannot be written.
    """
    import cv2

    temporary = path.with_name(f"{path.stem}.tmp.mp4")
    writer, count, size, whole = None, 0, None, False
    try:
        for frame in frames:
            height, width = (s // 2 * 2 for s in frame.shape[:2])
            if writer is None:
                size = (height, width)
                writer = cv2.VideoWriter(str(temporary), cv2.VideoWriter_fourcc(*"mp4v"), fps, (width, height))
                if not writer.isOpened():
                    raise ResourceError(
                        f"{path}: cannot be written; the folder is not writable, or OpenCV lacks an MPEG-4 encoder"
                    )
            # OpenCV drops a frame of another size without a word.
            if (height, width) != size:
                raise DataError(f"{path}: frame {count} is {width} x {height} px, the first {size[1]} x {size[0]} px")
            pixels = np.round(np.clip(frame[:height, :width], 0, 1) * 255).astype(np.uint8)
            writer.write(np.ascontiguousarray(pixels[..., ::-1]))
            count += 1
        whole = True
    finally:
        if writer is not None:
            writer.release()
        if not whole:
            temporary.unlink(missing_ok=True)
    if count == 0:
        raise DataError(f"{path}: there are no frames to write")
    temporary.replace(path)
    return count
