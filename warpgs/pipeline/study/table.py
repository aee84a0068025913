"""Tables of a study as Markdown, CSV and LaTeX, in the layout of papers."""

from __future__ import annotations

import csv
import io
import math
from dataclasses import dataclass

from warpgs.pipeline.study.statistics import Difference, Sample

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
