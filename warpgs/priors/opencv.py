"""OpenCV on one thread and without Intel's IPP, so that results depend neither on the number of cores nor on the processor."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator


@contextlib.contextmanager
def single_threaded_opencv() -> Iterator[None]:
    """Keep OpenCV from starting threads in this process; our own threads call OpenCV in parallel.

    Many OpenCV calls here are so short that starting threads costs time. The rounding of some calls depends on the number of
    threads. With one thread, `cv2.distanceTransform` uses IPP's code, unless `without_ipp` turned it off. The fast global
    smoother cuts an image into as many stripes as there are threads, and processes the last rows of a stripe by different code.
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
