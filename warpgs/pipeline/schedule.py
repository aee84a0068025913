"""How learning rates and the spherical-harmonics degree change over a fit."""

from __future__ import annotations

import math


def log_linear(start: float, end: float, progress: float) -> float:
    """Value between ``start`` and ``end`` (both positive) on a straight line in the logarithm; progress in [0, 1]."""
    progress = min(max(progress, 0.0), 1.0)
    return math.exp((1 - progress) * math.log(start) + progress * math.log(end))


def sh_degree(step: int, every: int, highest: int) -> int:
    """Degree in use at a step counted from 1: one more after every ``every`` steps, up to ``highest``."""
    return min(highest, (step - 1) // every)
