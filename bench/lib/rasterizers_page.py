"""Tables of other rasterizers beside ours for the page: time, memory and steps."""

from __future__ import annotations

from bench.lib.rasterizers import OURS
from bench.lib.tables import figure, markdown

LEFT = ("Gaussians, image", "program")
DIRECTIONS = ("image", "both")
"""Results also have the forward pass that keeps what the backward pass needs."""


def _size(row: dict) -> str:
    return row["configuration"].replace(" at ", ", ").replace("x", " x ")


def _colours(result: dict) -> list[dict]:
    return [r for r in result["rows"] if r["channels"] == 3]


def times_table(result: dict) -> str:
    """Return GPU and wall time by direction, and peak memory, of each program with three channels."""
    body = []
    for row in _colours(result):
        for place, (who, peak) in enumerate(row["peak_mib"].items()):
            times = [figure(row[kind][d][who]["median"]) for kind in ("gpu_ms", "wall_ms") for d in DIRECTIONS]
            body.append(["" if place else _size(row), who, *times, figure(peak)])
    times = [f"{kind}: {d} [ms]" for kind in ("GPU", "wall") for d in DIRECTIONS]
    return markdown(["Gaussians, image", "program", *times, "MiB"], body, LEFT)


def steps_table(result: dict) -> str:
    """Return wall times of training steps, ours as a graph and gsplat's with torch."""
    body = []
    for row in _colours(result):
        ours, theirs = (row["step_wall_ms"][who]["median"] for who in (f"{OURS} graph", "gsplat"))
        body.append([_size(row), figure(ours), figure(theirs), f"{ours / theirs:.3f}"])
    return markdown(["Gaussians, image", "warpgs [ms]", "gsplat [ms]", "ratio"], body, LEFT)
