"""Prediction of time and memory from smaller measurements, so that hopeless ones are left out and listed."""

from __future__ import annotations

import math
from collections.abc import Iterable

from bench.lib.points import Point, growth

LIMIT_MS = 2000.0
"""Longest time of one repeat that is still measured [ms]."""


def _smaller(rows: list[dict], op: str, program: str, direction: str, sizes: dict) -> list[tuple[float, dict]]:
    """Rows of the same task at sizes that are nowhere larger, with the factor from there to ``sizes``, the least first.

    Runs on few threads say nothing about runs on all.
    """
    same = [r for r in rows if (r["op"], r["program"], r["direction"]) == (op, program, direction)]
    same = [r for r in same if "threads" in sizes or "threads" not in r]
    factors = [(growth(r, sizes), r) for r in same]
    return sorted(((f, r) for f, r in factors if f is not None), key=lambda pair: pair[0])


def _changed(small: dict, large: dict, names: Iterable[str]) -> set[str]:
    """The sizes that differ between two rows; the image counts once."""
    return {"width" if n == "height" else n for n in names if small.get(n) != large.get(n)}


def time_ms(rows: list[dict], op: str, program: str, direction: str, sizes: dict) -> float | None:
    """Predicted time of a repeat [ms]; None where nothing smaller was measured.

    The least estimate from those smaller rows that have no other between them and ``sizes``. Growth is linear at least in
    the size that grows most; if a still smaller row shows a steeper growth along the same axis, that goes on, up to
    quadratic. Small sizes are mostly overhead, so this errs on the high side there, where it does no harm.
    """
    smaller = _smaller(rows, op, program, direction, sizes)
    estimates = []
    for factor, near in smaller:
        if any((growth(near, other) or 0) > 1 for _, other in smaller):
            continue
        slopes = [1.0]
        for _, far in smaller:
            step = growth(far, near) or 0
            if step > 1 and _changed(far, near, sizes) == _changed(near, sizes, sizes):
                slopes.append(math.log(near["median_ms"] / far["median_ms"]) / math.log(step))
        # the nearest of the farther rows: smaller ones only show overhead
        estimates.append(near["median_ms"] * factor ** min(2.0, max(1.0, slopes[min(1, len(slopes) - 1)])))
    return min(estimates, default=None)


def memory_bytes(rows: list[dict], op: str, program: str, direction: str, point: Point, sizes: dict) -> float:
    """Predicted memory [bytes]: grown from the nearest smaller row where memory was measured, else counted on paper.

    On paper: gradients and two moments; per view record, gradient and sort buffers; twenty numbers a pixel. The
    parameters themselves come on top of both, because what was measured leaves the inputs out.
    """
    parameters = 4 * point.count * (11 + 3 * (point.degree + 1) ** 2) if "N" in sizes else 0
    for factor, row in _smaller(rows, op, program, direction, sizes):
        if "peak_bytes" in row:
            return parameters + row["peak_bytes"] * factor
    views = 400 * point.count * point.cameras if "N" in sizes else 0
    return 4 * parameters + views + 80 * point.pixels * point.cameras


def reason_to_skip(
    rows: list[dict], op: str, program: str, direction: str, point: Point, sizes: dict, free: float
) -> str | None:
    """Return why a task should not run, or None."""
    predicted = time_ms(rows, op, program, direction, sizes)
    if predicted is not None and predicted > LIMIT_MS:
        return f"predicted {predicted / 1000:.2g} s a repeat, above {LIMIT_MS / 1000:g} s"
    needed = memory_bytes(rows, op, program, direction, point, sizes)
    if needed > free:
        return f"predicted {needed / 2**30:.2g} GiB, free {free / 2**30:.2g} GiB"
    return None
