"""Log-log line charts as SVG, written by hand: a few panels side by side, every line labelled at its end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

PALETTE = ("#0072b2", "#d55e00", "#009e73", "#b0569a", "#c98a00", "#2f9bd6", "#444444", "#8c6d5a")
"""Colours that readers with any colour vision can tell apart (after Okabe and Ito), dark enough for text."""

PLOT_WIDTH, PLOT_HEIGHT = 330, 300
LEFT, RIGHT, TOP, BOTTOM = 62, 140, 84, 52
SMALL = {"size": 11, "anchor": "middle", "color": "#666666"}
LINE_HEIGHT = 14
"""Least distance between two labels [px]."""


@dataclass(frozen=True)
class Line:
    """One series."""

    label: str
    points: tuple[tuple[float, float], ...]
    """Positive (x, y), x ascending."""
    color: int = 0
    """Index in the palette."""
    dashed: bool = False
    """Dashed for other programs."""


@dataclass(frozen=True)
class Panel:
    """One pair of axes."""

    title: str
    x_label: str
    y_label: str
    lines: tuple[Line, ...]
    linear: bool = False
    """True for a linear axis y, and more marks on the axis x."""


def decades(values: Sequence[float]) -> tuple[int, int]:
    """Return the exponents of ten below the smallest and above the largest value; at least one decade apart."""
    low, high = math.floor(math.log10(min(values)) + 1e-9), math.ceil(math.log10(max(values)) - 1e-9)
    return low, max(high, low + 1)


def spread(wanted: Sequence[float], gap: float, low: float, high: float) -> list[float]:
    """Move positions apart, as little as possible, until neighbours have a distance of ``gap``."""
    order = sorted(range(len(wanted)), key=lambda i: wanted[i])
    placed = [wanted[i] for i in order]
    # groups of labels that touch, each centred on the mean of what its members want
    groups: list[list[int]] = []
    for i in range(len(placed)):
        groups.append([i])
        while len(groups) > 1 and _top(groups[-1], placed, gap) < _top(groups[-2], placed, gap) + len(groups[-2]) * gap:
            last = groups.pop()
            groups[-1] += last
    result = [0.0] * len(wanted)
    for group in groups:
        top = min(max(_top(group, placed, gap), low), high - (len(group) - 1) * gap)
        for k, i in enumerate(group):
            result[order[i]] = top + k * gap
    return result


def _top(group: list[int], placed: list[float], gap: float) -> float:
    return sum(placed[i] for i in group) / len(group) - (len(group) - 1) * gap / 2


def number(value: float) -> str:
    """Return a power of ten as written on axes, such as 10k."""
    for size, unit in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if value >= size:
            return f"{value / size:g}{unit}"
    return f"{value:g}"


def text(x: float, y: float, words: str, *, size: int = 12, anchor: str = "start", color: str = "#333333", bold: bool = False):
    weight = ' font-weight="600"' if bold else ""
    place = f'x="{x:.1f}" y="{y:.1f}" font-size="{size}" text-anchor="{anchor}" fill="{color}"{weight}'
    return f"<text {place}>{escape(words)}</text>"


def grid(left: float, top: float, bottom: float, xs: Sequence[tuple[float, str]], ys: Sequence[tuple[float, str]]) -> list[str]:
    """Return the lines of a grid with their labels, and the axis at the bottom; a line is a position [px] and a text."""
    out = []
    for y, words in ys:
        out.append(f'<path d="M{left:.1f} {y:.1f}h{PLOT_WIDTH}" stroke="#e6e6e6"/>')
        out.append(text(left - 8, y + 4, words, size=11, anchor="end", color="#666666"))
    for x, words in xs:
        out.append(f'<path d="M{x:.1f} {top}v{bottom - top}" stroke="#f0f0f0"/>')
        out.append(text(x, bottom + 18, words, **SMALL))
    return [*out, f'<path d="M{left:.1f} {bottom}h{PLOT_WIDTH}" stroke="#999999"/>']


def svg(title: str, width: float, height: float, parts: Sequence[str]) -> str:
    """Return an SVG with a title above its parts."""
    return "\n".join([
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="system-ui, -apple-system, Segoe UI, Helvetica, Arial, sans-serif">',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        text(16, 28, title, size=16, color="#111111", bold=True), *parts, "</svg>",
    ]) + "\n"  # fmt: skip


def _slope(left: float, bottom: float, y_range: tuple[int, int], x_range: tuple[float, float]) -> list[str]:
    """Return a short line of slope 1 in the lower right corner, where growing series leave space."""
    run = min(1.0, 0.4 * (x_range[1] - x_range[0]), 0.4 * (y_range[1] - y_range[0]))
    along, rise = run * PLOT_WIDTH / (x_range[1] - x_range[0]), run * PLOT_HEIGHT / (y_range[1] - y_range[0])
    end = left + PLOT_WIDTH - 44
    line = f'<path d="M{end - along:.1f} {bottom - 10}l{along:.1f} {-rise:.1f}" stroke="#bbbbbb" fill="none"/>'
    return [line, text(end + 5, bottom - 10 - rise + 5, "linear", size=10, color="#999999")]


def _panel(panel: Panel, left: float, y_range: tuple[int, int], x_range: tuple[float, float]) -> list[str]:
    height = (lambda y: y) if panel.linear else math.log10

    def px(x: float) -> float:
        return left + PLOT_WIDTH * (math.log10(x) - x_range[0]) / (x_range[1] - x_range[0])

    def py(y: float) -> float:
        return TOP + PLOT_HEIGHT * (y_range[1] - height(y)) / (y_range[1] - y_range[0])

    bottom, out = TOP + PLOT_HEIGHT, []
    out.append(text(left, TOP - 30, panel.title, size=13, bold=True))
    out.append(text(left, TOP - 12, panel.y_label, size=11, color="#666666"))
    marks = range(*y_range, max(1, (y_range[1] - y_range[0]) // 8)) if panel.linear else [10.0**e for e in range(*y_range)]
    ys = [(py(y), number(y)) for y in (*marks, y_range[1] if panel.linear else 10.0 ** y_range[1])]
    steps = (1, 2, 5) if panel.linear else (1,)
    sizes = [k * 10.0**e for e in range(math.floor(x_range[0]), math.floor(x_range[1]) + 1) for k in steps]
    xs = [(px(x), number(x)) for x in sizes if x_range[0] <= math.log10(x) <= x_range[1]]
    out += [*grid(left, TOP, bottom, xs, ys), text(left + PLOT_WIDTH / 2, bottom + 40, panel.x_label, **SMALL)]

    if not panel.linear:
        out += _slope(left, bottom, y_range, x_range)
    labels = spread([py(line.points[-1][1]) for line in panel.lines], LINE_HEIGHT, TOP, bottom)
    for line, label_y in zip(panel.lines, labels):
        color, places = PALETTE[line.color % len(PALETTE)], [(px(x), py(y)) for x, y in line.points]
        path = "M" + "L".join(f"{x:.1f} {y:.1f}" for x, y in places)
        dash = ' stroke-dasharray="5 4"' if line.dashed else ""
        out.append(f'<path d="{path}" fill="none" stroke="{color}" stroke-width="2" stroke-linejoin="round"{dash}/>')
        out += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{color}"/>' for x, y in places]
        x, y = places[-1]
        edge = left + PLOT_WIDTH + 8
        if line.label and (
            abs(label_y - y) > 3 or edge - x > 14
        ):  # a thread leads from the last point to a label that is not beside it
            thread = f"M{x + 5:.1f} {y:.1f}L{edge - 2:.1f} {label_y:.1f}"
            out.append(f'<path d="{thread}" stroke="{color}" stroke-opacity="0.35" fill="none"/>')
        out.append(text(edge + 1, label_y + 4, line.label, color=color))
    return out


def chart(title: str, panels: Sequence[Panel]) -> str:
    """Return an SVG with a title and panels from left to right; those without lines are left out.

    All panels have the same range of y, and those with the same label the same range of x.
    """
    panels = [p for p in panels if p.lines]
    values = [y for p in panels for line in p.lines for _, y in line.points]
    linear = any(p.linear for p in panels)
    y_range = (math.floor(min(values)), math.floor(max(values)) + 1) if linear else decades(values)
    step = LEFT + PLOT_WIDTH + RIGHT
    out: list[str] = []
    for i, panel in enumerate(panels):
        same = [p for p in panels if p.x_label == panel.x_label]
        sizes = [math.log10(x) for p in same for line in p.lines for x, _ in line.points]
        # sizes fill the width, so that labels stand beside the lines' ends
        out += _panel(panel, i * step + LEFT, y_range, (min(sizes) - 0.06, max(sizes) + 0.06))
    return svg(title, step * len(panels), TOP + PLOT_HEIGHT + BOTTOM, out)
