"""Numbers as text, and Markdown tables."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Sequence


def markdown(head: Sequence[str], rows: Iterable[Sequence[object]], left: Sequence[str] | None = None) -> str:
    """Return a Markdown table."""
    rule = "|".join("---" if left is None or name in left else "---:" for name in head)
    first, *rest = ("| " + " | ".join(map(str, line)) + " |" for line in (head, *rows))
    return "\n".join([first, f"|{rule}|", *rest]) + "\n"


def figure(value: float) -> str:
    """Return three significant digits, never with an exponent."""
    if value >= 999.5:
        return f"{value:,.0f}"
    return f"{float(f'{value:.3g}'):.10f}".rstrip("0").rstrip(".")


def mean_sd(values: Sequence[float], digits: int = 2, sign: str = "") -> str:
    """Return the mean, and the standard deviation if there are several values; nan if a value is not finite."""
    if not all(map(math.isfinite, values)):
        return "nan"
    deviation = f" ± {statistics.stdev(values):.{digits}f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):{sign}.{digits}f}{deviation}"


def named(row: dict, digits: int = 4) -> str:
    """Return the entries of a row as text."""
    return "  ".join(f"{k} {v:.{digits}g}" if isinstance(v, float) else f"{k} {v}" for k, v in row.items())
