"""What a step number decides: rates, events, backgrounds; and the report of a step."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np
import torch

from warpgs.device import in_background
from warpgs.errors import UsageError
from warpgs.pipeline.metrics.scores import counted_region
from warpgs.scene import Scene, View
from warpgs.schema import Checked, Within


def log_linear(start: float, end: float, progress: float) -> float:
    """Interpolate between ``start`` and ``end`` (both positive) on a straight line in the logarithm; progress in [0, 1]."""
    progress = min(max(progress, 0.0), 1.0)
    return math.exp((1 - progress) * math.log(start) + progress * math.log(end))


def sh_degree(step: int, every: int, highest: int) -> int:
    """Return the degree in use at a step (from 1): it rises by one after each ``every`` steps, up to ``highest``."""
    return min(highest, (step - 1) // every)


LearningRate = Annotated[float, Within(0, 1e6, "(")]
"""Learning rate; the largest is far above useful rates, and far below rates that overflow within a fit."""
MEANS_LR_FINAL = 1.6e-6
"""Learning rate of the means at the last step, in units of the scene's extent (Kerbl et al. 2023)."""
QUATS_LR = 1e-3
"""Learning rate of the rotations (Kerbl et al. 2023)."""
SH_REST_FACTOR = 0.05
"""Learning rate of the higher colour coefficients, as a fraction of the constant one's (Kerbl et al. 2023)."""
MAX_DECAY = 0.1
"""Largest fraction by which a step may lower an opacity; at this value no Gaussian stays opaque."""


@dataclass(frozen=True)
class OptimizerConfig(Checked, group="optimizer."):
    """Learning rates, by default those of the reference implementation of Kerbl et al. 2023, except for the scales."""

    means_lr: LearningRate | None = 1.6e-4
    """Learning rate of the means at the start, in units of the scene's extent. None: chosen by the number of views and by
    --cpu-limit (docs/presets.md)."""
    scales_lr: LearningRate | None = 0.01
    """Learning rate of the log scales; 0.005 in the reference implementation (docs/decisions/004-scale-rate.md). None: chosen
    by the number of views."""
    scales_decay: LearningRate = 1.0
    """Learning rate of the log scales at the last step, as a fraction of the first. It falls log-linearly during phase 3;
    without phases, during the whole fit. 1: constant."""
    opacities_lr: LearningRate | None = 0.05
    """Learning rate of the opacity logits. None: chosen by the number of views."""
    opacities_decay: Annotated[float | None, Within(0, MAX_DECAY)] = 0.0
    """Fraction by which each step lowers every opacity, in [0, 0.1]; 0 for no decay. None: chosen by the number of views."""
    sh_lr: LearningRate | None = 2.5e-3
    """Learning rate of the constant colour coefficient. None: chosen as that of the means."""
    average_last: Annotated[float | None, Within(0, 1)] = 0.0
    """Fraction of the steps, the last ones, over which the parameters are averaged; the mean is the result of the fit. 0 for no
    mean. None: chosen by the views."""

    def lrs(self, progress: float, extent: float, stable_start: float = 0.0) -> dict[str, float]:
        """Return the learning rate of each parameter.

        Args:
            progress: Fraction of the fit, in [0, 1].
            extent: Size of the scene [u], a factor of the rate of the means.
            stable_start: Fraction of the fit, in [0, 1), after which the rate of the scales falls.
        """
        assert self.scales_lr is not None and self.opacities_lr is not None  # `settings_by_views` has chosen
        assert self.means_lr is not None and self.sh_lr is not None
        stable = (progress - stable_start) / (1 - stable_start)
        return {
            "means": extent * log_linear(self.means_lr, MEANS_LR_FINAL, progress),
            "quats": QUATS_LR,
            "log_scales": log_linear(self.scales_lr, self.scales_lr * self.scales_decay, stable),
            "logit_opacities": self.opacities_lr,
            "sh": self.sh_lr * SH_REST_FACTOR,
        }

    @property
    def head_lrs(self) -> dict[str, float]:
        """Learning rate of the first 3 numbers of a row, for parameters in which the other numbers have another rate."""
        assert self.sh_lr is not None  # `settings_by_views` has chosen
        return {"sh": self.sh_lr}


EVENT_STEPS, EVENT_GROWTH = 100.0, 4.0
"""Steps from the first sampling event to the second (T_base, which the paper leaves open), and growth of the interval over
phase 2, gamma: T_sample(t) = T_base (1 + gamma t), t from 0 to 1."""


@dataclass(frozen=True)
class PhaseConfig(Checked, group="phases."):
    """The paper's three phases (section "Training Strategy"), and when fine Gaussians are sampled in phase 2.

    In a fit shorter than twice the sum of phases 1 and 3, these phases and the interval between events are shortened in
    proportion.
    """

    coarse: Annotated[int, Within(0)] = 0
    """Steps of phase 1, with only the coarse layer; 2000 in the paper. If this and ``stable`` are 0, the fit has no phases."""
    stable: Annotated[int, Within(0)] = 0
    """Steps of phase 3, in which no Gaussians are added, and only unseen ones are removed; 3000 in the paper."""
    least: Annotated[float, Within(1, math.inf, ")")] = 1.0
    """Smallest number of steps from the first sampling event to the second in a short fit, which shortens this interval. On a
    CPU an event takes as long as ten steps."""


@dataclass(frozen=True)
class Phases:
    """Phases of one fit: the first ``refine`` steps are phase 1, those from ``stable_start`` on phase 3."""

    refine: int
    """Steps done when phase 2 begins."""
    stable_start: int
    """Steps done when phase 3 begins."""
    events: tuple[int, ...]
    """Steps done when fine Gaussians are sampled, ascending; the first is ``refine``, or 1 if ``refine`` is 0."""
    planned: int
    """Planned number of steps; it determines how fast learning rates decay up to phase 3."""
    steps: int
    """Number of steps; fewer than planned if phase 3 begins early."""

    def number(self, step: int) -> int:
        """Return the phase of the step after ``step`` steps: 1, 2 or 3."""
        return 1 + (step >= self.refine) + (step >= self.stable_start)

    def progress(self, step: int) -> float:
        """Return the finished fraction of the fit before a step counted from 1, in [0, 1]; phase 3 ends with 1."""
        planned = max(1, self.planned - 1)
        if self.steps == self.planned or step <= self.stable_start:
            return (step - 1) / planned
        begun = (self.stable_start - 1) / planned
        return begun + (1 - begun) * (step - self.stable_start) / (self.steps - self.stable_start)

    def stable_from(self, step: int, planned_start: int) -> "Phases":
        """Return the phases for a third phase that begins after ``step``, not as planned, and is shortened in proportion."""
        length = round((self.planned - planned_start) * step / max(1, planned_start))
        return replace(self, stable_start=step, steps=min(self.planned, step + max(1, length)))


def plan_phases(config: PhaseConfig, steps: int) -> Phases:
    """Plan the phases of a fit of that many steps.

    There are 102 events in 25,000 steps of phase 2, and 21 in 5000.
    """
    outer = config.coarse + config.stable
    shrink = min(1.0, 0.5 * steps / outer) if outer else 1.0
    refine, stable_start = round(shrink * config.coarse), steps - round(shrink * config.stable)
    length, at, events = stable_start - refine, 0.0, []
    while at < length:
        events.append(max(1, refine + int(at)))
        at += max(min(config.least, EVENT_STEPS), shrink * EVENT_STEPS) * (1 + EVENT_GROWTH * at / length)
    return Phases(refine, stable_start, tuple(events), steps, steps)


Color = tuple[float, float, float]
"""Red, green and blue in [0, 1]."""
NAMED: dict[str, Color] = {"black": (0.0, 0.0, 0.0), "white": (1.0, 1.0, 1.0)}
CHOSEN = ("auto", "mean", "scene")
"""Names of colours that depend on the scene."""
BEHIND = 0x62616B67
"""Seed component that makes random backgrounds independent of other random numbers of a fit."""
LEVELS = 2**16 - 1
"""Number of levels to which colours are rounded before they are added: sums of integers are exact in any order."""


def color_of(text: str) -> Color | None:
    """Return the colour that a text names, as `FitConfig.background`; None for a colour that depends on the scene."""
    if text in CHOSEN:
        return None
    if text in NAMED:
        return NAMED[text]
    if re.fullmatch(r"#[0-9a-fA-F]{6}", text):
        red, green, blue = bytes.fromhex(text[1:])
        return red / 255, green / 255, blue / 255
    parts = text.split(",")
    if len(parts) == 3 and all(re.fullmatch(r" *([01]|[01]?\.[0-9]{1,17}|[01]\.) *", p) for p in parts):
        red, green, blue = map(float, parts)
        if max(red, green, blue) <= 1:
            return red, green, blue
    known = "auto, mean, scene, black, white, #rrggbb, or r,g,b in [0, 1]"
    raise UsageError(f"background {text[:60]!r} is not a colour: give {known}")


def mean_color(views: list[View]) -> Color:
    """Return the mean colour of all unmasked pixels of views; it has the same bits on every machine."""

    def sums(v: View) -> np.ndarray:
        levels = np.multiply(v.image, LEVELS, dtype=np.float64)
        np.rint(levels, out=levels)
        if v.mask is not None:
            levels[~v.mask] = 0
        rows = levels.reshape(len(levels), -1).sum(axis=0)  # exact below 2^53
        return np.array([*rows.reshape(-1, 3).sum(axis=0), v.image[..., 0].size if v.mask is None else v.mask.sum()])

    *total, count = sum(in_background(sums, ((v,) for v in views)), np.zeros(4))
    red, green, blue = (float(t) / (LEVELS * max(float(count), 1)) for t in total)
    return red, green, blue


def choose_background(wish: str, scene: Scene, train: list[View]) -> tuple[Color, str]:
    """Return the colour behind a scene, and a note for the user; no note if opaque views keep the scene's own background."""
    color, why = color_of(wish), wish
    if color is None:
        cut_out = any(v.alpha is not None or counted_region(v)[1] == "foreground" for v in train)
        if wish == "mean" or (wish == "auto" and not cut_out):
            color, why = mean_color(train), "the mean colour of the training views"
        elif cut_out:
            color, why = scene.background, "that of the scene's files, since views show a cut-out object"
        else:
            return scene.background, ""
    code = "".join(f"{round(255 * c):02x}" for c in color)
    return color, f"background: {why}, #{code}; change it with --background"


def over_background(scene: Scene, color: Color) -> Scene:
    """Return the scene over another background [3]; images change where views are transparent."""
    if color == scene.background:
        return scene
    shift = np.float32(color) - np.float32(scene.background)

    def moved(v: View) -> View:
        return v if v.alpha is None else replace(v, image=np.clip(v.image + (1 - v.alpha[..., None]) * shift, 0, 1))

    return replace(scene, background=color, views=tuple(map(moved, scene.views)))


def over(image: torch.Tensor, alpha: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
    """Return an image [H, W, 3] of opacity ``alpha`` [H, W] over another background: its own background plus ``shift`` [3]."""
    return image + (1 - alpha)[..., None] * shift


def random_shift(seed: int, step: int, background: Sequence[float]) -> tuple[float, float, float]:
    """Return a random colour, uniform in [0, 1], minus the scene's background [3]; it depends on seed and step only."""
    red, green, blue = (b - a for a, b in zip(background, np.random.default_rng([seed, step, BEHIND]).random(3).tolist()))
    return red, green, blue


@dataclass(frozen=True)
class StepReport:
    """Results of one step."""

    step: int
    """Steps done, from 1."""
    loss: float
    """Loss on the view of the step; with several views, the mean."""
    psnr: float
    """PSNR on the view of the step before the update [dB]; with several views, the PSNR of their mean squared error."""
    count: int
    """Number of Gaussians after the step."""
    seconds: float
    """Wall time of the step [s]."""
