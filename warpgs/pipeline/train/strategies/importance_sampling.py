"""Importance sampling: Gaussians are added where views are rendered worst."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from warpgs import geometry, schema
from warpgs.device import FLOAT, SAMPLING, Needs, StepSizes
from warpgs.errors import UsageError
from warpgs.kernels.update import Setting
from warpgs.pipeline.model.table import Column, DensityUpdate
from warpgs.pipeline.train import sampling as scoring
from warpgs.pipeline.train.sampling import (
    ImportanceConfig,
    Residual,
    SamplerConfig,
    fine_gaussians,
    gain_map,
    geometry_gate,
    residual_of,
    sample_pixels,
    valid_pixels,
)
from warpgs.pipeline.train.strategies.base import Growth, Settings, Strategy, register
from warpgs.pipeline.train.strategies.clone_split import GradientGrowth
from warpgs.pipeline.train.views import TrainingView, half_size_camera
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Gaussians, Prior, ViewDepth

# A sampling event: score the training views, sample pixels, add fine Gaussians behind them. And the settings of events.
#
# Paper, sections "Multi-Modal Importance Assessment" and "Geometric-Aware Sampling".

FINE = 1
"""Number of the layer of sampled Gaussians."""
MAX_VIEWS = 8
"""Largest number of views in which one event samples; of more views, a random subset is taken."""
MAX_WEIGHED = 32
"""Largest number of views over which blending weights are summed to choose Gaussians for eviction."""


@dataclass(frozen=True)
class ProtectConfig:
    """Protection of new Gaussians."""

    steps: int = 500
    """Age up to which a sampled Gaussian is protected [steps] (T_protect; the paper gives no value). The default is five
    densification intervals."""
    opacity: float = 0.05
    """Smallest opacity of a protected Gaussian, in (0, 1) (alpha_minimum). The default is ten times the pruning threshold."""

    def __post_init__(self):
        if self.steps < 0 or not 0 < self.opacity < 1:
            raise UsageError(f"protect: `steps` must be at least 0, `opacity` in (0, 1), not {self.steps} and {self.opacity}")

    @property
    def logit(self) -> float:
        """Smallest opacity, as a stored logit."""
        return geometry.logit(self.opacity)


@dataclass(frozen=True)
class MethodConfig:
    """Switches and settings of the paper's parts (its Table 2). With all off, the method is 3D Gaussian splatting."""

    events: bool = False
    """Sampling events, which add fine Gaussians in phase 2."""
    hier: bool | None = False
    """Two layers: from phase 2 on, the coarse layer is neither cloned nor split, and its means move slowly. None: chosen by the
    number of views."""
    s_render: bool = True
    """Use the rendering residual in the importance."""
    s_semantic: bool = True
    """Use the semantic score in the importance."""
    s_geometry: bool = True
    """Use the geometric score in the importance. With gate_quantile above 0 (preset paper-literal), the reliability gate uses
    the score even if this is off."""
    ra: bool = True
    """Reliability gate: sample only pixels above gate_quantile of the geometric score. With sampler.depth consistent, views
    with consistent depth are also sampled only where it exists."""
    agp: bool = True
    """Adaptive Gaussian placement: sample pixels at random in proportion to importance. If off, take the pixels of highest
    importance."""
    pm: bool = True
    """Protection mechanism: new fine Gaussians keep a minimum opacity and are not pruned."""
    coarse_lr_factor: float = 0.1
    """Factor on the learning rate of the coarse layer's means from phase 2 on, with two layers, in [0, 1]."""
    keep: float = 1.0
    """Fraction of the Gaussians that is kept when phase 3 begins, in (0, 1]: those with the largest sums of blending weights
    over at most 32 training views."""
    importance: ImportanceConfig = field(default_factory=ImportanceConfig)
    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    protect: ProtectConfig = field(default_factory=ProtectConfig)

    def __post_init__(self):
        if not 0 < self.keep <= 1:
            raise UsageError(f"method: `keep` must be in (0, 1], not {self.keep}")
        if not 0 <= self.coarse_lr_factor <= 1:
            raise UsageError(f"method: `coarse-lr-factor` must be between 0 and 1, not {self.coarse_lr_factor}")

    def weights(self, semantics: bool = True) -> tuple[float, float, float]:
        """Return the weights of the render, semantic and geometric score, 0 where switched off, scaled to sum to 1.

        ``semantics`` is False for a view without a semantic score.
        """
        semantic = self.s_semantic and semantics
        return scoring.weights(self.importance, render=self.s_render, semantic=semantic, geometry=self.s_geometry)

    @property
    def asked_quantile(self) -> float:
        """Requested quantile of the geometric score for the gate; 0 for no such gate."""
        return self.sampler.gate_quantile if self.ra else 0.0

    @property
    def needs_priors(self) -> bool:
        """True if an event reads the semantic or the geometric score, which are computed from priors."""
        _, semantic, geometry = self.weights()
        return semantic > 0 or geometry > 0 or self.asked_quantile > 0


def scored(view: TrainingView, prior: Prior | None, depth: ViewDepth | None, config: MethodConfig) -> TrainingView:
    """Return the view with its geometrically consistent depth and, if it has a prior, with the scores of the prior."""
    if depth is not None and depth.valid.any():
        consistent = torch.as_tensor(np.where(depth.valid, depth.depth, 0), dtype=torch.float32, device=view.image.device)
        view = dataclasses.replace(view, consistent=consistent)
    if prior is None:
        return view
    maps = {n: torch.as_tensor(getattr(prior, n), dtype=torch.float32, device=view.image.device)
            for n in ("disparity", "confidence", "boundary", "foreground")}  # fmt: skip
    valid = None if view.countable is None else view.countable > 0
    geometry = scoring.geometry_score(maps.pop("disparity"), config.importance.curvature, valid)
    semantic = scoring.semantic_score(**maps)
    return dataclasses.replace(view, semantic=semantic if bool(semantic.any()) else None, geometry=geometry)


@dataclass(frozen=True)
class SampledView:
    """Maps and samples of an event in one view, on the device of the fit."""

    view: int
    """Index of the training view."""
    rendered: torch.Tensor
    """Colours before the event, shape [H, W, 3]."""
    scores: tuple[torch.Tensor, torch.Tensor, torch.Tensor]
    """Residual, semantic and geometric score, each [H, W] in [0, 1]; all 0 if the score was not computed."""
    score: torch.Tensor
    """Importance, the weighted sum of ``scores``, shape [H, W]."""
    gate: torch.Tensor
    """Pixels that could be sampled, bool, shape [H, W]."""
    quantile: float
    """Quantile of the geometric score that the gate used; lower than requested if too few pixels passed."""
    at: torch.Tensor
    """Rows and columns of the sampled pixels, int64, shape [S, 2]."""


@dataclass(frozen=True)
class Event:
    """One sampling event."""

    change: DensityUpdate
    """Rows that stay and rows that are new."""
    evicted: int
    """Fine Gaussians that were removed for the new ones."""
    views: tuple[SampledView, ...]
    """Samples of each view."""


class Rendered(NamedTuple):
    """A render of a view before an event, and the pixels that can be sampled."""

    rgb: torch.Tensor
    """Rendered colours after the view modules of the fit, shape [H, W, 3]."""
    surface: torch.Tensor
    """Rendered z-depth [u], shape [H, W]."""
    depth: torch.Tensor
    """Depth that Gaussians are placed at [u], shape [H, W]."""
    valid: torch.Tensor
    """Pixels that can be sampled, bool, shape [H, W]."""


def render_before(gaussians: Gaussians, view: TrainingView, config: MethodConfig, options: RasterizeOptions) -> Rendered:
    """Render a view for an event, and find the depths for Gaussians at its pixels."""
    render = rasterize(gaussians, view.camera, options)
    depth, alpha = render.depth, render.alpha
    if config.sampler.depth == "consistent" and view.consistent is not None:
        known = view.consistent > 0
        depth = torch.where(known, view.consistent, depth)
        alpha = torch.where(known, 1.0, 0.0 if config.ra else alpha)
    return Rendered(view.seen(render.rgb), render.depth, depth, valid_pixels(alpha, depth, view.countable, config.sampler))


def sample_view(
    view: TrainingView, number: int, rendered: Rendered, residuals: Sequence[Residual], config: MethodConfig,
    coefficients: int, generator: torch.Generator,
) -> tuple[SampledView, dict[str, torch.Tensor]]:  # fmt: skip
    """Score one view and sample its pixels; return maps and samples, and rows [S, ...] of fine Gaussians behind the pixels.

    Args:
        view: The view.
        number: Index of the view.
        rendered: The view before the event.
        residuals: Residuals of all views of the event, to compute gains; empty if the residual is a length.
        config: Switches and settings.
        coefficients: Spherical-harmonics coefficients per channel.
        generator: CPU generator, the same numbers on every device.
    """
    c, (rgb, _, depth, valid) = config.sampler, rendered
    known = view.semantic is not None
    geometry, semantic = (torch.zeros_like(depth) if s is None else s for s in (view.geometry, view.semantic))
    weights = config.weights(known)
    if residuals:
        residual = scoring.normalized(gain_map(view, depth, valid, residuals), valid)
    elif sum(weights) > 0:
        residual = scoring.render_score(rgb, view.image, valid)
    else:
        residual = torch.zeros_like(depth)
    scores = (residual, semantic, geometry)
    score = scoring.importance(scores, weights)
    wanted = max(1, round(c.fraction * valid.numel()))
    gate, quantile = geometry_gate(geometry, valid, config.asked_quantile, wanted)
    at = sample_pixels(score, gate, wanted, generator, random=config.agp)
    rows = fine_gaussians(view.camera, view.image, depth, at, c, coefficients)
    return SampledView(number, rgb, scores, score, gate, quantile, at), rows


def least_contributing(
    gaussians: Gaussians, candidates: torch.Tensor, count: int, views: list[TrainingView], options: RasterizeOptions
) -> torch.Tensor:
    """Return the rows of the ``count`` candidates (bool [N]) with the least sums of blending weights, int64 [count].

    The sums are over at most `MAX_WEIGHED` views, evenly spaced, at half size, which suffices to rank the Gaussians.
    """
    total = torch.zeros(len(gaussians), device=gaussians.means.device, dtype=torch.float32)
    for view in views[:: -(-len(views) // MAX_WEIGHED)]:
        total += rasterize(gaussians, half_size_camera(view.camera), options).weight_sums[0]
    total = torch.where(candidates, total, torch.inf)
    return torch.topk(total, min(count, int(candidates.sum())), largest=False).indices


@torch.no_grad()
def keep_contributors(gaussians: Gaussians, count: int, views: list[TrainingView], options: RasterizeOptions) -> DensityUpdate:
    """Return the change that keeps the ``count`` Gaussians with the largest sums of blending weights over the views.

    At most `MAX_WEIGHED` views are rendered, evenly spaced.
    """
    weigh = dataclasses.replace(options, contributions=True)
    total = torch.zeros(len(gaussians), device=gaussians.means.device, dtype=torch.float32)
    for view in views[:: -(-len(views) // MAX_WEIGHED)]:
        total += rasterize(gaussians, view.camera, weigh).weight_sums[0]
    ids = torch.topk(total, min(count, len(gaussians))).indices.sort().values
    return DensityUpdate(ids, {n: t[:0] for n, t in gaussians.tensors().items()}, ids[:0])


def _sampled(
    gaussians: Gaussians, views: list[TrainingView], config: MethodConfig, options: RasterizeOptions, generator: torch.Generator
) -> tuple[dict[str, torch.Tensor], tuple[SampledView, ...]]:
    """Return the Gaussians sampled in the views, as tensors by name, and the maps used."""
    numbers = list(range(len(views)))
    if len(views) > MAX_VIEWS:
        numbers = sorted(torch.randperm(len(views), generator=generator, device="cpu")[:MAX_VIEWS].tolist())
    before = [render_before(gaussians, views[i], config, options) for i in numbers]
    residuals: list[Residual] = []
    if config.importance.residual == "gain" and config.weights()[0] > 0:
        footprint = config.sampler.footprint
        residuals = [residual_of(views[i], b.rgb, b.surface, footprint) for i, b in zip(numbers, before, strict=True)]
    coefficients = gaussians.sh.shape[1]
    sampled, rows = zip(
        *(sample_view(views[i], i, b, residuals, config, coefficients, generator) for i, b in zip(numbers, before, strict=True))
    )
    return {name: torch.cat([r[name] for r in rows]) for name in rows[0]}, sampled


@torch.no_grad()
def sampling_event(
    gaussians: Gaussians,
    fine: torch.Tensor,
    protected: torch.Tensor,
    views: list[TrainingView],
    config: MethodConfig,
    *,
    step: int,
    capacity: int,
    options: RasterizeOptions,
    generator: torch.Generator,
) -> Event:
    """Sample fine Gaussians by the importance of the pixels of the training views.

    If the fine layer reaches its limit (``sampler.max_fraction`` of the coarse layer) or the set reaches its capacity, the
    unprotected fine Gaussians that contribute least to the training views are evicted. New Gaussians beyond these limits are
    not added.

    Args:
        gaussians: The current set, N rows.
        fine: Gaussians of the fine layer, bool, shape [N].
        protected: Gaussians that are not evicted, bool, shape [N].
        views: Training views with their scores.
        config: Switches and settings.
        step: Steps done.
        capacity: Number of Gaussians that may be added.
        options: Settings of the rasterizer.
        generator: CPU generator, the same numbers on every device.

    Returns:
        The change, and the maps used.
    """
    added, sampled = _sampled(gaussians, views, config, options, generator)
    count = len(added["means"])
    coarse_count, fine_count = int((~fine).sum()), int(fine.sum())
    over = max(fine_count + count - int(config.sampler.max_fraction * coarse_count), count - capacity)
    keep = torch.ones(len(gaussians), dtype=torch.bool, device=fine.device)
    evicted = 0
    if over > 0:
        weigh = dataclasses.replace(options, contributions=True)
        ids = least_contributing(gaussians, fine & ~protected, over, views, weigh)
        keep[ids] = False
        evicted = len(ids)
        if over > evicted:  # spread over the views, as they were sampled
            order = torch.randperm(count, generator=generator, device="cpu")
            left = order[: max(0, count - (over - evicted))].sort().values.to(fine.device)
            added = {name: t[left] for name, t in added.items()}
            count = len(left)
    parents = torch.full((count,), -1, dtype=torch.int64, device=fine.device)
    columns = {"level": FINE, "created_step": step}
    return Event(DensityUpdate(torch.nonzero(keep).squeeze(1), added, parents, columns), evicted, sampled)


# Importance sampling: growth by gradient, and fine Gaussians behind sampled pixels, protected for some steps.
#
# Paper, sections "Hierarchical Gaussian Representation" and "Training Strategy"; events are those of `sampling_event`.

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
