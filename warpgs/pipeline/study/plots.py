"""Paired differences with their intervals as SVG: a row for each variant, a panel for each metric, a dot for each seed."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

from warpgs.pipeline.study.statistics import Difference
from warpgs.report.curve import ticks

INK, SOFT, RULE, BAND = "#1b1d21", "#666c76", "#d9dce1", "#f6f6f3"
BETTER, WORSE, UNDECIDED = "#0b6e6e", "#c2570c", "#7a808a"
"""Colours of an interval on the better side of 0, on the worse side, and across 0: distinct for any colour vision."""
ROW, PANEL, VALUES, GAP, MARGIN = 38, 230, 184, 24, 24
TOP, BOTTOM = 96, 78
LETTER = 7.2
"""Assumed width of a letter of the row labels [px], to compute the width of their column."""


@dataclass(frozen=True)
class Line:
    """One variant in one panel."""

    name: str
    """Name of the variant."""
    pairs: tuple[float, ...]
    """Difference to the base for each seed."""
    difference: Difference | None
    """Mean of the differences, and its interval; None for the base."""
    exercised: bool = True
    """False if the variant's runs gave the same files as the base's."""


@dataclass(frozen=True)
class Panel:
    """One metric; the lines have the same order in every panel."""

    label: str
    """Name of the metric, with its unit."""
    upwards: bool
    """True if larger values are better."""
    digits: int
    """Digits after the point of the printed figures."""
    lines: tuple[Line, ...]
    """Variants in the order of the rows."""


def _text(x: float, y: float, words: str, size: int = 12, anchor: str = "start", color: str = INK, weight: int = 400) -> str:
    """Return a text element at ``x``, ``y`` [px]."""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" text-anchor="{anchor}" fill="{color}" font-weight="{weight}">'
        f"{escape(words)}</text>"
    )


def _reach(panel: Panel) -> float:
    """Return half the width of a panel's axis, which is centred on 0 so that both signs have the same scale."""
    values = [abs(v) for line in panel.lines for v in line.pairs]
    values += [abs(v) for line in panel.lines if line.difference for v in (line.difference.low, line.difference.high)]
    largest = max((v for v in values if math.isfinite(v)), default=0.0)
    return 1.08 * largest or 10.0**-panel.digits


def _line(panel: Panel, line: Line, y: float, x0: float, px: Callable[[float], float]) -> list[str]:
    """Return the elements of one variant in one panel, at height ``y`` [px]; ``px`` maps values to x [px]."""
    d, right = line.difference, x0 + PANEL + 12
    if d is None:
        return [_text(right, y + 7, "the base", 11, color=SOFT)]
    if not line.exercised:
        return [_text(right, y + 7, "not exercised", 11, color=SOFT)]
    if not math.isfinite(d.mean):
        return [_text(right, y + 7, "not measured", 11, color=SOFT)]
    good = d.mean > 0 if panel.upwards else d.mean < 0
    color = (BETTER if good else WORSE) if d.excludes_zero else UNDECIDED
    parts = [f'<circle cx="{px(v):.1f}" cy="{y + 10:.1f}" r="2.8" fill="{color}" fill-opacity="0.45"/>' for v in line.pairs]
    words = f"{d.mean:+.{panel.digits}f}"
    if math.isfinite(d.low):
        parts.append(
            f'<path d="M{px(d.low):.1f} {y - 6:.1f}v12m0 -6H{px(d.high):.1f}m0 -6v12" fill="none" stroke="{color}" '
            'stroke-width="2"/>'
        )
        words += f"  [{d.low:+.{panel.digits}f}, {d.high:+.{panel.digits}f}]"
    parts.append(f'<circle cx="{px(d.mean):.1f}" cy="{y:.1f}" r="5.5" fill="{color}" stroke="#ffffff" stroke-width="1.5"/>')
    return [*parts, _text(right, y + 7, words, 11, color=color, weight=600 if d.excludes_zero else 400)]


def forest(title: str, base: str, panels: Sequence[Panel]) -> str:
    """Return an SVG of every variant's paired differences to ``base``; panels without a measured difference are left out."""
    panels = [p for p in panels if any(line.pairs for line in p.lines)]
    names = [line.name for line in panels[0].lines] if panels else []
    left = MARGIN + max([90.0, *(LETTER * len(n) + 18 for n in names)])
    step = PANEL + VALUES + GAP
    width = max(left + step * len(panels) - GAP + MARGIN, 560)
    bottom = TOP + ROW * len(names)
    height = bottom + BOTTOM
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" '
        f'height="{height:.0f}" font-family="system-ui, -apple-system, Segoe UI, Helvetica, Arial, sans-serif">',
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>',
        _text(MARGIN, 34, title, 17, weight=600),
    ]
    for i, name in enumerate(names):
        y = TOP + ROW * i
        if i % 2 == 0:
            out.append(f'<rect x="{MARGIN - 8}" y="{y}" width="{width - 2 * MARGIN + 16:.0f}" height="{ROW}" fill="{BAND}"/>')
        out.append(_text(MARGIN, y + ROW / 2 + 4, name, 13, weight=600 if name == base else 400))
    for k, panel in enumerate(panels):
        x0, reach = left + k * step, _reach(panel)

        def px(value: float, x0: float = x0, reach: float = reach) -> float:
            return x0 + PANEL * (value + reach) / (2 * reach)

        better = "right is better" if panel.upwards else "left is better"
        out.append(_text(x0, TOP - 30, f"Δ {panel.label}", 13, weight=600))
        out.append(_text(x0, TOP - 12, f"to {base}, {better}", 11, color=SOFT))
        for tick in ticks(-reach, reach):
            heavy = abs(tick) < 1e-9 * reach
            out.append(
                f'<path d="M{px(tick):.1f} {TOP}V{bottom}" stroke="{INK if heavy else RULE}" '
                f'stroke-width="{1.2 if heavy else 1}"/>'
            )
            out.append(_text(px(tick), bottom + 18, "0" if heavy else f"{tick:+g}", 11, "middle", SOFT))
        for i, line in enumerate(panel.lines):
            out += _line(panel, line, TOP + ROW * (i + 0.5) - 3, x0, px)
    if not panels:
        out.append(_text(MARGIN, 66, "no pair of runs to compare", 13, color=SOFT))
    words = f"large dot: mean; bar: {'joint ' if len(names) > 2 else ''}95 % t interval; small dots: seeds"
    out.append(_text(MARGIN, height - 18, words, 11, color=SOFT))
    x = MARGIN + 6.0 * len(words) + 8
    for color, meaning in ((BETTER, "better"), (WORSE, "worse"), (UNDECIDED, "undecided: the interval contains 0")):
        out.append(f'<circle cx="{x:.1f}" cy="{height - 22:.1f}" r="4.5" fill="{color}"/>')
        out.append(_text(x + 9, height - 18, meaning, 11, color=SOFT))
        x += 6.0 * len(meaning) + 28
    return "\n".join([*out, "</svg>"]) + "\n"
