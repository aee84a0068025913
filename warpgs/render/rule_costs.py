"""Measured errors and times of the rules, and the choice among them by the error that is accepted."""

from __future__ import annotations

from dataclasses import dataclass

from warpgs.errors import UsageError

SOURCE = "bench/results/tradeoff_kernel_cpu2.json, scene trained"
"""Source of the figures; a test compares them. docs/trade.md says how to measure again."""


@dataclass(frozen=True)
class RuleCost:
    """Error and time of one rule against `exact`, on a trained scene."""

    rule: str
    """Name of the rule."""
    mean_error: float
    """Mean absolute error of colours in [0, 1]."""
    max_error: float
    """Largest absolute error of a colour."""
    time: float
    """Time of an image with its gradients, as a fraction of `exact`'s."""


RULE_COSTS = (
    RuleCost("fast", 6.6e-3, 0.11, 0.87),
    RuleCost("balanced", 2.4e-3, 3.8e-2, 0.93),
    RuleCost("exact", 6e-7, 2e-3, 1.0),
)
"""Costs from fast to slow. The error of `exact` is that of float32 against float64, the largest found on parts of fits of fern:
a Gaussian whose alpha is within rounding of the cut is blended by the one and not by the other."""


def select_rule(*, max_error: float) -> tuple[str, str]:
    """Return the fastest rule whose error keeps a limit.

    Args:
        max_error: Mean absolute error against rule `exact` that is accepted, of colours in [0, 1].

    Returns:
        The rule's name, for ``RasterizeOptions(rule=...)`` or ``FitConfig(rule=...)``, and a message that says why.

    Raises:
        UsageError: The limit is no positive number, or below what float32 arithmetic itself errs by.
    """
    if not 0 < max_error < float("inf"):
        raise UsageError(f"max-error must be a positive number, such as 0.002, not {max_error}")
    for cost in RULE_COSTS:
        if cost.mean_error <= max_error:
            return cost.rule, (
                f"max-error {max_error:g}: chose rule {cost.rule}, off exact by {cost.mean_error:.1e} on average and "
                f"{cost.max_error:.1e} at most on a trained scene ({SOURCE}), {cost.time:.0%} of exact's time"
            )
    least = min(p.mean_error for p in RULE_COSTS)
    raise UsageError(f"max-error {max_error:g} is below what float32 itself errs by, {least:.1e} on average; ask for more")
