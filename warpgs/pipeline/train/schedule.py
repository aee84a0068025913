"""How learning rates and the spherical-harmonics degree change over a fit, and which phases it has."""

from __future__ import annotations

import math
from dataclasses import dataclass

from warpgs.errors import UsageError


def log_linear(start: float, end: float, progress: float) -> float:
    """Value between ``start`` and ``end`` (both positive) on a straight line in the logarithm; progress in [0, 1]."""
    progress = min(max(progress, 0.0), 1.0)
    return math.exp((1 - progress) * math.log(start) + progress * math.log(end))


def sh_degree(step: int, every: int, highest: int) -> int:
    """Degree in use at a step counted from 1: one more after every ``every`` steps, up to ``highest``."""
    return min(highest, (step - 1) // every)


@dataclass(frozen=True)
class PhaseConfig:
    """The paper's three phases (section "Training Strategy"), and when fine Gaussians are sampled in the second.

    A fit shorter than twice phases 1 and 3 together has all of them, and the interval, shortened in proportion.
    """

    coarse: int = 0
    """Steps of phase 1, in which there is the coarse layer alone; 2000 in the paper. 0 with ``stable`` 0: no phases."""
    stable: int = 0
    """Steps of phase 3, in which the set stays as it is; 3000 in the paper."""
    every: float = 100.0
    """Steps from the first sampling event to the second (T_base, which the paper leaves open)."""
    growth: float = 4.0
    """Growth of that interval over phase 2 (gamma, with the time t from 0 to 1): T_sample(t) = T_base (1 + gamma t)."""

    def __post_init__(self):
        if self.coarse < 0 or self.stable < 0 or not 1 <= self.every < math.inf or not 0 <= self.growth < math.inf:
            raise UsageError("phases: coarse, stable and growth must be at least 0, every at least 1, and all finite")


@dataclass(frozen=True)
class Phases:
    """Phases of one fit: the first ``refine`` steps are phase 1, those from ``stable_start`` on phase 3."""

    refine: int
    """Steps done when phase 2 begins."""
    stable_start: int
    """Steps done when phase 3 begins."""
    events: tuple[int, ...]
    """Steps done when fine Gaussians are sampled, ascending; the first is ``refine``, or 1 where that is 0."""


@dataclass(frozen=True)
class Phase:
    """What a step does beyond rendering, comparing and updating; steps of one phase can share a recording."""

    degree: int
    """Spherical-harmonics degree in use."""
    densifying: bool
    """Gradients are gathered, and the set is refined now and then."""
    layered: bool
    """The coarse layer is kept stable."""
    halved: bool
    """Views are half their size."""
    depth_supervised: bool
    """The loss has its depth term."""


def plan_phases(config: PhaseConfig, steps: int) -> Phases:
    """The phases of a fit of that many steps.

    With the paper's numbers there are 102 events in 25,000 steps of phase 2 and 21 in 5000.
    """
    outer = config.coarse + config.stable
    shrink = min(1.0, 0.5 * steps / outer) if outer else 1.0
    refine, stable_start = round(shrink * config.coarse), steps - round(shrink * config.stable)
    length, at, events = stable_start - refine, 0.0, []
    while at < length:
        events.append(max(1, refine + int(at)))
        at += max(1.0, shrink * config.every) * (1 + config.growth * at / length)
    return Phases(refine, stable_start, tuple(events))
