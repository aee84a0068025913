"""Tables of other rasterizers beside ours for the pages: time, memory, many channels, steps, and errors of gradients."""

from __future__ import annotations

from bench.lib.buffers import BLEND, PROJECT, Counts, at_most, buffers
from bench.lib.gradient_errors import TENSORS
from bench.lib.rasterizers import ATOMIC, FAST_MATH, GSPLAT, OURS
from bench.lib.tables import figure, markdown

LEFT = ("Gaussians, image", "program", "scene", "cut-offs", "buffer")
DIRECTIONS = ("image", "forward", "both")
MIB = 2**20
ALIKE = 0.95
"""Figures above this fraction of ours count as ours."""


def _size(row: dict) -> str:
    return row["configuration"].replace(" at ", ", ").replace("x", " x ")


def _of(result: dict, channels: int) -> list[dict]:
    return [r for r in result["rows"] if r["channels"] == channels]


def times_table(result: dict) -> str:
    """Return GPU time by direction, wall time of image and gradients, and peak memory of each program."""
    body = []
    for row in _of(result, 3):
        for who, peak in row["peak_mib"].items():
            gpu = [figure(row["gpu_ms"][d][who]["median"]) for d in DIRECTIONS]
            wall = [figure(row["wall_ms"][d][who]["median"]) for d in ("image", "both")]
            body.append([_size(row), who, *gpu, *wall, figure(peak)])
    head = ["Gaussians, image", "program", "image [ms]", "forward [ms]", "both [ms]", "wall: image [ms]", "both [ms]", "MiB"]
    return markdown(head, body, LEFT)


def channels_table(result: dict) -> str:
    """Return GPU time and memory of 32 channels, ours and gsplat's."""
    body = []
    for row in _of(result, 32):
        for who in (OURS, ATOMIC, GSPLAT):
            if who in row["peak_mib"]:
                gpu = [figure(row["gpu_ms"][d][who]["median"]) for d in DIRECTIONS]
                body.append([_size(row), who, *gpu, figure(row["peak_mib"][who])])
    return markdown(["Gaussians, image", "program", "image [ms]", "forward [ms]", "both [ms]", "MiB"], body, LEFT)


def steps_table(result: dict) -> str:
    """Return wall times of training steps, ours as a graph and gsplat's with torch."""
    body = []
    for row in _of(result, 3):
        ours, theirs = (row["step_wall_ms"][who]["median"] for who in (f"{OURS} graph", "gsplat"))
        body.append([_size(row), figure(ours), figure(theirs), f"{ours / theirs:.3f}"])
    return markdown(["Gaussians, image", "warpgs [ms]", "gsplat [ms]", "ratio"], body, LEFT)


def buffers_table(result: dict) -> str:
    """Return what each buffer costs [MiB] in each configuration, when it is held, and the sums beside measured peaks."""
    rows = _of(result, 3)
    counts = [Counts(r["gaussians"], r["visible"], r["instances"], r["width"], r["height"]) for r in rows]
    lists, body = [buffers(n) for n in counts], []
    for name in lists[0]:
        held = {(BLEND, PROJECT): "both", (BLEND,): "blending", (PROJECT,): "projection"}[lists[0][name][1]]
        body.append([name, held, *(figure(held_by[name][0] / MIB) for held_by in lists)])
    body.append(["sum at the larger moment", "", *(figure(at_most(n) / MIB) for n in counts)])
    body.append(["the same with atomic sums", "", *(figure(at_most(n, False) / MIB) for n in counts)])
    for who in (OURS, ATOMIC, GSPLAT):
        body.append([f"measured: {who}", "", *(figure(r["peak_mib"][who]) if who in r["peak_mib"] else "" for r in rows)])
    return markdown(["buffer", "held in", *map(_size, rows)], body, (*LEFT, "held in"))


def _e(value: float) -> str:
    return f"{value:.1e}" if value else "0"


def gradients_table(results: list[dict]) -> str:
    """Return the errors of gradients by scene, cut-offs and program, and where ours are not the lowest; the first has those."""
    body, behind = [], []
    groups: dict[tuple[str, str], dict[str, dict[str, dict]]] = {}
    for r in (row for result in results for row in result["rows"]):
        groups.setdefault((r["scene"], r["rule"]), {}).setdefault(r["program"], {})[r["tensor"]] = r
    for (scene, rule), programs in groups.items():
        for who, own in programs.items():
            worst = [max((own[t] for t in TENSORS), key=lambda r: abs(r[k])) for k in ("median", "largest", "one_minus_cosine")]
            bias = max((own[t]["bias"] for t in TENSORS), key=abs)
            cells = [_e(own[t]["p99"]) for t in TENSORS]
            figures = [_e(r[k]) for r, k in zip(worst, ("median", "largest", "one_minus_cosine"), strict=True)]
            body.append([scene, f"`{rule}`", who, *cells, *figures, f"{bias:+.1e}"])
            if who not in (OURS, ATOMIC, FAST_MATH):
                behind += [
                    f"{t} of `{scene}` ({who} {_e(own[t]['p99'])}, ours {_e(programs[OURS][t]['p99'])})"
                    for t in TENSORS
                    if own[t]["p99"] < ALIKE * programs[OURS][t]["p99"]
                ]
    head = ["scene", "cut-offs", "program", *(f"p99: {t}" for t in TENSORS), "median", "largest", "1 - cosine", "bias"]
    said = "Ours are lowest at every 99th percentile, or within 5 % of the lowest"
    said += f", but for: {'; '.join(behind)}." if behind else "."
    judge = max(results[0]["judge"].values())
    said += f" Our float64 pass is within {_e(judge)} (relative L2) of torch's derivative of a plain program."
    return markdown(head, body, LEFT) + f"\n{said}\n"
