"""Line charts as inline SVG that takes its colours from the page around it."""

from __future__ import annotations

import math

WIDTH, HEIGHT = 380, 190
LEFT, RIGHT, TOP, BOTTOM = 52, 12, 26, 26
MAX_POINTS = 300


def ticks(low: float, high: float) -> list[float]:
    """Return two to five round numbers, evenly spaced, inside a range."""
    rough = (high - low) / 4
    power = 10.0 ** math.floor(math.log10(rough))
    step = next(m * power for m in (1, 2, 2.5, 5, 10) if m * power >= rough)
    first = math.ceil(low / step - 1e-9)
    return [i * step for i in range(first, first + 8) if i * step <= high + 1e-9 * step]


def tick_label(value: float) -> str:
    """Return a number as written on axes: 20000 becomes 20k."""
    if abs(value) >= 1e6:
        return f"{value / 1e6:g}M"
    return f"{value / 1e3:g}k" if abs(value) >= 1e4 else f"{value:g}"


def curve(title: str, xs: list[float], ys: list[float], unit: str = "") -> str:
    """Return an SVG chart of ``ys`` over ``xs`` (steps); long series are shown by the means of at most 300 groups.

    Non-finite points are left out; without any finite point the chart says "no data".
    """
    points = [(x, y) for x, y in zip(xs, ys) if math.isfinite(x) and math.isfinite(y)]
    group = max(1, math.ceil(len(points) / MAX_POINTS))
    chunks = [points[i : i + group] for i in range(0, len(points), group)]
    points = [(sum(x for x, _ in c) / len(c), sum(y for _, y in c) / len(c)) for c in chunks]
    head = (
        f'<svg class="curve" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{title}">'
        f'<text x="0" y="13" class="title">{title}{f" [{unit}]" if unit else ""}</text>'
    )
    if not points:
        return head + f'<text x="{LEFT}" y="{HEIGHT / 2}">no data</text></svg>'
    x0, x1 = points[0][0], max(points[-1][0], points[0][0] + 1)
    y0, y1 = min(y for _, y in points), max(y for _, y in points)
    pad = 0.05 * (y1 - y0) or max(abs(y1) * 0.05, 1e-6)
    y0, y1 = y0 - pad, y1 + pad

    def place(x: float, y: float) -> tuple[float, float]:
        px = LEFT + (x - x0) / (x1 - x0) * (WIDTH - LEFT - RIGHT)
        return px, TOP + (y1 - y) / (y1 - y0) * (HEIGHT - TOP - BOTTOM)

    parts = [head]
    for tick in ticks(y0, y1):
        _, py = place(x0, tick)
        parts.append(f'<line class="grid" x1="{LEFT}" x2="{WIDTH - RIGHT}" y1="{py:.1f}" y2="{py:.1f}"/>')
        parts.append(f'<text x="{LEFT - 6}" y="{py + 4:.1f}" text-anchor="end">{tick_label(tick)}</text>')
    for tick in ticks(x0, x1):
        px, _ = place(tick, y0)
        parts.append(f'<text x="{px:.1f}" y="{HEIGHT - 8}" text-anchor="middle">{tick_label(tick)}</text>')
    line = " ".join(f"{px:.1f},{py:.1f}" for px, py in (place(*p) for p in points))
    parts.append(f'<polyline class="line" points="{line}"/></svg>')
    return "".join(parts)
