"""Tables and plots of a study, with its statistics."""

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from html import escape

from warpgs.report.page import ticks

CONFIDENCE = 0.95
"""Probability that an interval contains the true mean."""


def family_confidence(count: int, confidence: float = CONFIDENCE) -> float:
    """Return the confidence of each of ``count`` intervals for a joint ``confidence`` of all (Bonferroni 1936)."""
    return 1 - (1 - confidence) / max(1, count)


@dataclass(frozen=True)
class Sample:
    """Repeated measurements, or their paired differences, taken as normally distributed."""

    values: tuple[float, ...]
    mean: float = math.nan
    """Arithmetic mean; NaN without measurements."""
    sd: float = math.nan
    """Standard deviation with n - 1 in the denominator; like the interval, NaN with fewer than two measurements."""
    low: float = math.nan
    high: float = math.nan
    """Ends of an interval for the true mean."""

    @property
    def excludes_zero(self) -> bool:
        """True if the interval does not contain 0; never with fewer than two measurements."""
        return self.low > 0 or self.high < 0


def sample(values: Sequence[float], confidence: float = CONFIDENCE) -> Sample:
    """Return mean, standard deviation (Bessel's correction) and Student's interval (Student 1908), mean ± t s / sqrt(n)."""
    from scipy.special import stdtrit

    n, values = len(values), tuple(values)
    if not n:
        return Sample(values)
    mean = math.fsum(values) / n
    if n == 1:
        return Sample(values, mean)
    sd = math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (n - 1))
    half = float(stdtrit(n - 1, 0.5 + confidence / 2)) * sd / math.sqrt(n)  # t is the quantile for n - 1 degrees of freedom
    return Sample(values, mean, sd, mean - half, mean + half)


def paired_difference(ours: Sequence[float], base: Sequence[float], confidence: float = CONFIDENCE) -> Sample:
    """Return ``ours - base``; pairing removes the common effect of seed and scene, which is most of the spread of runs."""
    return sample([a - b for a, b in zip(ours, base, strict=True)], confidence)


GAUSSIANS = "gaussians"
"""Name of the number of Gaussians in `Row.samples` and in result files."""
NONE = "-"
"""Sign for a value that was not measured."""
MAX_DIGITS = 6
"""Largest number of digits after the point of a difference."""
NOT_EXERCISED = "not exercised"
"""Text in place of a difference if both variants gave the same files."""
METRICS = {
    "psnr": ("PSNR", True, 2), "ssim": ("SSIM", True, 3), "lpips_vgg_legacy": ("LPIPS-VGG", False, 3),
    "lpips_alex_legacy": ("LPIPS-Alex", False, 3), "lpips": ("LPIPS", False, 3),
}  # fmt: skip
"""Name in tables, whether larger values are better, and digits after the point, by the name in result files."""


@dataclass(frozen=True)
class Table:
    """Figures of a study, ready to print."""

    caption: str
    """Title."""
    metrics: tuple[str, ...]
    """Columns of figures: keys of `METRICS`."""
    samples: dict[str, dict[str, Sample]]
    """Measurements by variant, the base first, and by metric or `GAUSSIANS`; one that is missing was not measured."""
    differences: dict[str, dict[str, Sample] | None]
    """Paired differences of the other variants to the base, by variant and metric; None if every run gave the same file as the
    base, so that the settings made no difference."""
    switches: tuple[str, ...] = ()
    """Headings of the columns of check marks, in LaTeX without dollar signs; empty for a table of methods."""
    marks: dict[str, tuple[bool, ...]] = field(default_factory=dict)
    """Check marks by variant, one for each switch."""

    @property
    def base(self) -> str:
        """Name of the variant that the others are compared with."""
        return next(iter(self.samples))

    def best(self, metric: str) -> float:
        """Return the best mean of a column as printed; NaN if nothing was measured."""
        _, upwards, digits = METRICS[metric]
        means = [round(own[metric].mean, digits) for own in self.samples.values() if metric in own]
        return (max if upwards else min)((m for m in means if math.isfinite(m)), default=math.nan)

    def cell(self, name: str, metric: str, bold: str) -> str:
        """Return mean and deviation as text, the best in the form ``bold``; a dash if not measured."""
        found, digits = self.samples[name].get(metric), METRICS[metric][2]
        if found is None or not math.isfinite(found.mean):
            return NONE
        text = f"{found.mean:.{digits}f}" + (f" ± {found.sd:.{digits}f}" if math.isfinite(found.sd) else "")
        return bold.format(text) if round(found.mean, digits) == self.best(metric) else text

    def gap(self, name: str, metric: str) -> str:
        """Return the difference of a variant to the base as text."""
        if name == self.base:
            return NONE
        own = self.differences[name]
        return NOT_EXERCISED if own is None else interval(own.get(metric), METRICS[metric][2])


SCORES = "Scores of held-out views: mean ± standard deviation over seeds"
"""Description of the figures of a table."""
INTERVALS = ("a 95 % t interval", "simultaneous 95 % t intervals per column (Bonferroni)")
"""Description of the intervals of a table with one difference, or with several."""


def interval(d: Sample | None, digits: int) -> str:
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
    padded = ([c.ljust(w) if i < left else c.rjust(w) for i, (c, w) in enumerate(zip(r, widths))] for r in rows)
    lines = [f"| {' | '.join(cells)} |" for cells in padded]
    rule = "|" + "|".join("-" * (w + 2) if i < left else "-" * (w + 1) + ":" for i, w in enumerate(widths)) + "|"
    return [lines[0], rule, *lines[1:]]


def _plain(heading: str) -> str:
    """Return a LaTeX heading for readers without LaTeX: S_{render} becomes S_render."""
    return heading.replace("{", "").replace("}", "")


def _labels(table: Table, arrows: str = "↑↓") -> list[str]:
    return [f"{label} {arrows[not upwards]}" for label, upwards, _ in (METRICS[m] for m in table.metrics)]


def markdown(table: Table) -> str:
    """Return two tables: means ± deviations over seeds, the best in bold; and differences to the base with intervals."""
    marks = [_plain(s) for s in table.switches]
    counts = ["Gaussians"] if any(GAUSSIANS in own for own in table.samples.values()) else []
    head, body = ["row" if marks else "method", *marks, *_labels(table), *counts, "seeds"], []
    for name, own in table.samples.items():
        count = f"{own[GAUSSIANS].mean:,.0f}" if GAUSSIANS in own else NONE
        checks = ("✓" if m else "✗" for m in table.marks.get(name, ()))
        seeds = str(max((len(s.values) for s in own.values()), default=0))
        body.append([name, *checks, *(table.cell(name, m, "**{}**") for m in table.metrics), *(count for _ in counts), seeds])
    lines, rows = [f"{SCORES}, the best mean in bold:", "", *_grid(head, body, 1 + len(marks)), ""], []
    for name, gaps in table.differences.items():
        sure = {m for m, d in (gaps or {}).items() if d.excludes_zero}
        pairs = NONE if gaps is None else str(max(len(d.values) for d in gaps.values()))
        rows.append([name, *(table.gap(name, m) + " \\*" * (m in sure) for m in table.metrics), pairs])
    intervals = INTERVALS[len(rows) > 1]
    lines += [f"Difference to {table.base}, paired by seed, with {intervals}; \\* marks an interval without 0:", ""]
    return "\n".join([*lines, *_grid([head[0], *(f"Δ {METRICS[m][0]}" for m in table.metrics), "pairs"], rows, 1)]) + "\n"


def csv_rows(table: Table) -> Iterator[list[str | int]]:
    """Yield a row for each variant and metric, after the head. Numbers have full precision; missing numbers are empty."""
    names = [_plain(s) for s in table.switches]
    yield ["row", *names, "metric", "mean", "sd", "seeds", "difference", "low95", "high95", "pairs"]
    for name, own in table.samples.items():
        for m in table.metrics:
            s, d = own.get(m, Sample(())), (table.differences.get(name) or {}).get(m)
            gaps, pairs = ([math.nan] * 3, "") if d is None else ([d.mean, d.low, d.high], len(d.values))
            mean, sd, *gaps = (repr(v) if math.isfinite(v) else "" for v in (s.mean, s.sd, *gaps))
            yield [name, *map(int, table.marks.get(name, ())), m, mean, sd, len(s.values), *gaps, pairs]


_LATEX = str.maketrans(
    {sign: f"\\{sign}" for sign in "&%$#_{}"}
    | {"\\": "\\textbackslash{}", "^": "\\textasciicircum{}", "~": "\\textasciitilde{}", "\n": " ", "\r": " "}
)
"""LaTeX of each sign; names of scenes are arbitrary."""


def latex(table: Table) -> str:
    """Return a booktabs table: check marks or methods, means ± deviations, and the paired difference of the first metric."""
    first = table.metrics[0]

    def math_of(text: str) -> str:
        text = text.replace(" ± ", " \\pm ").replace(" [", "\\,[")
        return {NONE: "--", NOT_EXERCISED: text}.get(text, f"${text}$")

    scores, intervals = SCORES.replace("±", "$\\pm$"), INTERVALS[len(table.differences) > 1]
    base, intervals, caption = (text.translate(_LATEX) for text in (table.base, intervals, table.caption))
    about = f"{scores}. $\\Delta$: difference to {base}, paired by seed, with {intervals}."
    head = [f"${s}$" for s in table.switches] or ["Method"]
    head += [label.replace(" ↑", "$\\uparrow$").replace(" ↓", "$\\downarrow$") for label in _labels(table)]
    head.append(f"$\\Delta$ {METRICS[first][0]} [95\\,\\%]")
    lines = [
        "% needs \\usepackage{booktabs, amssymb}",
        "\\begin{table}[htbp]", "  \\centering", f"  \\caption{{{caption}. {about}}}",
        f"  \\begin{{tabular}}{{{'c' * len(table.switches) or 'l'}{'c' * len(table.metrics)}r}}", "    \\toprule",
        f"    {' & '.join(head)} \\\\", "    \\midrule",
    ]  # fmt: skip
    for name in table.samples:
        words = ["$\\checkmark$" if m else "$\\times$" for m in table.marks.get(name, ())]
        note = f"  % {name}" if words else ""
        words = words or [name.translate(_LATEX)]
        words += [math_of(table.cell(name, m, "\\mathbf{{{}}}")) for m in table.metrics]
        lines.append(f"    {' & '.join([*words, math_of(table.gap(name, first))])} \\\\{note}")
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
    style = f'font-size="{size}" text-anchor="{anchor}" fill="{color}" font-weight="{weight}"'
    return f'<text x="{x:.1f}" y="{y:.1f}" {style}>{escape(words)}</text>'


def _dot(x: float, y: float, radius: float, color: str, more: str = "") -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius}" fill="{color}"{more}/>'


def _line(table: Table, name: str, metric: str, y: float, x0: float, px: Callable[[float], float]) -> list[str]:
    """Return the elements of one variant and metric at height ``y`` [px]; ``px`` maps values to x [px]."""
    own, right, (_, upwards, digits) = table.differences.get(name, {}), x0 + PANEL + 12, METRICS[metric]
    d = None if own is None else own.get(metric)
    if d is None or not math.isfinite(d.mean):
        words = NOT_EXERCISED if own is None else "not measured" if own else "the base"
        return [_text(right, y + 7, words, 11, color=SOFT)]
    color = (BETTER if (d.mean > 0) == upwards else WORSE) if d.excludes_zero else UNDECIDED
    parts = [_dot(px(v), y + 10, 2.8, color, ' fill-opacity="0.45"') for v in d.values]
    if math.isfinite(d.low):
        bar = f"M{px(d.low):.1f} {y - 6:.1f}v12m0 -6H{px(d.high):.1f}m0 -6v12"
        parts.append(f'<path d="{bar}" fill="none" stroke="{color}" stroke-width="2"/>')
    parts.append(_dot(px(d.mean), y, 5.5, color, ' stroke="#ffffff" stroke-width="1.5"'))
    return [*parts, _text(right, y + 7, interval(d, digits), 11, color=color, weight=600 if d.excludes_zero else 400)]


def forest(table: Table) -> str:
    """Return an SVG of every variant's paired differences to the base; metrics without a measured difference are left out."""
    base = table.base
    gaps = [own for own in table.differences.values() if own is not None]
    measured = {m: [own[m] for own in gaps if m in own] for m in table.metrics}
    panels = {m: differences for m, differences in measured.items() if any(d.values for d in differences)}
    names = list(table.samples) if panels else []
    left = MARGIN + max([90.0, *(LETTER * len(n) + 18 for n in names)])
    step = PANEL + VALUES + GAP
    width, bottom = max(left + step * len(panels) - GAP + MARGIN, 560), TOP + ROW * len(names)
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
        label, upwards, digits = METRICS[metric]
        values = [abs(v) for d in differences for v in (*d.values, d.low, d.high) if math.isfinite(v)]
        # half the width of the axis, which is centred on 0 so that both signs have the same scale
        x0, reach = left + k * step, 1.08 * max(values, default=0.0) or 10.0**-digits

        def px(value: float, x0: float = x0, reach: float = reach) -> float:
            return x0 + PANEL * (value + reach) / (2 * reach)

        out.append(_text(x0, TOP - 30, f"Δ {label}{' [dB]' * (metric == 'psnr')}", 13, weight=600))
        out.append(_text(x0, TOP - 12, f"to {base}, {'right' if upwards else 'left'} is better", 11, color=SOFT))
        for tick in ticks(-reach, reach):
            heavy = abs(tick) < 1e-9 * reach
            line = f'stroke="{INK if heavy else RULE}" stroke-width="{1.2 if heavy else 1}"'
            out.append(f'<path d="M{px(tick):.1f} {TOP}V{bottom}" {line}/>')
            out.append(_text(px(tick), bottom + 18, "0" if heavy else f"{tick:+g}", 11, "middle", SOFT))
        for i, name in enumerate(names):
            out += _line(table, name, metric, TOP + ROW * (i + 0.5) - 3, x0, px)
    if not panels:
        out.append(_text(MARGIN, 66, "no pair of runs to compare", 13, color=SOFT))
    words = f"large dot: mean; bar: {'joint ' if len(names) > 2 else ''}95 % t interval; small dots: seeds"
    out.append(_text(MARGIN, height - 18, words, 11, color=SOFT))
    x = MARGIN + 6.0 * len(words) + 8
    for color, meaning in ((BETTER, "better"), (WORSE, "worse"), (UNDECIDED, "undecided: the interval contains 0")):
        out += [_dot(x, height - 22, 4.5, color), _text(x + 9, height - 18, meaning, 11, color=SOFT)]
        x += 6.0 * len(meaning) + 28
    return "\n".join([*out, "</svg>"]) + "\n"
