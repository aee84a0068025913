"""Statistics of a handful of repeated runs: mean, deviation, and the interval of a paired difference."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

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
    count: int
    """Number of pairs."""

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
    """Return Student's interval of the mean of ``ours - base`` over pairs (Student 1908): mean ± t s / sqrt(n).

    Here t is the quantile for n - 1 degrees of freedom. Pairing removes the common effect of seed and scene, which is most of
    the spread between runs.

    Args:
        ours: Measurements.
        base: Measurements of the base, in the same order.
        confidence: Probability that the interval contains the true mean, in (0, 1).

    Raises:
        ValueError: ``ours`` and ``base`` differ in length.
    """
    from scipy.special import stdtrit

    d = sample([a - b for a, b in zip(ours, base, strict=True)])
    if d.count < 2:
        return Difference(d.mean, math.nan, math.nan, d.count)
    half = float(stdtrit(d.count - 1, 0.5 + confidence / 2)) * d.sd / math.sqrt(d.count)
    return Difference(d.mean, d.mean - half, d.mean + half, d.count)
