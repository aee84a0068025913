"""Tables of other rasterizers beside ours for the pages: time, memory, many channels and steps."""

from __future__ import annotations

from bench.lib.rasterizers import OURS
from bench.lib.tables import figure, markdown

LEFT = ("Gaussians, image", "program")
DIRECTIONS = ("image", "forward", "both")


def _size(row: dict) -> str:
    return row["configuration"].replace(" at ", ", ").replace("x", " x ")


def _of(result: dict, channels: int) -> list[dict]:
    return [r for r in result["rows"] if r["channels"] == channels]


def times_table(result: dict, channels: int = 3) -> str:
    """Return GPU and wall time by direction, and peak memory, of each program that took ``channels``."""
    body = []
    for row in _of(result, channels):
        for who, peak in row["peak_mib"].items():
            times = [figure(row[kind][d][who]["median"]) for kind in ("gpu_ms", "wall_ms") for d in DIRECTIONS]
            body.append([_size(row), who, *times, figure(peak)])
    times = [f"{kind}: {DIRECTIONS[0]} [ms]" for kind in ("GPU", "wall")]
    rest = [f"{d} [ms]" for d in DIRECTIONS[1:]]
    return markdown(["Gaussians, image", "program", times[0], *rest, times[1], *rest, "MiB"], body, LEFT)


def gpu_table(result: dict, programs: tuple[str, ...]) -> str:
    """Return GPU time by direction of each of some programs that took three channels."""
    body = [
        [_size(row), who, *(figure(row["gpu_ms"][d][who]["median"]) for d in DIRECTIONS)]
        for row in _of(result, 3) for who in row["peak_mib"] if who in programs
    ]  # fmt: skip
    return markdown(["Gaussians, image", "program", *(f"{d} [ms]" for d in DIRECTIONS)], body, LEFT)


def steps_table(result: dict) -> str:
    """Return wall times of training steps, ours as a graph and gsplat's with torch."""
    body = []
    for row in _of(result, 3):
        ours, theirs = (row["step_wall_ms"][who]["median"] for who in (f"{OURS} graph", "gsplat"))
        body.append([_size(row), figure(ours), figure(theirs), f"{ours / theirs:.3f}"])
    return markdown(["Gaussians, image", "warpgs [ms]", "gsplat [ms]", "ratio"], body, LEFT)
