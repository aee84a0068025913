"""OpenCV on one thread and in its own code: results then depend neither on the number of cores nor on Intel's IPP."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """Keep OpenCV from starting threads, in this process; our own call it side by side.

    Many of its calls here are so short that starting threads takes longer than they save, and the rounding of some depends on
    the number of threads: `cv2.distanceTransform` takes IPP's code where there is but one, and the fast global smoother cuts an
    image into as many stripes as there are threads, and works on the last rows of a stripe in other code.
    """
    import cv2

    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def without_ipp() -> None:
    """Turn IPP off for the calling thread: its instructions, and so their rounding, depend on the processor."""
    import cv2

    cv2.ipp.setUseIPP(False)
