"""Tables of other rasterizers beside ours for the pages: time, memory, many channels, steps, and errors of gradients."""

from __future__ import annotations

from bench.lib.gradient_errors import TENSORS
from bench.lib.rasterizers import ATOMIC, OURS
from bench.lib.tables import figure, markdown

LEFT = ("Gaussians, image", "program")
DIRECTIONS = ("image", "forward", "both")
ALIKE = 0.95
"""Figures above this fraction of ours count as ours."""


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


def _e(value: float) -> str:
    return f"{value:.1e}" if value else "0"


def _worst(own: dict[str, dict], key: str) -> float:
    """Return the figure of the tensor where it is farthest from 0."""
    return max((own[t][key] for t in TENSORS), key=abs)


def gradients_table(result: dict) -> str:
    """Return the errors of gradients by scene and other program, ours under its cut-offs, and where ours are not the lowest."""
    body, behind = [], []
    groups: dict[tuple[str, str], dict[str, dict[str, dict]]] = {}
    for r in result["rows"]:
        groups.setdefault((r["scene"], r["rule"]), {}).setdefault(r["program"], {})[r["tensor"]] = r
    for (scene, _), programs in groups.items():
        ours = programs[OURS]
        for who, own in ((w, o) for w, o in programs.items() if w not in (OURS, ATOMIC)):
            cells = [_e(_worst(of, k)) for k in ("p99", "largest", "one_minus_cosine") for of in (ours, own)]
            body.append([scene, who, *cells, *(f"{_worst(of, 'bias'):+.1e}" for of in (ours, own))])
            behind += [
                f"{t} of `{scene}` ({who} {_e(own[t]['p99'])}, ours {_e(ours[t]['p99'])})"
                for t in TENSORS
                if own[t]["p99"] < ALIKE * ours[t]["p99"]
            ]
    head = ["scene", "other program"]
    head += [words for what in ("p99", "largest", "1 - cosine", "bias") for words in (f"{what}: warpgs", "other")]
    said = "For each tensor, our p99 is lowest or within 5 % of the lowest"
    said += f", except: {'; '.join(behind)}." if behind else "."
    judge = max(result["judge"].values())
    said += f" Our float64 pass is within {_e(judge)} (relative L2) of torch's derivative of a plain program."
    return markdown(head, body, head[:2]) + f"\n{said}\n"
