"""Ids of images from the numbers in their file names, so that numbered images are not matched by sorted order."""

from __future__ import annotations

import re
from pathlib import PurePosixPath

from warpgs.errors import DataError


def _numbers(names: list[str]) -> list[int] | None:
    """Return the number that distinguishes each name: the first group of digits that differs between all names; or None."""
    groups = [re.findall(r"[0-9]{1,12}", PurePosixPath(n).stem) for n in names]
    for place in range(min(map(len, groups), default=0)):
        values = [int(g[place]) for g in groups]
        if len(set(values)) == len(values):
            return values
    return None


def named_by_dtu(names: list[str]) -> bool:
    """Return True where all names are DTU's own, `rect_001_3_r5000.png`, which count from 1."""
    return all(re.search(r"rect_[0-9]+_", n) for n in names)


def image_ids(names: list[str]) -> list[int] | None:
    """Return the ids of image files from the numbers in their names; None if no number distinguishes the names.

    DTU's own names, `rect_001_3_r5000.png`, count from 1, so number 1 is id 0; other numbers are used unchanged.
    """
    values = _numbers(names)
    if values is None:
        return None
    return [v - 1 for v in values] if named_by_dtu(names) else values


def protocol_ids(names: list[str], wanted: tuple[int, ...], least: int, where: str) -> dict[int, str]:
    """Return the names of the images with the wanted ids.

    Args:
        names: All image names of a scan, sorted.
        wanted: Ids that a protocol picks, counted from 0.
        least: Smallest number of images for which the ids of the protocol apply.
        where: Protocol and scene, for errors.

    Returns:
        Name by id. Names without numbers are counted in sorted order. Numbered images must have no gaps: after a gap, the
        numbers might differ from the protocol's ids.

    Raises:
        DataError: There are too few images, or some ids are missing; the message names them.
    """
    if len(names) < least:
        raise DataError(
            f"{where}: the protocol needs {least} views, and the scene has {len(names)}; restore the scan, or use llff:K or "
            "every:N"
        )
    ids = image_ids(names)
    if ids is None:
        return {i: names[i] for i in wanted}
    first = 1 if min(ids) == 1 and not named_by_dtu(names) else 0  # files renamed 001, 002, ... count from one
    by_id = {i - first: name for i, name in zip(ids, names)}
    missing = [i for i in range(max(least, len(names))) if i not in by_id]
    if missing:
        shown = ", ".join(map(str, missing[:8])) + (", ..." if len(missing) > 8 else "")
        raise DataError(
            f"{where}: images with the ids {shown} are missing (ids are counted from 0, names run from {names[0]} to "
            f"{names[-1]}); restore them, because the protocol's ids would otherwise select other views"
        )
    return {i: by_id[i] for i in wanted}
