"""Importance sampling: growth by gradient, and fine Gaussians behind sampled pixels, protected for some steps.

Paper, sections "Hierarchical Gaussian Representation" and "Training Strategy"; events are those of `sampling_event`.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import replace
from typing import Any

import torch

from warpgs import schema
from warpgs.kernels.step_buffers import Setting
from warpgs.pipeline.model.table import Column, DensityUpdate
from warpgs.pipeline.train.context import Growth, Settings
from warpgs.pipeline.train.strategies.base import Strategy, register
from warpgs.pipeline.train.strategies.gradient_growth import GradientGrowth
from warpgs.pipeline.train.strategies.sampling_event import (
    FINE,
    MAX_VIEWS,
    Event,
    MethodConfig,
    keep_contributors,
    sampling_event,
)
from warpgs.pipeline.train.views import TrainingView
from warpgs.runtime.step_sizes import FLOAT, SAMPLING, Needs, StepSizes

COARSE = 0
"""Number of the layer of Gaussians that were not sampled; sampled Gaussians have `FINE`."""
NOT_SAMPLED = -(2**30)
"""Value of ``created_step`` in the coarse layer, whose Gaussians were not sampled."""
_COUNT = schema.whole(0)
EVENT = schema.fields({"step": _COUNT, "added": _COUNT, "evicted": _COUNT, "quantiles": schema.items(schema.real)})
"""Schema of a stored event."""


@register("importance_sampling")
class ImportanceSampling(Strategy):
    """The method: a coarse layer, fine Gaussians sampled by importance, protection, three phases.

    Its settings are `FitConfig.density`, `FitConfig.method` and `FitConfig.phases`. With ``method.events`` off the strategy is
    clone_split.
    """

    STATE = staticmethod(schema.fields({**GradientGrowth.STATE, "events": schema.items(EVENT)}))

    def __init__(self, context):
        """Begin without events."""
        super().__init__(context)
        self.gradients = GradientGrowth(context)
        self.method = context.settings[MethodConfig]
        """Switches and settings."""
        self.events: list[dict[str, Any]] = []
        """Step of each sampling event, Gaussians added and evicted, and the quantile of the gate in each view."""
        self.on_event: Callable[[int, Event], None] | None = None
        """Function that is called with the step and the event after each event."""

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes that an event keeps for its views: render, three scores and their sum."""
        return {SAMPLING: 7 * FLOAT * sizes.pixels * min(sizes.views, MAX_VIEWS)} if self.method.events else {}

    def columns(self) -> Mapping[str, Column]:
        """Return the columns for gradients, each Gaussian's layer, and the step at which the Gaussian was sampled."""
        own = {"level": Column(COARSE, torch.int32), "created_step": Column(NOT_SAMPLED, torch.int32)}
        return {**self.gradients.columns(), **own}

    @classmethod
    def samples(cls, settings: Settings) -> bool:
        """Return whether ``method.events`` is on."""
        return settings[MethodConfig].events

    @classmethod
    def needs_priors(cls, settings: Settings) -> bool:
        """Return whether an event reads the semantic or the geometric score."""
        method = settings[MethodConfig]
        return method.events and method.needs_priors

    @property
    def fine(self) -> torch.Tensor:
        """Gaussians of the fine layer, bool, shape [N]."""
        return self.context.table.columns["level"] == FINE

    @property
    def protects(self) -> bool:
        """True if fine Gaussians are protected."""
        return self.method.events and self.method.pm

    def is_protected(self, step: int | torch.Tensor) -> torch.Tensor:
        """Return the Gaussians that are young enough for protection at a step, bool, shape [N]."""
        return step - self.context.table.columns["created_step"] <= self.method.protect.steps

    def is_layered(self, step: int) -> bool:
        """Return whether only the fine layer grows and the coarse layer moves slowly: with two layers, from phase 2 on."""
        return bool(self.method.hier) and self.method.events and step > self.context.phases.refine

    def growth(self) -> Growth:
        """Return the times of refinement and sampling; events are listed, since they lower PSNR by up to 3 dB for a while."""
        times, phases = self.gradients.times, self.context.phases
        return Growth(phases.refine, times.until, phases.events) if self.method.events else Growth(times.after, times.until)

    def phase(self, step: int) -> Hashable:
        """Return whether gradients are gathered, and whether the coarse layer moves slowly."""
        return self.gradients.gathers(step), self.is_layered(step)

    def lr_factors(self, phase):
        """Return ``method.coarse_lr_factor`` for the coarse layer and 1 for the fine one, shape [N]; None if all are 1."""
        if not phase[1]:
            return None
        return torch.where(self.fine, 1.0, self.method.coarse_lr_factor)

    def after_step(self, phase, settings, going):
        """Raise the opacities of protected Gaussians to alpha_minimum; ``settings`` [7], ``going`` [1]."""
        if self.protects:
            logits = self.context.table.params["logit_opacities"].detach()
            held = self.is_protected(settings[Setting.NUMBER]) & going
            logits.copy_(torch.where(held, logits.clamp_min(self.method.protect.logit), logits))

    def statistics(self, phase, v_projected, visible, size):
        """Return statistics of gradients, [N] each; ``v_projected`` has shape [1, N, 12], ``visible`` [1, N]."""
        return self.gradients.statistics(v_projected, visible, size) if phase[0] else {}

    def samples_after(self, step: int) -> bool:
        """Return whether fine Gaussians are sampled after a step."""
        return self.method.events and step in self.context.phases.events

    def due(self, step: int) -> bool:
        """Return whether the set changes after a step."""
        return self.gradients.due(step) or self.samples_after(step) or self.shrinks_after(step)

    def shrinks_after(self, step: int) -> bool:
        """Return whether the Gaussians that contribute least are removed after a step: after the last step of phase 2."""
        return self.method.events and self.method.keep < 1 and step == self.context.phases.stable_start

    def shrink(self, views: list[TrainingView]) -> DensityUpdate:
        """Return the change that keeps the fraction ``method.keep`` of the Gaussians."""
        t = self.context
        count = max(1, round(self.method.keep * len(t.table)))
        return keep_contributors(t.gaussians, count, views, t.render_options())

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Refine, reset opacities, sample and shrink the set, each if it is due.

        With two layers, only the fine layer grows from phase 2 on. Protected Gaussians are not pruned.
        """
        if self.gradients.refines(step):
            growing = self.fine if self.is_layered(step) else None
            yield from self.gradients.refine(growing, self.is_protected(step) if self.protects else None)
        if self.gradients.resets(step):
            self.gradients.reset_opacities()
        if self.samples_after(step):
            event = self.sample(step, self.context.views, self.method)
            yield event.change
            self.events.append({
                "step": step, "added": len(event.change.parents), "evicted": event.evicted,
                "quantiles": [v.quantile for v in event.views],
            })  # fmt: skip
            if self.on_event is not None:
                self.on_event(step, event)
        if self.shrinks_after(step):
            yield self.shrink(self.context.views)

    def sample(self, step: int, views: list[TrainingView], method: MethodConfig) -> Event:
        """Return a sampling event on some views (docs/decisions/008-method.md)."""
        t = self.context
        protected = self.is_protected(step) if method.pm else torch.zeros_like(self.fine)
        return sampling_event(
            t.gaussians, self.fine, protected, views, method,
            step=step, capacity=t.capacity - len(t.table), options=t.render_options(), generator=t.generator,
        )  # fmt: skip

    def catch_up(self, step: int, views: list[TrainingView], held: int) -> Iterator[DensityUpdate]:
        """Shrink the set; then sample fine Gaussians in the blocks that were held out, as many per pixel as elsewhere."""
        if self.method.events and self.method.keep < 1:
            yield self.shrink(self.context.views)
        pixels = sum(v.image[..., 0].numel() for v in views)
        fraction = int(self.fine.sum()) / (pixels - held) * held / pixels
        if not self.method.events or not fraction * pixels >= 1:
            return
        sampler = replace(self.method.sampler, fraction=min(1.0, fraction), max_fraction=1e6)
        for first in range(0, len(views), MAX_VIEWS):
            yield self.sample(step, views[first : first + MAX_VIEWS], replace(self.method, sampler=sampler)).change

    def state(self):
        """Return no tensors [...], and the events so far."""
        return {}, {**self.gradients.state(), "events": self.events}

    def load(self, tensors, plain):
        """Load the events so far; ``tensors`` [...] are not read."""
        self.gradients.load(plain)
        self.events = plain["events"]
