"""Write docs/performance.md and its charts from bench/results/ops_*.json; the same results give the same bytes.

usage: python -m bench.document
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable

from bench import result_file
from bench.harness import DISTURBED, OURS
from bench.plot import Line, Panel, chart
from bench.points import BASE, DIAGONAL
from bench.series import SIZES, Series, along, diagonal, exponent, tasks

COLORS = {
    "project": 0, "sh": 1, "tiles": 2, "blend": 3, "ssim": 4, "adam": 5, "knn": 6,
    "render forward": 0, "render both": 1, "step step": 2,
}  # fmt: skip
WORDS = ("op", "program", "direction", "peer", "bound by", "reason")
"""Columns that hold words."""
INTRODUCTION = """# Performance

Written by `python -m bench.document` from `bench/results/ops_*.json`; do not edit. To measure a machine:

<!-- docs-run: hours, or a GPU -->
```bash
python -m bench.ops --out bench/results/ops_MACHINE.json   # CUDA where there is a device; --device cpu, --budget SECONDS
python -m bench.document
```

Times are wall times in ms of one call with its inputs loaded, from an idle device to an idle device: the median, whose
quartiles stand in the results. Programs that are compared run in turn, one repeat each, unless one is over 30 times slower.
`both` is forward and backward together, `step` a training step: rendering, loss, backward pass, Adam. A star marks figures
during which other programs kept more than 0.2 cores busy, also on a second try.

The scene is a random cloud whose Gaussians shrink as their number grows, rendered under rule `exact`. One size varies at a time
around 100,000 Gaussians, 504 x 378 px, degree 3, one camera; a few points let Gaussians and image grow together. The tables
have that point and those (an op that depends on one of the two sizes takes that one); the charts, and the results, have all.

Other programs: `torch conv2d` is SSIM as most trainers write it, `torch dense` a rasterizer without tiles in plain torch, up
to 1,000 Gaussians, `naive` a kernel with one thread per pixel, `numpy` the paths of a sweep, a line at a time in numpy,
`gsplat` that package with `packed=False`, `gsplat + torch` a step made of its rendering, the loss in plain torch and torch's
fused Adam.
"""


def figure(value: float) -> str:
    """Three significant digits, never with an exponent."""
    if value >= 999.5:
        return f"{value:,.0f}"
    return f"{float(f'{value:.3g}'):.10f}".rstrip("0").rstrip(".")


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table: words to the left, figures to the right."""
    lines = [head, ["---" if name in WORDS else "---:" for name in head], *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


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


def _size_table(rows: list[dict], cell: Callable[[dict], str]) -> str:
    """Return a table of all tasks by the base point and those along the diagonal; an op takes of a point what it depends on."""
    points = sorted({(BASE.count, BASE.width, BASE.height), *DIAGONAL[2:]})
    body = []
    for op, program, direction in tasks(rows):
        own = [r for r in rows if (r["op"], r["program"], r["direction"]) == (op, program, direction) and _plain(r)]
        found = [next((r for r in own if r.get("N", n) == n and r.get("width", w) == w), None) for n, w, _ in points]
        if any(found):
            body.append([op, direction, program, *("" if r is None else cell(r) for r in found)])
    head = ["op", "direction", "program", *(f"{n:,}, {w} x {h}" for n, w, h in points)]
    used = [k for k, name in enumerate(head) if name in WORDS or any(row[k] for row in body)]
    return table([head[k] for k in used], [[row[k] for k in used] for row in body])


def op_tables(rows: list[dict]) -> str:
    """Return the table of times; on CUDA, a second one of memory."""
    text = _size_table(rows, _timing)
    if any("peak_bytes" in r for r in rows):
        memory = _size_table(rows, lambda r: figure(r["peak_bytes"] / 2**20))
        text += f"\nPeak device memory above the inputs [MiB]:\n\n{memory}"
    return text


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
    return table(["op", "direction", *columns, "peer", "peer [ms]", "warpgs [ms]", "peer / warpgs"], body) if body else ""


def roof_table(rows: list[dict]) -> str:
    """Our own tasks against the roof, where each was measured at its heaviest."""
    body = []
    for op, program, direction in tasks(rows):
        own = [r for r in rows if (r["op"], r["program"], r["direction"]) == (op, program, direction) and "roof_ms" in r]
        own = [r for r in own if _plain(r)] or own
        if own:
            r = max(own, key=lambda r: r["roof_ms"])
            cells = [op, direction, *_sizes(r, ["N", "image"])]
            cells += [figure(r["bytes"] / 1e6), figure(r["operations"] / 1e6), figure(r["roof_ms"]), r["bound"]]
            body.append([*cells, figure(r.get("gpu_ms", r["median_ms"])), f"{figure(100 * r['fraction'])} %"])
    head = ["op", "direction", "N", "image", "MB", "Mop", "roof [ms]", "bound by", "measured [ms]", "fraction"]
    return table(head, body)


def exponent_table(rows: list[dict]) -> str:
    """Local exponents of time over the last decade of N and of pixels."""
    over = {axis: {(s.op, s.program, s.direction): s for s in along(rows, axis)} for axis in ("N", "pixels")}
    body = []
    for task in tasks(rows):
        cells = []
        for axis in ("N", "pixels"):
            series = over[axis].get(task)
            value = exponent(series.points) if series else None
            cells += ["", ""] if value is None else [f"{value:.2f}", f"{series.points[-1][0]:,.0f}"]
        if any(cells):
            body.append([*task, *cells])
    return table(["op", "program", "direction", "over N", "up to N", "over pixels", "up to pixels"], body)


def skipped_words(skipped: list[dict]) -> str:
    """Return the tasks that were not measured at some sizes, with their number."""
    counts = Counter((r["op"], r["program"], r["direction"]) for r in skipped)
    return ", ".join(f"{' '.join(task)} {count}" for task, count in counts.items())


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
    parts = [
        f"## {machine['name']} ({stem})\n",
        f"{facts}. {versions}. Commit {result['commit']}, {result['date']}, {result['repeats']} repeats."
        + (f" {result['note'].rstrip('.')}." if result.get("note") else "")
        + f" Results: `bench/results/ops_{stem}.json`.\n",
        *(f"![{name} of {stem}](plots/{stem}_{name}.svg)\n" for name in plots),
        "### Times by number of Gaussians and image [ms]\n",
        op_tables(rows),
    ]
    if peers := peer_table(rows):
        parts += ["### Beside other programs\n", peers]
    if result.get("absent"):
        reasons = "; ".join(f"{name}: {reason}" for name, reason in sorted(result["absent"].items()))
        parts.append(f"Not measured, because not there or not working: {reasons}.\n")
    parts += [
        "### How steeply time grows\n",
        "Slope of log time over log size through the last decade of sizes: 1 is linear, below 1 overhead still counts.\n",
        exponent_table(rows),
        "### Roofline\n",
        f"Ceilings measured at the start: {roof['bytes_per_s'] / 1e9:,.1f} GB/s and {roof['operations_per_s'] / 1e9:,.0f} "
        f"Gop/s ({roof['how']}). Bytes and operations are the least a stage has to do, counted as `bench/roofline.py` says; "
        "the fraction is the time at the roof over the time measured"
        + (" by GPU events" if machine["device"] == "cuda" else "")
        + ". Data that fits into caches can exceed 100 %.\n",
        roof_table(rows),
    ]
    if result["skipped"]:
        parts.append(f"Sizes left out for the time they take (reasons in the results): {skipped_words(result['skipped'])}.\n")
    return "\n".join(parts)


def generate(results: dict[str, dict]) -> dict[str, str]:
    """All files, by path under docs/, from results by machine."""
    files, sections = {}, [INTRODUCTION]
    for stem, result in sorted(results.items()):
        machine = result["machine"]
        name = machine["name"] if machine["device"] == "cuda" else f"{machine['name']}, {machine['threads']} threads"
        plots = charts(name, result["rows"])
        files |= {f"plots/{stem}_{kind}.svg": svg for kind, svg in plots.items()}
        sections.append(machine_text(stem, result, list(plots)))
    return files | {"performance.md": "\n".join(sections)}


def committed() -> dict[str, dict]:
    """Return the kept results by machine."""
    return result_file.stored("ops")


def main() -> None:
    """Write the files."""
    for path, text in generate(committed()).items():
        target = result_file.ROOT / "docs" / path
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_text(text, "utf-8", newline="\n")


if __name__ == "__main__":
    main()
