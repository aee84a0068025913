"""Tables and plots of a study, with its statistics."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

from warpgs.report.page import ticks

CONFIDENCE = 0.95
"""Probability that an interval contains the true mean."""


def family_confidence(count: int, confidence: float = CONFIDENCE) -> float:
    """Return the confidence of each of ``count`` intervals for a joint ``confidence`` of all (Bonferroni 1936)."""
    return 1 - (1 - confidence) / max(1, count)


@dataclass(frozen=True)
class Sample:
    """Mean and spread of repeated measurements."""

    mean: float
    """Arithmetic mean; NaN without measurements."""
    sd: float
    """Standard deviation with n - 1 in the denominator; NaN with fewer than two measurements."""
    count: int
    """Number of measurements."""


@dataclass(frozen=True)
class Difference:
    """Mean of paired differences, and an interval for its true value; the differences are taken as normally distributed."""

    mean: float
    """Mean difference; NaN without pairs."""
    low: float
    """Lower end of the interval; NaN with fewer than two pairs."""
    high: float
    """Upper end of the interval; NaN with fewer than two pairs."""
    pairs: tuple[float, ...]
    """The differences."""

    @property
    def count(self) -> int:
        """Number of pairs."""
        return len(self.pairs)

    @property
    def excludes_zero(self) -> bool:
        """True if the interval does not contain 0; never with fewer than two pairs."""
        return self.low > 0 or self.high < 0


def sample(values: Sequence[float]) -> Sample:
    """Return mean and standard deviation (Bessel's correction) of measurements."""
    n = len(values)
    mean = math.fsum(values) / n if n else math.nan
    sd = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (n - 1)) if n > 1 else math.nan
    return Sample(mean, sd, n)


def paired_difference(ours: Sequence[float], base: Sequence[float], confidence: float = CONFIDENCE) -> Difference:
    """Return Student's interval of the mean of ``ours - base`` over pairs (Student 1908): mean ± t s / sqrt(n)."""
    # Here t is the quantile for n - 1 degrees of freedom. Pairing removes the common effect of seed and scene, which is most of
    # the spread between runs.
    from scipy.special import stdtrit

    pairs = tuple(a - b for a, b in zip(ours, base, strict=True))
    d = sample(pairs)
    if d.count < 2:
        return Difference(d.mean, math.nan, math.nan, pairs)
    half = float(stdtrit(d.count - 1, 0.5 + confidence / 2)) * d.sd / math.sqrt(d.count)
    return Difference(d.mean, d.mean - half, d.mean + half, pairs)


GAUSSIANS = "gaussians"
"""Name of the number of Gaussians in `Row.samples` and in result files."""
NONE = "-"
"""Sign for a value that was not measured."""
MAX_DIGITS = 6
"""Largest number of digits after the point of a difference."""
NOT_EXERCISED = "not exercised"
"""Text in place of a difference if both variants gave the same files."""


@dataclass(frozen=True)
class Metric:
    """A column of figures."""

    key: str
    """Name in result files."""
    label: str
    """Name in tables."""
    upwards: bool
    """True if larger values are better."""
    digits: int
    """Digits after the point."""

    @property
    def arrow(self) -> str:
        """Arrow in the direction that is better."""
        return "↑" if self.upwards else "↓"


@dataclass(frozen=True)
class Row:
    """Measurements of one variant."""

    name: str
    """Name of the variant."""
    samples: dict[str, Sample]
    """Mean and deviation by metric, and of the number of Gaussians; one that is missing was not measured."""
    differences: dict[str, Difference]
    """Paired difference to the table's base by metric; empty for the base itself."""
    marks: tuple[bool, ...] = ()
    """Check marks, one for each of the table's switches."""
    exercised: bool = True
    """False if every run gave the same file as the base, so that the settings made no difference."""


@dataclass(frozen=True)
class Table:
    """Rows of a study, ready to print."""

    caption: str
    """Title."""
    base: str
    """Name of the row that the others are compared with."""
    metrics: tuple[Metric, ...]
    """Columns of figures."""
    rows: tuple[Row, ...]
    """Variants, including the base."""
    switches: tuple[str, ...] = ()
    """Headings of the columns of check marks, in LaTeX without dollar signs; empty for a table of methods."""

    def __post_init__(self) -> None:
        if any(len(r.marks) != len(self.switches) for r in self.rows):
            raise ValueError("every row needs one check mark per switch")

    def best(self, metric: Metric) -> float:
        """Return the best mean of a column as printed; NaN if nothing was measured."""
        means = [round(r.samples[metric.key].mean, metric.digits) for r in self.rows if metric.key in r.samples]
        means = [m for m in means if math.isfinite(m)]
        return (max if metric.upwards else min)(means, default=math.nan)


SCORES = "Scores of held-out views: mean ± standard deviation over seeds"
"""Description of the figures of a table."""
INTERVALS = ("a 95 % t interval", "simultaneous 95 % t intervals per column (Bonferroni)")
"""Description of the intervals of a table with one difference, or with several."""


def figure(sample: Sample | None, digits: int, plus_minus: str = " ± ") -> str:
    """Return mean and deviation as text; a dash if not measured, the mean alone without a deviation."""
    if sample is None or not math.isfinite(sample.mean):
        return NONE
    spread = f"{plus_minus}{sample.sd:.{digits}f}" if math.isfinite(sample.sd) else ""
    return f"{sample.mean:.{digits}f}{spread}"


def interval(d: Difference | None, digits: int) -> str:
    """Return a paired difference, signed, with its interval, as text; a dash if there is none."""
    if d is None or not math.isfinite(d.mean):
        return NONE
    while d.excludes_zero and digits < MAX_DIGITS and not all(round(x, digits) for x in (d.low, d.high)):
        digits += 1  # else an interval without 0 would end at 0
    mean, low, high = (round(x, digits) + 0.0 if math.isfinite(x) else x for x in (d.mean, d.low, d.high))  # not -0.00
    ends = f" [{low:+.{digits}f}, {high:+.{digits}f}]" if math.isfinite(low) else ""
    return f"{mean:+.{digits}f}{ends}"


def _grid(head: list[str], body: list[list[str]], left: int) -> list[str]:
    """Return the lines of a Markdown table; the first ``left`` columns are text, the others numbers."""
    rows = [[c.replace("|", "\\|") for c in r] for r in [head, *body]]
    widths = [max(len(r[i]) for r in rows) for i in range(len(head))]
    lines = [
        "| " + " | ".join(c.ljust(w) if i < left else c.rjust(w) for i, (c, w) in enumerate(zip(r, widths))) + " |"
        for r in rows
    ]
    rule = "|" + "|".join("-" * (w + 2) if i < left else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    return [lines[0], rule, *lines[1:]]


def _plain(heading: str) -> str:
    """Return a LaTeX heading for readers without LaTeX: S_{render} becomes S_render."""
    return heading.replace("\\mathit", "").replace("{", "").replace("}", "")


def markdown(table: Table) -> str:
    """Return two tables: means ± deviations over seeds, the best in bold; and differences to the base with intervals."""

    def cell(row: Row, m: Metric) -> str:
        s = row.samples.get(m.key)
        text = figure(s, m.digits)
        return f"**{text}**" if s is not None and round(s.mean, m.digits) == table.best(m) else text

    def count(row: Row) -> str:
        return f"{row.samples[GAUSSIANS].mean:,.0f}" if GAUSSIANS in row.samples else NONE

    marks = [_plain(s) for s in table.switches]
    counts = ["Gaussians"] if any(GAUSSIANS in r.samples for r in table.rows) else []
    head = ["row" if marks else "method", *marks, *(f"{m.label} {m.arrow}" for m in table.metrics), *counts, "seeds"]
    body = [
        [r.name, *("✓" if m else "✗" for m in r.marks), *(cell(r, m) for m in table.metrics), *(count(r) for _ in counts),
         str(max((s.count for s in r.samples.values()), default=0))]
        for r in table.rows
    ]  # fmt: skip
    lines = [f"{SCORES}, the best mean in bold:", "", *_grid(head, body, 1 + len(marks)), ""]
    rows = [r for r in table.rows if r.differences]
    lines += [
        f"Difference to {table.base}, paired by seed, with {INTERVALS[len(rows) > 1]}; \\* marks an interval without 0:",
        "",
    ]

    def gap(row: Row, m: Metric) -> str:
        if not row.exercised:
            return NOT_EXERCISED
        d = row.differences.get(m.key)
        return interval(d, m.digits) + (" \\*" if d is not None and d.excludes_zero else "")

    body = [[r.name, *(gap(r, m) for m in table.metrics), str(max(d.count for d in r.differences.values()))] for r in rows]
    return "\n".join([*lines, *_grid([head[0], *(f"Δ {m.label}" for m in table.metrics), "pairs"], body, 1)]) + "\n"


def csv_text(table: Table) -> str:
    """Return CSV with one line for each row and metric. Numbers have full precision; missing numbers are empty fields."""
    out = io.StringIO()
    names = [_plain(s) for s in table.switches]
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["row", *names, "metric", "mean", "sd", "seeds", "difference", "low95", "high95", "pairs"])

    def number(value: float) -> str:
        return repr(value) if math.isfinite(value) else ""

    for row in table.rows:
        for m in table.metrics:
            s, d = row.samples.get(m.key), row.differences.get(m.key)
            measured = ["", "", 0] if s is None else [number(s.mean), number(s.sd), s.count]
            paired = ["", "", "", ""]
            if d is not None and row.exercised:
                paired = [number(d.mean), number(d.low), number(d.high), d.count]
            writer.writerow([row.name, *(int(x) for x in row.marks), m.key, *measured, *paired])
    return out.getvalue()


_LATEX = str.maketrans(
    {sign: f"\\{sign}" for sign in "&%$#_{}"}
    | {"\\": "\\textbackslash{}", "^": "\\textasciicircum{}", "~": "\\textasciitilde{}", "\n": " ", "\r": " "}
)
"""LaTeX of each sign."""


def _escape(text: str) -> str:
    """Escape LaTeX's special characters, since names of scenes are arbitrary."""
    return text.translate(_LATEX)


def latex(table: Table) -> str:
    """Return a booktabs table: check marks or methods, means ± deviations, and the paired difference of the first metric."""
    first, space = table.metrics[0], "\\,["

    def cell(row: Row, m: Metric) -> str:
        s = row.samples.get(m.key)
        text = figure(s, m.digits, " \\pm ")
        if text == NONE:
            return "--"
        return f"$\\mathbf{{{text}}}$" if s is not None and round(s.mean, m.digits) == table.best(m) else f"${text}$"

    def gap(row: Row) -> str:
        if not row.exercised:
            return NOT_EXERCISED
        text = interval(row.differences.get(first.key), first.digits)
        return "--" if text == NONE else f"${text.replace(' [', space)}$"

    scores, pairs = SCORES.replace("±", "$\\pm$"), sum(bool(r.differences) for r in table.rows)
    about = f"{scores}. $\\Delta$: difference to {_escape(table.base)}, paired by seed, with {_escape(INTERVALS[pairs > 1])}."
    head = [f"${s}$" for s in table.switches] or ["Method"]
    arrows = {"↑": "$\\uparrow$", "↓": "$\\downarrow$"}
    head += [f"{m.label}{arrows[m.arrow]}" for m in table.metrics] + [f"$\\Delta$ {first.label} [95\\,\\%]"]
    lines = [
        "% needs \\usepackage{booktabs, amssymb}",
        "\\begin{table}[htbp]", "  \\centering", f"  \\caption{{{_escape(table.caption)}. {about}}}",
        f"  \\begin{{tabular}}{{{'c' * len(table.switches) or 'l'}{'c' * len(table.metrics)}r}}", "    \\toprule",
        f"    {' & '.join(head)} \\\\", "    \\midrule",
    ]  # fmt: skip
    for row in table.rows:
        words = ["$\\checkmark$" if m else "$\\times$" for m in row.marks] or [_escape(row.name)]
        note = f"  % {row.name}" if row.marks else ""
        lines.append(f"    {' & '.join([*words, *(cell(row, m) for m in table.metrics), gap(row)])} \\\\{note}")
    return "\n".join([*lines, "    \\bottomrule", "  \\end{tabular}", "\\end{table}"]) + "\n"


INK, SOFT, RULE, BAND = "#1b1d21", "#666c76", "#d9dce1", "#f6f6f3"
BETTER, WORSE, UNDECIDED = "#0b6e6e", "#c2570c", "#7a808a"
"""Colours of an interval on the better side of 0, on the worse side, and across 0: distinct for any colour vision."""
ROW, PANEL, VALUES, GAP, MARGIN = 38, 230, 184, 24, 24
TOP, BOTTOM = 96, 78
LETTER = 7.2
"""Assumed width of a letter of the row labels [px], to compute the width of their column."""


def _text(x: float, y: float, words: str, size: int = 12, anchor: str = "start", color: str = INK, weight: int = 400) -> str:
    """Return a text element at ``x``, ``y`` [px]."""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" font-size="{size}" text-anchor="{anchor}" fill="{color}" font-weight="{weight}">'
        f"{escape(words)}</text>"
    )


def _reach(differences: list[Difference], digits: int) -> float:
    """Return half the width of a metric's axis, which is centred on 0 so that both signs have the same scale."""
    values = [abs(v) for d in differences for v in (*d.pairs, d.low, d.high)]
    largest = max((v for v in values if math.isfinite(v)), default=0.0)
    return 1.08 * largest or 10.0**-digits


def _line(metric: Metric, row: Row, y: float, x0: float, px: Callable[[float], float]) -> list[str]:
    """Return the elements of one variant and metric at height ``y`` [px]; ``px`` maps values to x [px]."""
    d, right = row.differences.get(metric.key), x0 + PANEL + 12
    if d is None:
        return [_text(right, y + 7, "the base", 11, color=SOFT)]
    if not row.exercised:
        return [_text(right, y + 7, "not exercised", 11, color=SOFT)]
    if not math.isfinite(d.mean):
        return [_text(right, y + 7, "not measured", 11, color=SOFT)]
    good = d.mean > 0 if metric.upwards else d.mean < 0
    color = (BETTER if good else WORSE) if d.excludes_zero else UNDECIDED
    parts = [f'<circle cx="{px(v):.1f}" cy="{y + 10:.1f}" r="2.8" fill="{color}" fill-opacity="0.45"/>' for v in d.pairs]
    words = f"{d.mean:+.{metric.digits}f}"
    if math.isfinite(d.low):
        parts.append(
            f'<path d="M{px(d.low):.1f} {y - 6:.1f}v12m0 -6H{px(d.high):.1f}m0 -6v12" fill="none" stroke="{color}" '
            'stroke-width="2"/>'
        )
        words += f"  [{d.low:+.{metric.digits}f}, {d.high:+.{metric.digits}f}]"
    parts.append(f'<circle cx="{px(d.mean):.1f}" cy="{y:.1f}" r="5.5" fill="{color}" stroke="#ffffff" stroke-width="1.5"/>')
    return [*parts, _text(right, y + 7, words, 11, color=color, weight=600 if d.excludes_zero else 400)]


def forest(table: Table) -> str:
    """Return an SVG of every variant's paired differences to the base; metrics without a measured difference are left out."""
    base = table.base
    measured = {m: [r.differences[m.key] for r in table.rows if m.key in r.differences] for m in table.metrics}
    panels = {m: differences for m, differences in measured.items() if any(d.pairs for d in differences)}
    names = [r.name for r in table.rows] if panels else []
    left = MARGIN + max([90.0, *(LETTER * len(n) + 18 for n in names)])
    step = PANEL + VALUES + GAP
    width = max(left + step * len(panels) - GAP + MARGIN, 560)
    bottom = TOP + ROW * len(names)
    height = bottom + BOTTOM
    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width:.0f} {height:.0f}" width="{width:.0f}" '
        f'height="{height:.0f}" font-family="system-ui, -apple-system, Segoe UI, Helvetica, Arial, sans-serif">',
        f'<rect width="{width:.0f}" height="{height:.0f}" fill="#ffffff"/>',
        _text(MARGIN, 34, table.caption, 17, weight=600),
    ]
    for i, name in enumerate(names):
        y = TOP + ROW * i
        if i % 2 == 0:
            out.append(f'<rect x="{MARGIN - 8}" y="{y}" width="{width - 2 * MARGIN + 16:.0f}" height="{ROW}" fill="{BAND}"/>')
        out.append(_text(MARGIN, y + ROW / 2 + 4, name, 13, weight=600 if name == base else 400))
    for k, (metric, differences) in enumerate(panels.items()):
        x0, reach = left + k * step, _reach(differences, metric.digits)

        def px(value: float, x0: float = x0, reach: float = reach) -> float:
            return x0 + PANEL * (value + reach) / (2 * reach)

        better = "right is better" if metric.upwards else "left is better"
        label = metric.label + (" [dB]" if metric.key == "psnr" else "")
        out.append(_text(x0, TOP - 30, f"Δ {label}", 13, weight=600))
        out.append(_text(x0, TOP - 12, f"to {base}, {better}", 11, color=SOFT))
        for tick in ticks(-reach, reach):
            heavy = abs(tick) < 1e-9 * reach
            out.append(
                f'<path d="M{px(tick):.1f} {TOP}V{bottom}" stroke="{INK if heavy else RULE}" '
                f'stroke-width="{1.2 if heavy else 1}"/>'
            )
            out.append(_text(px(tick), bottom + 18, "0" if heavy else f"{tick:+g}", 11, "middle", SOFT))
        for i, row in enumerate(table.rows):
            out += _line(metric, row, TOP + ROW * (i + 0.5) - 3, x0, px)
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
