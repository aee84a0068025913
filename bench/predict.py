"""What a measurement will take, foretold from smaller ones, so that hopeless ones are left out and said to be."""

from __future__ import annotations

import math

import torch

from bench.points import Point, growth
from warpgs.kernels.tiles import available_bytes

LIMIT_MS = 2000.0
"""Longest time of one repeat that is still measured [ms]."""


def _series(rows: list[dict], op: str, program: str, direction: str, sizes: dict) -> list[tuple[float, dict]]:
    """Rows of the same task at smaller sizes with the factor from there to ``sizes``, the nearest first."""
    same = [r for r in rows if (r["op"], r["program"], r["direction"]) == (op, program, direction)]
    factors = [(growth(r, sizes), r) for r in same]
    return sorted(((f, r) for f, r in factors if f is not None), key=lambda pair: pair[0])


def time_ms(rows: list[dict], op: str, program: str, direction: str, sizes: dict) -> float | None:
    """Predicted time of a repeat [ms]; None where nothing smaller was measured.

    From the nearest smaller row, linear at least: if the next smaller one shows a steeper growth, that goes on, up to
    quadratic. Small sizes are mostly overhead, so this errs on the high side there, where it does no harm.
    """
    smaller = _series(rows, op, program, direction, sizes)
    if not smaller:
        return None
    factor, nearest = smaller[0]
    exponent = 1.0
    for other_factor, other in smaller[1:]:
        if other_factor > factor and growth(other, nearest) is not None:
            slope = math.log(nearest["median_ms"] / other["median_ms"]) / math.log(other_factor / factor)
            exponent = min(2.0, max(1.0, slope))
            break
    return nearest["median_ms"] * factor**exponent


def memory_bytes(rows: list[dict], op: str, program: str, direction: str, point: Point, sizes: dict) -> float:
    """Predicted memory [bytes]: grown from the nearest smaller row where memory was measured, else counted on paper.

    On paper: parameters, gradients and two moments; per view record, gradient and sort buffers; twenty numbers a pixel.
    """
    for factor, row in _series(rows, op, program, direction, sizes):
        if "peak_bytes" in row:
            return row["peak_bytes"] * factor
    parameters = 16 * point.count * (11 + 3 * (point.degree + 1) ** 2) if "N" in sizes else 0
    views = 400 * point.count * point.cameras if "N" in sizes else 0
    return parameters + views + 80 * point.pixels * point.cameras


def reason_to_skip(
    rows: list[dict], op: str, program: str, direction: str, point: Point, sizes: dict, free: float
) -> str | None:
    """Why a task should not run, or None."""
    predicted = time_ms(rows, op, program, direction, sizes)
    if predicted is not None and predicted > LIMIT_MS:
        return f"predicted {predicted / 1000:.2g} s a repeat, above {LIMIT_MS / 1000:g} s"
    needed = memory_bytes(rows, op, program, direction, point, sizes)
    if needed > free:
        return f"predicted {needed / 2**30:.2g} GiB, free {free / 2**30:.2g} GiB"
    return None


def free_bytes(device: torch.device) -> int:
    """Memory that is free now [bytes]; that of files kept in memory counts as free on a CPU where the system says so."""
    if device.type == "cpu":
        try:
            with open("/proc/meminfo") as f:
                return next(int(line.split()[1]) * 1024 for line in f if line.startswith("MemAvailable"))
        except (OSError, StopIteration):
            pass
    return available_bytes(device)
