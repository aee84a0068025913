"""Lists of cameras, Gaussians and options for one call."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from warpgs.scene import Camera


def for_each(cameras: Sequence[Camera], *, gaussians: Any, options: Any) -> list[tuple[Any, ...]]:
    """Return Gaussians, camera and options of each of C cameras; single values are shared by all.

    Raises:
        ValueError: The length of a list is not C.
    """
    columns = []
    for name, given in (("gaussians", gaussians), ("options", options)):
        columns.append(given if isinstance(given, (list, tuple)) else [given] * len(cameras))
        if len(columns[-1]) != len(cameras):
            raise ValueError(f"{len(columns[-1])} {name} for {len(cameras)} cameras: give one for all, or one for each camera")
    return list(zip(columns[0], cameras, columns[1], strict=True))
