"""Rows of a result as series along one size, and how steeply they grow."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from bench.lib.points import BASE, DIAGONAL

SIZES = ("N", "width", "height", "degree", "cameras", "threads")
DECADE = 11.0
"""Span of the fit: 1920 x 1080 has 10.9 times as many pixels as 504 x 378, and that should count as a decade."""


@dataclass(frozen=True)
class Series:
    """Times of one task over one size, all other sizes alike."""

    op: str
    program: str
    direction: str
    points: tuple[tuple[float, float], ...]
    """(size, median time [ms]), sizes ascending."""
    others: dict
    """The sizes that stay the same."""


def tasks(rows: list[dict]) -> list[tuple[str, str, str]]:
    """(op, program, direction) in the order of first appearance, all of an op together."""
    found = dict.fromkeys((r["op"], r["program"], r["direction"]) for r in rows)
    ops = list(dict.fromkeys(op for op, _, _ in found))
    return sorted(found, key=lambda task: ops.index(task[0]))


def pixels(row: dict) -> int:
    """Pixels of a row's image."""
    return row["width"] * row["height"]


def along(rows: list[dict], axis: str) -> list[Series]:
    """For each task its series along ``N`` or ``pixels`` through the base point, else its longest; two points at least."""
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
    """For each task that depends on both, its times where Gaussians and pixels grow together, over N."""
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


def exponent(points: Sequence[tuple[float, float]]) -> float | None:
    """Slope of log time over log size, by least squares through the last decade of sizes; None for fewer than two points."""
    last = [(math.log(x), math.log(y)) for x, y in points if x * DECADE >= max(x for x, _ in points)]
    if len(last) < 2:
        return None
    mean_x, mean_y = (sum(v) / len(last) for v in zip(*last))
    return sum((x - mean_x) * (y - mean_y) for x, y in last) / sum((x - mean_x) ** 2 for x, _ in last)
