"""Cost against error as SVG, with Pareto fronts; dominated points are hollow, presets have names."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from bench.lib.plot import PALETTE, PLOT_WIDTH, SMALL, grid, spread, svg, text

PLOT_HEIGHT = 250
LEFT, RIGHT, TOP, BOTTOM = 66, 150, 76, 66
FAR = 5.0
"""Points that cost this many times the least are listed below the plot instead of shown, if they are few, because they would
compress the rest. On a linear axis, so are values worse than those of front and presets by over `BEHIND` times their range."""
BEHIND = 2.0
FEW = 2
HEAD, LEGEND = 40, 22
"""Height of the title and for the line that explains the colours [px]."""


@dataclass(frozen=True)
class Point:
    """One setting."""

    name: str
    knob: str
    """Name of the changed setting, which determines the colour."""
    cost: float
    """Cost, above 0; less is better."""
    value: float
    """Value; above 0 on a logarithmic axis; less is better unless the panel sets ``upwards``."""
    bar: float = 0.0
    """Half the interval of the value."""
    preset: bool = False


@dataclass(frozen=True)
class Panel:
    """One pair of axes: cost and, on request, value are logarithmic."""

    title: str
    what: str
    """Title line of the panel."""
    x_label: str
    y_label: str
    points: tuple[Point, ...]
    upwards: bool = False
    """True if more is better."""
    log_y: bool = True


def front(points: Sequence[Point], upwards: bool = False) -> list[Point]:
    """Return the points that no other point beats: cheaper and at least as good, or better at no higher cost."""
    sign, kept = (-1.0 if upwards else 1.0), []
    for p in sorted(points, key=lambda p: (p.cost, sign * p.value)):
        if not kept or sign * p.value < sign * kept[-1].value:
            kept.append(p)
    return kept


def _ticks(low: float, high: float, log: bool) -> list[float]:
    if not log:
        step = 10 ** math.floor(math.log10(max(high - low, 1e-9)))
        step *= next(k for k in (0.1, 0.2, 0.5, 1, 2) if (high - low) / (step * k) <= 7)
        return [step * k for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
    first, last = math.floor(math.log10(low)), math.ceil(math.log10(high))
    marks = (1,) if last - first > 3 else (1, 2, 5)
    every = max(1, (last - first) // 6)
    return [m * 10.0**e for e in range(first, last + 1, every) for m in marks if low <= m * 10.0**e <= high]


def _behind(point: Point, panel: Panel, best: Sequence[Point]) -> bool:
    if panel.log_y:
        return False
    values = [p.value for p in panel.points if p in best or p.preset]
    low, high = min(values), max(values)
    margin = BEHIND * (high - low)
    if margin == 0:
        return False
    return point.value < low - margin if panel.upwards else point.value > high + margin


def _mark(point: Point, x: float, y: float, color: str, filled: bool) -> str:
    style = f'fill="{color if filled else "#ffffff"}" stroke="{color}" stroke-width="1.8"'
    if point.preset:
        return f'<rect x="{x - 5:.1f}" y="{y - 5:.1f}" width="10" height="10" {style}/>'
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" {style}/>'


def _panel(panel: Panel, left: float, top: float, colors: dict[str, str]) -> list[str]:
    best, out = front(panel.points, panel.upwards), []
    least = min(p.cost for p in panel.points)
    far = [p for p in panel.points if p.cost > FAR * least or _behind(p, panel, best)]
    far = far if len(far) <= FEW else []
    points = [p for p in panel.points if p not in far]
    costs = [p.cost for p in points]
    values = [v for p in points for v in (p.value - p.bar, p.value + p.bar)]
    x_low, x_high = min(costs) / 1.08, max(costs) * 1.08
    if panel.log_y:
        y_low, y_high = min(p.value for p in points) / 1.4, max(p.value for p in points) * 1.4
    else:
        margin = 0.06 * (max(values) - min(values)) or 1.0
        y_low, y_high = min(values) - margin, max(values) + margin

    def px(x: float) -> float:
        return left + PLOT_WIDTH * math.log(x / x_low) / math.log(x_high / x_low)

    def py(y: float) -> float:
        fraction = math.log(y / y_low) / math.log(y_high / y_low) if panel.log_y else (y - y_low) / (y_high - y_low)
        return top + PLOT_HEIGHT * (1 - fraction)

    bottom = top + PLOT_HEIGHT
    out.append(text(left, top - 41, panel.title, size=13, bold=True))
    out.append(text(left, top - 25, panel.what, size=11, color="#666666"))
    out.append(text(left, top - 9, panel.y_label, size=11, color="#666666"))
    ys = [(py(y), f"{y:.3g}") for y in _ticks(y_low, y_high, panel.log_y)]
    xs = [(px(x), f"{x:.3g}") for x in _ticks(x_low, x_high, x_high > 12 * x_low)]
    out += [*grid(left, top, bottom, xs, ys), text(left + PLOT_WIDTH / 2, bottom + 38, panel.x_label, **SMALL)]

    if far:
        words = "; ".join(f"{p.name}: {p.cost:.3g}, {p.value:.3g}" for p in far)
        out.append(text(left, bottom + 54, f"outside: {words}", size=10, color="#666666"))

    path, at = "", None
    best = [p for p in best if p not in far]
    for p in best:  # a step for each point: what no setting reaches lies below and to the left
        x, y = px(p.cost), py(p.value)
        path += f"M{x:.1f} {y:.1f}" if at is None else f"L{x:.1f} {at:.1f}L{x:.1f} {y:.1f}"
        at = y
    out.append(f'<path d="{path}" fill="none" stroke="#999999" stroke-width="1.5"/>')
    labelled = [p for p in points if p.preset or p in best]
    for p in sorted(points, key=lambda p: p.preset):
        if p.bar > 0:
            ends = f"M{px(p.cost):.1f} {py(p.value - p.bar):.1f}V{py(p.value + p.bar):.1f}"
            out.append(f'<path d="{ends}" stroke="{colors[p.knob]}" stroke-opacity="0.5"/>')
        out.append(_mark(p, px(p.cost), py(p.value), colors[p.knob], p in best))
    edge = left + PLOT_WIDTH + 8
    for p, y in zip(labelled, spread([py(p.value) for p in labelled], 12, top, bottom)):
        thread = f"M{px(p.cost) + 6:.1f} {py(p.value):.1f}L{edge - 2:.1f} {y:.1f}"
        out.append(f'<path d="{thread}" stroke="{colors[p.knob]}" stroke-opacity="0.25"/>')
        out.append(text(edge, y + 4, p.name, size=10, color=colors[p.knob], bold=p.preset))
    return out


def chart(title: str, panels: Sequence[Panel], columns: int = 3) -> str:
    """Return an SVG of panels in rows. Filled marks lie on the front, hollow ones do not; squares are presets."""
    knobs = list(dict.fromkeys(p.knob for panel in panels for p in panel.points))
    colors = {k: PALETTE[i % len(PALETTE)] for i, k in enumerate(knobs)}
    wide, high = LEFT + PLOT_WIDTH + RIGHT, TOP + PLOT_HEIGHT + BOTTOM
    columns = min(columns, len(panels))
    width, height = columns * wide, HEAD + LEGEND + high * math.ceil(len(panels) / columns)
    out: list[str] = []
    x = 16.0
    for knob in knobs:
        out.append(f'<circle cx="{x + 4:.1f}" cy="{HEAD + 6}" r="4" fill="{colors[knob]}"/>')
        out.append(text(x + 13, HEAD + 10, knob, size=11, color=colors[knob]))
        x += 30 + 6.2 * len(knob)
    for i, panel in enumerate(panels):
        left, top = (i % columns) * wide + LEFT, HEAD + LEGEND + (i // columns) * high + TOP - 16
        out += _panel(panel, left, top, colors)
    return svg(title, width, height, out)
