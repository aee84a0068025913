"""The page docs/performance.md and its charts from bench/results/ops_*.json; the same results give the same bytes."""

from __future__ import annotations

import re
from collections import Counter

from bench.lib.plot import Line, Panel, chart
from bench.lib.points import BASE, DIAGONAL, SIZES, Point, Series, along, diagonal, exponent, tasks
from bench.lib.tables import figure, markdown
from bench.lib.timing import DISTURBED, OURS

COLORS = {
    "project": 0, "sh": 1, "tiles": 2, "blend": 3, "ssim": 4, "adam": 5, "knn": 6,
    "render forward": 0, "render both": 1, "step step": 2,
}  # fmt: skip
WORDS = ("op", "program", "direction", "peer", "bound by")
"""Columns that hold words."""
INTRODUCTION = """# Performance

Written by `python -m bench.document` from `bench/results/ops_*.json`; do not edit. To measure a machine:

<!-- docs-run: hours, or a GPU -->
```bash
python -m bench.kernels.ops --out bench/results/ops_MACHINE.json   # --device cpu, --budget SECONDS
python -m bench.document
```

Times are medians of wall times in ms of one call, inputs loaded, from an idle device to an idle device. Programs that are
compared run in turn, unless one is over 30 times slower. `both` is forward and backward together, `step` a training step:
rendering, loss, backward pass, Adam. A star: other programs kept more than 0.2 cores busy, also on a second try.

The scene is a random cloud under rule `exact`, degree 3, one camera; its Gaussians shrink as their number N grows. Columns of
tables name N and the image [px]; charts, and the results with quartiles, have more sizes. *Over N* and *over px* are slopes of
log time over log size through the last decade of sizes measured, around 100,000 Gaussians and 504 x 378 px: 1 is linear, below
1 overhead still counts.

Other programs: `torch conv2d` is SSIM as most trainers write it, `torch dense` a rasterizer without tiles in plain torch, up
to 1,000 Gaussians, `naive` a kernel with one thread per pixel, `numpy` a sweep's paths, a line at a time, `gsplat` that package
with `packed=False`, `gsplat + torch` a step of its rendering, the loss in plain torch and torch's fused Adam.

Roofline: the least bytes and operations of a stage, counted by `bench/lib/roofline.py`, over ceilings measured at the start
(the fastest of 30: triad of float32 arrays by torch.add, float32 multiply-adds in a Warp kernel). The fraction is the time
at the roof over the time measured, on a GPU by its events; data that fits into caches can exceed 100 %.
"""


def _sizes(row: dict, names: list[str]) -> list[str]:
    cells = []
    for name in names:
        if name == "image":
            cells.append(f"{row['width']} x {row['height']}" if "width" in row else "")
        else:
            cells.append(f"{row[name]:,}" if name in row else "")
    return cells


def _key(row: dict) -> tuple:
    return tuple(row.get(s, 0) for s in SIZES)


def _timing(row: dict | None) -> str:
    if row is None:
        return ""
    return figure(row["median_ms"]) + ("*" if row.get("others_cores", 0.0) > DISTURBED else "")


def _plain(row: dict) -> bool:
    """Return whether a row has the base's degree, one camera, and no number of threads of its own."""
    return row.get("degree", BASE.degree) == BASE.degree and row.get("cameras", 1) == 1 and "threads" not in row


def _at(row: dict, point: Point) -> bool:
    """Return whether a row was measured at a point, as far as its op depends on it."""
    same = row.get("N", point.count) == point.count
    return same and (row.get("width", point.width), row.get("height", point.height)) == (point.width, point.height)


def _measured(row: dict | None) -> str:
    """Return the time, and on CUDA the memory."""
    memory = f" / {figure(row['peak_bytes'] / 2**20)}" if row and "peak_bytes" in row else ""
    return _timing(row) + memory


def times_table(rows: list[dict]) -> str:
    """Tasks by sizes, of the base point and where Gaussians and image grow together, and the slopes along either size."""
    plain = [r for r in rows if _plain(r)]
    points = [Point(*sizes) for sizes in DIAGONAL[2:] if any(_at(r, Point(*sizes)) for r in plain)]
    over = {axis: {(s.op, s.program, s.direction): s.points for s in along(rows, axis)} for axis in ("N", "pixels")}
    body = []
    for op, program, direction in tasks(rows):
        own = [r for r in plain if (r["op"], r["program"], r["direction"]) == (op, program, direction)]
        cells = [_measured(next((r for r in own if _at(r, p)), None)) for p in points]
        slopes = [exponent(over[axis].get((op, program, direction), ())) for axis in over]
        cells += ["" if slope is None else f"{slope:.2f}" for slope in slopes]
        if any(cells):
            body.append([op, program, direction, *cells])
    sizes = [f"{p.count:,}; {p.width} x {p.height}" for p in points]
    return markdown(["op", "program", "direction", *sizes, "over N", "over px"], body, WORDS)


def peer_table(rows: list[dict]) -> str:
    """The largest size at which another program did the same work."""
    ours = {(r["op"], r["direction"], _key(r)): r for r in rows if r["program"] == OURS}
    peers = [r for r in rows if r["program"] != OURS and _plain(r) and (r["op"], r["direction"], _key(r)) in ours]
    columns, body = ["N", "image"], []
    for op, program, direction in sorted(tasks(peers), key=lambda t: (t[0], t[2], t[1])):
        r = max((r for r in peers if (r["op"], r["program"], r["direction"]) == (op, program, direction)), key=_key)
        mine = ours[r["op"], r["direction"], _key(r)]
        ratio = figure(r["median_ms"] / mine["median_ms"])
        body.append([op, direction, *_sizes(r, columns), program, _timing(r), _timing(mine), ratio])
    head = ["op", "direction", *columns, "peer", "peer [ms]", "warpgs [ms]", "peer / warpgs"]
    return markdown(head, body, WORDS) if body else ""


def roof_table(rows: list[dict]) -> str:
    """Our own tasks against the roof, where each was measured at its heaviest."""
    body = []
    for op, program, direction in tasks(rows):
        own = [r for r in rows if (r["op"], r["program"], r["direction"]) == (op, program, direction) and "roof_ms" in r]
        own = [r for r in own if _plain(r)] or own
        if own:
            r = max(own, key=lambda r: r["roof_ms"])
            cells = [op, direction, *_sizes(r, ["N", "image"])]
            cells += [r["bound"], figure(r["roof_ms"]), figure(r.get("gpu_ms", r["median_ms"]))]
            body.append([*cells, f"{figure(100 * r['fraction'])} %"])
    return markdown(["op", "direction", "N", "image", "bound by", "roof [ms]", "measured [ms]", "fraction"], body, WORDS)


def skipped_list(skipped: list[dict]) -> str:
    """Return a list of the reasons, the first of each kind, with the tasks not measured and at how many sizes."""
    groups: dict[str, tuple[str, Counter]] = {}
    for r in skipped:
        _, counts = groups.setdefault(re.sub(r"[\d.]+", "", r["reason"]), (r["reason"], Counter()))
        counts[f"{r['op']} {r['direction']} ({r['program']})"] += 1
    lines = (f"- {why}: " + ", ".join(f"{n} of {task}" for task, n in counts.items()) for why, counts in groups.values())
    return "\n".join(lines) + "\n"


def _lines(series: list[Series], name) -> tuple[Line, ...]:
    lines = []
    for s in series:
        color = COLORS.get(f"{s.op} {s.direction}", COLORS.get(s.op, 7))
        lines.append(Line(name(s), s.points, color, dashed=s.program != OURS))
    return tuple(lines)


def charts(title: str, rows: list[dict]) -> dict[str, str]:
    """Charts of one machine by the end of their names: over N, over pixels, and of the whole image and step."""

    def op_name(s: Series) -> str:
        return s.op if s.program == OURS else s.program

    def whole_name(s: Series) -> str:
        own = {"forward": "image", "both": "image + gradients", "step": "training step"}[s.direction]
        return own if s.program == OURS else {"forward": s.program, "both": f"{s.program} + gr."}.get(s.direction, s.program)

    whole = ("render", "step")
    over_n, over_pixels, both = along(rows, "N"), along(rows, "pixels"), diagonal(rows)
    made = {}
    for name, series, label, what in (
        ("gaussians", over_n, "Gaussians", "ops over the number of Gaussians"),
        ("pixels", over_pixels, "pixels of the image", "ops over the number of pixels"),
    ):
        panels = [
            Panel(direction, label, "time of one call [ms]", _lines(chosen, op_name))
            for direction in ("forward", "backward")
            if (chosen := [s for s in series if s.op not in whole and s.direction == direction])
        ]
        if panels:
            made[name] = chart(f"{title}: {what}", panels)
    panels = [
        Panel("Gaussians into 504 x 378 px", "Gaussians", "time of one call [ms]", _lines(
            [s for s in over_n if s.op in whole], whole_name)),
        Panel("Gaussians and image grow together", "Gaussians", "time of one call [ms]", _lines(
            [s for s in both if s.op in whole], whole_name)),
    ]  # fmt: skip
    if any(p.lines for p in panels):
        made["whole"] = chart(f"{title}: image and training step", panels)
    return made


def machine_text(stem: str, result: dict, plots: list[str]) -> str:
    """The section of one machine."""
    versions = ", ".join(f"{k} {v}" for k, v in result["versions"].items())
    machine = result["machine"]
    facts = f"{machine['processor']}, {machine['cores']} cores, {machine['threads']} threads, {machine['memory_gib']} GiB"
    if machine["device"] == "cuda":
        facts = f"{machine['name']} ({machine['device_memory_gib']} GiB) beside {facts}"
    roof, rows = result["roofline"], result["rows"]
    memory = ""
    if busy := [r["gpu_ms"] / r["median_ms"] for r in rows if "gpu_ms" in r and "median_ms" in r]:
        memory = " / peak memory above the inputs [MiB]"
        memory += f". The GPU's own time, kept in the results, is {min(busy):.0%} to {max(busy):.0%} of the wall time"
    parts = [
        f"## {machine['name']} ({stem})\n",
        f"{facts}. {versions}. Commit {result['commit']}, {result['date']}, {result['repeats']} repeats."
        + (f" {result['note'].rstrip('.')}." if result.get("note") else "")
        + f" Results: `bench/results/ops_{stem}.json`.\n",
        *(f"![{name} of {stem}](plots/{stem}_{name}.svg)\n" for name in plots),
        f"### Times\n\nWall time [ms]{memory}.\n",
        times_table(rows),
    ]
    if peers := peer_table(rows):
        parts += ["### Beside other programs\n\nAt the largest size that both programs did.\n", peers]
    if result.get("absent"):
        reasons = "; ".join(f"{name}: {reason}" for name, reason in sorted(result["absent"].items()))
        parts.append(f"Not measured, because not there or not working: {reasons}.\n")
    ceilings = f"{roof['bytes_per_s'] / 1e9:,.1f} GB/s and {roof['operations_per_s'] / 1e9:,.0f} Gop/s"
    parts += [f"### Roofline\n\nCeilings: {ceilings}. Each task at its heaviest.\n", roof_table(rows)]
    if result["skipped"]:
        parts += ["### Not measured\n\nThe reason at the first of its kind, and the number of sizes.\n"]
        parts.append(skipped_list(result["skipped"]))
    return "\n".join(parts)


def files(results: dict[str, dict]) -> dict[str, str]:
    """Return all files, by path under docs/, from results by machine."""
    made, sections = {}, [INTRODUCTION]
    for stem, result in sorted(results.items()):
        machine = result["machine"]
        name = machine["name"] if machine["device"] == "cuda" else f"{machine['name']}, {machine['threads']} threads"
        plots = charts(name, result["rows"])
        made |= {f"plots/{stem}_{kind}.svg": svg for kind, svg in plots.items()}
        sections.append(machine_text(stem, result, list(plots)))
    return made | {"performance.md": "\n".join(sections)}
