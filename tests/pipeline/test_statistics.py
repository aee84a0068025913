"""Means, deviations and paired intervals against scipy and by simulation."""

import math

import numpy as np
import pytest
from scipy import stats

from warpgs.pipeline.study.tables import family_confidence, paired_difference, sample


@pytest.mark.parametrize("n", [2, 3, 5, 40])
@pytest.mark.parametrize("confidence", [0.8, 0.95, 0.99])
def test_interval_equals_scipys_paired_t(n, confidence):
    """Mean, both ends and the verdict on zero, for few and many pairs."""
    rng = np.random.default_rng(n)
    base = 20 + rng.standard_normal(n)
    ours = base + 0.1 + 0.1 * rng.standard_normal(n)
    expected = stats.ttest_rel(ours, base).confidence_interval(confidence)
    d = paired_difference(list(ours), list(base), confidence)
    assert d.mean == pytest.approx(np.mean(ours - base)) and d.count == n
    assert (d.low, d.high) == pytest.approx((expected.low, expected.high), rel=1e-9)
    assert d.excludes_zero == (stats.ttest_rel(ours, base).pvalue < 1 - confidence)


def test_interval_holds_the_truth_as_often_as_it_says():
    """Of 2000 studies with five pairs each about 95 of a hundred contain the true difference."""
    rng = np.random.default_rng(1)
    hits = 0
    for _ in range(2000):
        base = rng.standard_normal(5)
        d = paired_difference(base + 0.3 + 0.2 * rng.standard_normal(5), base)
        hits += d.low <= 0.3 <= d.high
    assert abs(hits / 2000 - 0.95) < 0.02


def test_sample_equals_numpy_and_few_are_no_number():
    """Bessel's correction; one measurement has no deviation, none no mean; one pair no interval."""
    values = [20.1, 19.7, 20.4, 20.0]
    s = sample(values)
    assert (s.mean, s.sd, s.count) == pytest.approx((np.mean(values), np.std(values, ddof=1), 4))
    assert math.isnan(sample([1.0]).sd) and math.isnan(sample([]).mean)
    d = paired_difference([2.0], [1.0])
    assert d.mean == 1 and math.isnan(d.low) and not d.excludes_zero
    assert paired_difference([1.0, 2.0], [0.0, 1.0]).low == 1.0


def test_unpaired_measurements_are_refused():
    """A missing measurement is not dropped in silence."""
    with pytest.raises(ValueError):
        paired_difference([1.0, 2.0], [1.0])


def test_intervals_of_several_rows_hold_together():
    """Of ten null effects with five seeds, one has an interval without 0 in at most 5 % of all tables."""
    rng = np.random.default_rng(0)
    found = {1: 0, 10: 0}
    for _ in range(300):
        base = rng.standard_normal(5)
        rows = [base + rng.standard_normal(5) for _ in range(10)]
        for count in found:
            found[count] += any(paired_difference(r, base, family_confidence(count)).excludes_zero for r in rows)
    assert found[10] <= 25 and found[1] >= 75  # 15 +- 3.8 expected, 25 is 2.7 standard deviations above; 120 without
