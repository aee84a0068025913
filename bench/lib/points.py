"""Sizes at which ops are measured (a base point, one axis at a time, and the diagonal), and rows as series along one size."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

NAMES = {"count": "N", "degree": "degree", "cameras": "cameras", "threads": "threads"}
"""Fields of a point by their names in the results, which have width and height of the image."""


@dataclass(frozen=True)
class Point:
    """Sizes of one measurement."""

    count: int = 100_000
    """Number of Gaussians."""
    width: int = 504
    """Image width [px]."""
    height: int = 378
    """Image height [px]."""
    degree: int = 3
    """Spherical-harmonics degree, stored and evaluated."""
    cameras: int = 1
    """Cameras rendered in one call."""
    threads: int = 0
    """CPU threads; 0 for all that torch was given."""

    @property
    def pixels(self) -> int:
        """Pixels of one image."""
        return self.width * self.height

    def sizes(self, axes: tuple[str, ...]) -> dict[str, int]:
        """Return the fields that an op depends on, by their names in the results."""
        named = {}
        for axis in axes:
            if axis == "image":
                named |= {"width": self.width, "height": self.height}
            elif axis != "threads" or self.threads:
                named[NAMES[axis]] = getattr(self, axis)
        return named


BASE = Point()
COUNTS = (1_000, 10_000, 100_000, 1_000_000, 10_000_000)
IMAGES = ((256, 256), (504, 378), (1920, 1080), (3840, 2160), (7680, 4320))
DEGREES = (0, 1, 2, 3)
CAMERAS = (1, 4)
DIAGONAL = (
    (100, 128, 128), (1_000, 256, 256), (10_000, 256, 256), (100_000, 504, 378), (1_000_000, 1920, 1080),
    (10_000_000, 3840, 2160),
)  # fmt: skip
"""Numbers of Gaussians with image sizes. The first is for peers that support only few Gaussians."""


def points(axes: tuple[str, ...], device: torch.device, tiny: bool) -> list[Point]:
    """Return all points for an op that depends on ``axes``, the lightest first, each once."""
    if tiny:
        base, counts, images, diagonal = Point(200, 40, 30), (100, 200), ((24, 16), (40, 30)), ()
        degrees, cameras = (0, 3), (1, 2)
    else:
        large = device.type == "cuda"
        base, counts, images = BASE, COUNTS[: 5 if large else 4], IMAGES[: 5 if large else 3]
        diagonal, degrees, cameras = DIAGONAL[: 6 if large else 5], DEGREES, CAMERAS
    found = [base]
    if "count" in axes:
        found += [replace(base, count=n) for n in counts]
    if "image" in axes:
        found += [replace(base, width=w, height=h) for w, h in images]
    if "degree" in axes:
        found += [replace(base, degree=d) for d in degrees]
    if "cameras" in axes:
        found += [replace(base, cameras=c) for c in cameras]
    if "count" in axes and "image" in axes:
        found += [replace(base, count=n, width=w, height=h) for n, w, h in diagonal]
    if "threads" in axes and device.type == "cpu":
        found += [replace(base, threads=t) for t in range(1, (1 if tiny else torch.get_num_threads()) + 1)]
    return sorted(dict.fromkeys(found), key=lambda p: (load(p), p.threads))


def load(p: Point) -> float:
    """Estimate the work of a point relative to the base point: Gaussians with their colours, and pixels, have equal weight."""
    return p.cameras * (p.count / BASE.count * (0.5 + (p.degree + 1) ** 2 / 32) + p.pixels / BASE.pixels)


def growth(small: dict, large: dict) -> float | None:
    """Return the factor by which work grows from one row's sizes to another's, if it is linear in the axis that grows most.

    None if ``large`` is smaller along any axis, because then nothing can be predicted.
    """
    ratios = [1.0]
    for name in ("N", "cameras"):
        if name in large:
            ratios.append(large[name] / small[name])
    if "width" in large:
        ratios.append(large["width"] * large["height"] / (small["width"] * small["height"]))
    if "degree" in large:
        # a lower degree is never dearer, and rows of a higher one may be all there is to go by
        ratios.append(max(1.0, (large["degree"] + 1) ** 2 / (small["degree"] + 1) ** 2))
    if "threads" in large:
        ratios.append(small.get("threads", torch.get_num_threads()) / large["threads"])
    return None if min(ratios) < 1 else max(ratios)


SIZES = ("N", "width", "height", "degree", "cameras", "threads")


@dataclass(frozen=True)
class Series:
    """Times of one task over one size, all other sizes alike."""

    op: str
    program: str
    direction: str
    points: tuple[tuple[float, float], ...]
    """(size, median time [ms]), sizes ascending."""
    others: dict
    """Sizes that are equal for all points of the series."""


def tasks(rows: list[dict]) -> list[tuple[str, str, str]]:
    """Return (op, program, direction) in the order of first appearance, all of an op together."""
    found = dict.fromkeys((r["op"], r["program"], r["direction"]) for r in rows)
    ops = list(dict.fromkeys(op for op, _, _ in found))
    return sorted(found, key=lambda task: ops.index(task[0]))


def pixels(row: dict) -> int:
    """Return the number of pixels of a row's image."""
    return row["width"] * row["height"]


def along(rows: list[dict], axis: str) -> list[Series]:
    """Return each task's series along ``N`` or ``pixels`` through the base point, else its longest; at least two points."""
    base = BASE.sizes(("count", "image", "degree", "cameras"))
    varying = ("N",) if axis == "N" else ("width", "height")
    found = []
    for task in tasks(rows):
        groups: dict[tuple, list[dict]] = {}
        for r in rows:
            if (r["op"], r["program"], r["direction"]) == task and varying[0] in r and "threads" not in r:
                key = tuple((s, r[s]) for s in SIZES if s in r and s not in varying)
                groups.setdefault(key, []).append(r)
        if not groups:
            continue
        key, own = max(groups.items(), key=lambda item: (all(base[s] == value for s, value in item[0]), len(item[1])))
        points = sorted((r["N"] if axis == "N" else pixels(r), r["median_ms"]) for r in own)
        if len(points) > 1:
            found.append(Series(*task, tuple(points), dict(key)))
    return found


def diagonal(rows: list[dict]) -> list[Series]:
    """Return, for each task that depends on both, its times over N where Gaussians and pixels grow together."""
    found = []
    for task in tasks(rows):
        points = {
            r["N"]: r["median_ms"]
            for r in rows
            if (r["op"], r["program"], r["direction"]) == task
            and (r.get("N"), r.get("width"), r.get("height")) in DIAGONAL
            and r.get("degree", 3) == 3 and r.get("cameras", 1) == 1 and "threads" not in r
        }  # fmt: skip
        if len(points) > 1:
            found.append(Series(*task, tuple(sorted(points.items())), {}))
    return found


def exponent(points: list[tuple[float, float]]) -> float:
    """Return the slope of the best line through the logarithms of (size, value)."""
    x, y = np.log(np.array(points, dtype=np.float64)).T
    return float(np.polyfit(x, y, 1)[0])
