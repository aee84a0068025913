"""The generated parts of docs/performance.md and its charts from bench/results; the same results give the same bytes."""

from __future__ import annotations

import statistics

from bench.lib import rasterizers_page, result_file, score_times
from bench.lib.plot import Line, Panel, chart
from bench.lib.points import BASE, Point, Series, along, diagonal, tasks
from bench.lib.tables import figure, markdown
from bench.lib.timing import DISTURBED, OURS

COLORS = {
    "project": 0, "sh": 1, "tiles": 2, "blend": 3, "ssim": 4, "adam": 5, "knn": 6,
    "render forward": 0, "render both": 1, "step step": 2,
}  # fmt: skip
WORDS = ("op", "direction", "machine", "Gaussians, image", "capture")
"""Columns that hold words."""


def _sources(kind: str, results: dict[str, dict]) -> str:
    return "\n" + "\n".join(result_file.source(f"{kind}_{stem}") for stem in results)


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


def _find(result: dict, task: tuple[str, str, str], point: Point) -> dict | None:
    """Return the row of a task (op, program, direction) at a point."""
    rows = (r for r in result["rows"] if (r["op"], r["program"], r["direction"]) == task)
    return next((r for r in rows if _plain(r) and _at(r, point)), None)


def fits_table(results: dict[str, dict]) -> str:
    """Return medians of whole commands by capture and machine."""
    body = []
    for name, scene, words in (
        ("rows_h200", "fern:3", "fern, 3 photographs of 504 x 378 px, H200"),
        ("rows_h200", "temple:4", "temple, 4 photographs of 640 x 480 px, H200"),
        ("wall_h200", "fox llff:8", "fox, 8 photographs of 1080 x 1920 px, H200"),
        ("rows_h200", "fox:8", "fox, 8 photographs of 270 x 480 px, H200"),
        ("dense_h200", "fox:all", "fox, 43 photographs of 270 x 480 px, H200"),
        ("dense_h200", "horns:54", "horns, 54 photographs of 504 x 378 px, H200"),
        ("fern_cpu2", "fern llff:3", "fern, 3 photographs of 504 x 378 px, 2 cores"),
        ("temple_cpu2", "", "temple, 12 photographs of 640 x 480 px, 2 cores"),
    ):
        rows = [r for r in results[name]["rows"] if r["side"] == "new" and scene in ("", r.get("scene"))]
        middle = {key: statistics.median(r[key] for r in rows) for key in ("setup", "training", "wall", "psnr")}
        body.append([words, f"{rows[0]['steps']:,}", *(f"{middle[k]:.0f}" for k in ("setup", "training", "wall"))])
        body[-1].append(f"{middle['psnr']:.2f}")
    return markdown(["capture", "steps", "start [s]", "training [s]", "whole command [s]", "PSNR [dB]"], body, WORDS)


def _roof(rows: list[dict], op: str, direction: str) -> str:
    """Return the percentage of the roof of one of our tasks, where it was measured at its heaviest."""
    own = [r for r in rows if (r["op"], r["program"], r["direction"]) == (op, OURS, direction) and "roof_ms" in r and _plain(r)]
    return figure(100 * max(own, key=lambda r: r["roof_ms"])["fraction"]) if own else ""


def ops_table(results: dict[str, dict]) -> str:
    """Return time and fraction of the roof of each of our tasks at the base size, by machine."""
    every = [task for result in results.values() for task in tasks(result["rows"]) if task[1] == OURS]
    head, body = ["op"], []
    for result in results.values():
        head += [f"{result_file.machine_name(result)} [ms]", "of the roof [%]"]
    for op, _, direction in dict.fromkeys(every):
        cells = [f"{op} {direction}"]
        for result in results.values():
            cells += [_timing(_find(result, (op, OURS, direction), BASE)), _roof(result["rows"], op, direction)]
        body.append(cells)
    return markdown(head, body, WORDS)


def _lines(series: list[Series], name) -> tuple[Line, ...]:
    lines = []
    for s in series:
        color = COLORS.get(f"{s.op} {s.direction}", COLORS.get(s.op, 7))
        lines.append(Line(name(s), s.points, color, dashed=s.program != OURS))
    return tuple(lines)


def charts(title: str, rows: list[dict]) -> dict[str, str]:
    """Return the charts of one machine by the end of their names: over N, over pixels, and of the whole image and step."""

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


def plots(results: dict[str, dict]) -> dict[str, str]:
    """Return all charts by path under docs/, from results by machine."""
    made = {}
    for stem, result in sorted(results.items()):
        machine = result["machine"]
        name = machine["name"] if machine["device"] == "cuda" else f"{machine['name']}, {machine['threads']} threads"
        made |= {f"plots/{stem}_{kind}.svg": svg for kind, svg in charts(name, result["rows"]).items()}
    return made


def time_to_score() -> dict[str, str]:
    """Return charts of PSNR against wall time by path under docs/, two scenes in each."""
    rows = next(iter(result_file.stored("time_to_score").values()))["rows"]
    scenes = list(dict.fromkeys(r["row"] for r in rows))
    pairs = (scenes[i : i + 2] for i in range(0, len(scenes), 2))
    made = (score_times.picture([r for r in rows if r["row"] in pair]) for pair in pairs)
    return {f"plots/time_to_score_{i}.svg": svg for i, svg in enumerate(made, 1)}


def parts() -> dict[str, str]:
    """Return the generated parts of docs/performance.md by name."""
    ops, others, steps, turns = (result_file.stored(kind) for kind in ("ops", "rasterizers", "training_steps", "turns"))
    times = result_file.stored("time_to_score")
    beside = next(iter(others.values()))
    return {
        "rasterizers": rasterizers_page.times_table(beside) + _sources("rasterizers", others),
        "steps": rasterizers_page.steps_table(next(iter(steps.values()))) + _sources("training_steps", steps),
        "whole fits": fits_table(turns) + _sources("turns", turns),
        "time to score": score_times.table(next(iter(times.values()))["rows"]) + _sources("time_to_score", times),
        "ops": ops_table(ops) + _sources("ops", ops),
    }
