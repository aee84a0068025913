"""Importance sampling: score the training views, sample pixels, put fine Gaussians behind them, protect them for a while.

Paper, sections "Hierarchical Gaussian Representation", "Geometric-Aware Sampling" and "Training Strategy".
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import torch

from warpgs import geometry, schema
from warpgs.errors import UsageError
from warpgs.kernels.step_buffers import Setting
from warpgs.pipeline.model.table import Column, DensityUpdate
from warpgs.pipeline.train.exposure import seen_in
from warpgs.pipeline.train.strategies import importance as scoring
from warpgs.pipeline.train.strategies.base import register
from warpgs.pipeline.train.strategies.clone_split import CloneSplit
from warpgs.pipeline.train.strategies.importance import ImportanceConfig
from warpgs.pipeline.train.strategies.sampler import (
    SamplerConfig,
    fine_gaussians,
    geometry_gate,
    sample_pixels,
    valid_pixels,
)
from warpgs.pipeline.train.views import TrainingView, half_size_camera
from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.scene import Gaussians, Prior, ViewDepth

COARSE, FINE = 0, 1
"""Layers."""
NOT_SAMPLED = -(2**30)
"""``created_step`` of Gaussians that were not sampled: the coarse layer."""
MAX_VIEWS = 8
"""Largest number of views that one event samples in; chosen at random where there are more."""
MAX_WEIGHED = 32
"""Largest number of views over which blending weights are summed for an eviction."""
_COUNT = schema.whole(0)
EVENT = schema.fields({"step": _COUNT, "added": _COUNT, "evicted": _COUNT, "quantiles": schema.items(schema.real)})
"""Schema of what is stored of an event."""


@dataclass(frozen=True)
class ProtectConfig:
    """Protection of new Gaussians."""

    steps: int = 500
    """Age [steps] up to which a sampled Gaussian is protected (T_protect, which the paper leaves open): five refinements."""
    opacity: float = 0.05
    """Least opacity of a protected Gaussian, in (0, 1) (alpha_minimum): ten times what is pruned."""

    def __post_init__(self):
        if self.steps < 0 or not 0 < self.opacity < 1:
            raise UsageError("protect: steps must be at least 0 and opacity lie in (0, 1)")

    @property
    def logit(self) -> float:
        """Least opacity as a logit, as it is stored."""
        return geometry.logit(self.opacity)


@dataclass(frozen=True)
class MethodConfig:
    """Switches of the paper's parts (its Table 2), and their settings. All off is plain 3D Gaussian splatting."""

    events: bool = False
    """Sampling events: fine Gaussians are added in phase 2."""
    hier: bool = False
    """Two layers: from phase 2 on the coarse one is neither cloned nor split, and its means move slowly."""
    s_render: bool = True
    """Weight of the rendering residual in the importance."""
    s_semantic: bool = True
    """Weight of the semantic score in the importance."""
    s_geometry: bool = True
    """Weight of the geometric score in the importance. A gate with gate_quantile above 0 (paper-literal) uses the map even when
    this is off; with 0 (default, quick) no gate uses it."""
    ra: bool = True
    """Reliability gate: only pixels above gate_quantile of the geometric score (0: no such gate) and, with sampler.depth
    consistent, only pixels with consistent depth in views that have some."""
    agp: bool = True
    """Adaptive Gaussian placement: pixels are sampled at random by importance; off takes the highest ones."""
    pm: bool = True
    """Protection mechanism: new fine Gaussians keep a least opacity and are not pruned."""
    coarse_lr_factor: float = 0.1
    """Fraction of its Adam step that each mean of the coarse layer takes from phase 2 on, in [0, 1]."""
    importance: ImportanceConfig = field(default_factory=ImportanceConfig)
    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    protect: ProtectConfig = field(default_factory=ProtectConfig)

    def __post_init__(self):
        if not 0 <= self.coarse_lr_factor <= 1:
            raise UsageError(f"method coarse-lr-factor {self.coarse_lr_factor} must lie between 0 and 1")

    def weights(self, semantics: bool = True) -> tuple[float, float, float]:
        """Return the weights of the render, semantic and geometric score, 0 where switched off, scaled to sum to 1.

        ``semantics`` is False for a view without a semantic score.
        """
        semantic = self.s_semantic and semantics
        return scoring.weights(self.importance, render=self.s_render, semantic=semantic, geometry=self.s_geometry)


def scored(view: TrainingView, prior: Prior, depth: ViewDepth | None, config: MethodConfig) -> TrainingView:
    """Return the view with the scores of its prior and its geometrically consistent depth."""
    maps = {n: torch.as_tensor(getattr(prior, n), dtype=torch.float32, device=view.image.device)
            for n in ("disparity", "confidence", "boundary", "foreground")}  # fmt: skip
    valid = None if view.countable is None else view.countable > 0
    geometry = scoring.geometry_score(maps.pop("disparity"), config.importance.curvature, valid)
    semantic = scoring.semantic_score(**maps)
    consistent = None
    if depth is not None and depth.valid.any():
        consistent = torch.as_tensor(np.where(depth.valid, depth.depth, 0), dtype=torch.float32, device=view.image.device)
    known = semantic if bool(semantic.any()) else None
    return dataclasses.replace(view, semantic=known, geometry=geometry, consistent=consistent)


@dataclass(frozen=True)
class SampledView:
    """Maps and samples of an event in one view, on the device of the fit."""

    view: int
    """Number of the training view."""
    rendered: torch.Tensor
    """Colours before the event, shape [H, W, 3]."""
    scores: tuple[torch.Tensor, torch.Tensor, torch.Tensor]
    """Render, semantic and geometric score, each [H, W] in [0, 1]."""
    score: torch.Tensor
    """Their weighted sum, shape [H, W]."""
    gate: torch.Tensor
    """Pixels that could be sampled, bool, shape [H, W]."""
    quantile: float
    """Quantile of the geometric score that the gate used; lower than asked for where too few pixels passed."""
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


def sample_view(
    gaussians: Gaussians, view: TrainingView, number: int, config: MethodConfig, options: RasterizeOptions,
    generator: torch.Generator,
) -> tuple[SampledView, dict[str, torch.Tensor]]:  # fmt: skip
    """Score one view, sample its pixels, and return them with the rows [S, ...] of the fine Gaussians behind them."""
    c = config.sampler
    render = rasterize(gaussians, view.camera, options)
    depth, alpha = render.depth, render.alpha
    if c.depth == "consistent" and view.consistent is not None:
        known = view.consistent > 0
        depth = torch.where(known, view.consistent, depth)
        alpha = torch.where(known, 1.0, 0.0 if config.ra else alpha)
    valid = valid_pixels(alpha, depth, view.countable, c)
    known = view.semantic is not None
    semantic = view.semantic if known else torch.zeros_like(view.geometry)
    scores = (scoring.render_score(seen_in(view, render.rgb), view.image, valid), semantic, view.geometry)
    score = scoring.importance(scores, config.weights(known))
    wanted = max(1, round(c.fraction * valid.numel()))
    gate, quantile = geometry_gate(view.geometry, valid, c.gate_quantile if config.ra else 0.0, wanted)
    at = sample_pixels(score, gate, wanted, generator, random=config.agp)
    rows = fine_gaussians(view.camera, view.image, depth, at, c, gaussians.sh.shape[1])
    return SampledView(number, render.rgb, scores, score, gate, quantile, at), rows


def least_contributing(
    gaussians: Gaussians, candidates: torch.Tensor, count: int, views: list[TrainingView], options: RasterizeOptions
) -> torch.Tensor:
    """Return the rows of the ``count`` candidates (bool [N]) with the least sums of blending weights, int64 [count].

    The sums are over at most `MAX_WEIGHED` views, evenly spaced, at half their size: they only have to rank.
    """
    total = torch.zeros(len(gaussians), device=gaussians.means.device)
    for view in views[:: -(-len(views) // MAX_WEIGHED)]:
        total += rasterize(gaussians, half_size_camera(view.camera), options).weight_sums[0]
    total = torch.where(candidates, total, torch.inf)
    return torch.topk(total, min(count, int(candidates.sum())), largest=False).indices


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

    Where the fine layer is as large as it may be (``sampler.max_fraction`` of the coarse one), those of its Gaussians that
    contribute least to the training views are evicted, the protected ones excepted; new ones beyond the limit are not added.

    Args:
        gaussians: The current set, N rows.
        fine: Gaussians of the fine layer, bool, shape [N].
        protected: Gaussians that are not evicted, bool, shape [N].
        views: Training views with their scores.
        config: Switches and settings.
        step: Steps done.
        capacity: Gaussians that may be added.
        options: Settings of the rasterizer.
        generator: CPU generator, the same numbers on every device.

    Returns:
        The change, and the maps that led to it.
    """
    numbers = list(range(len(views)))
    if len(views) > MAX_VIEWS:
        numbers = sorted(torch.randperm(len(views), generator=generator)[:MAX_VIEWS].tolist())
    sampled, rows = zip(*(sample_view(gaussians, views[i], i, config, options, generator) for i in numbers))
    added = {name: torch.cat([r[name] for r in rows]) for name in rows[0]}
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
            left = torch.randperm(count, generator=generator)[: max(0, count - (over - evicted))].sort().values.to(fine.device)
            added = {name: t[left] for name, t in added.items()}
            count = len(left)
    parents = torch.full((count,), -1, dtype=torch.int64, device=fine.device)
    columns = {"level": FINE, "created_step": step}
    return Event(DensityUpdate(torch.nonzero(keep).squeeze(1), added, parents, columns), evicted, sampled)


@register("importance_sampling")
class ImportanceSampling(CloneSplit):
    """The method: a coarse layer, fine Gaussians sampled by importance, protection, three phases.

    Its settings are `FitConfig.method` and `FitConfig.phases`; with ``method.events`` off it is `CloneSplit`.
    """

    def __init__(self, trainer):
        """Begin without events."""
        super().__init__(trainer)
        self.events: list[dict] = []
        """Step of each sampling event, Gaussians added and evicted, and the quantile of the gate in each view."""
        self.on_event: Callable[[int, Event], None] | None = None
        """Function that is called with the step and the event after each event."""

    def columns(self) -> Mapping[str, Column]:
        """Return the columns of clone and split, the layer of each Gaussian, and the step at which it was sampled."""
        own = {"level": Column(COARSE, torch.int32), "created_step": Column(NOT_SAMPLED, torch.int32)}
        return {**super().columns(), **own}

    @classmethod
    def samples(cls, config) -> bool:
        """Return whether ``method.events`` is on."""
        return config.method.events

    @property
    def method(self) -> MethodConfig:
        """Switches and settings."""
        return self.trainer.config.method

    @property
    def fine(self) -> torch.Tensor:
        """Gaussians of the fine layer, bool, shape [N]."""
        return self.trainer.table.columns["level"] == FINE

    @property
    def protects(self) -> bool:
        """True where fine Gaussians are protected."""
        return self.method.events and self.method.pm

    def is_protected(self, step: int | torch.Tensor) -> torch.Tensor:
        """Return the Gaussians that are protected at a step, bool, shape [N]."""
        return step - self.trainer.table.columns["created_step"] <= self.method.protect.steps

    def phase(self, step: int) -> Hashable:
        """Return whether gradients are gathered, and whether the coarse layer moves slowly."""
        layered = self.method.hier and self.method.events and step > self.trainer.phases.refine
        return super().phase(step), layered

    def lr_factors(self, phase):
        """Return ``method.coarse_lr_factor`` for the coarse layer and 1 for the fine one, shape [N]; None before phase 2."""
        if not phase[1]:
            return None
        return torch.where(self.fine, 1.0, self.method.coarse_lr_factor)

    def after_step(self, phase, settings, going):
        """Raise the opacities of protected Gaussians to alpha_minimum; ``settings`` [6], ``going`` [1]."""
        if self.protects:
            logits = self.trainer.table.params["logit_opacities"].detach()
            held = self.is_protected(settings[Setting.NUMBER]) & going
            logits.copy_(torch.where(held, logits.clamp_min(self.method.protect.logit), logits))

    def statistics(self, phase, v_projected, visible, size):
        """Return those of `CloneSplit`, whose phase is the first of the two; ``v_projected`` has shape [1, N, 12]."""
        return super().statistics(phase[0], v_projected, visible, size)

    def samples_after(self, step: int) -> bool:
        """Return whether fine Gaussians are sampled after a step."""
        return self.method.events and step in self.trainer.phases.events

    def due(self, step: int) -> bool:
        """Return whether the set changes after a step."""
        return super().due(step) or self.samples_after(step)

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Refine the fine layer, then sample, where it is time for either."""
        yield from super().update(step)
        if self.samples_after(step):
            event = self.sample(step, self.trainer.views, self.method)
            yield event.change
            self.events.append({
                "step": step, "added": len(event.change.parents), "evicted": event.evicted,
                "quantiles": [v.quantile for v in event.views],
            })  # fmt: skip
            if self.on_event is not None:
                self.on_event(step, event)

    def refine(self, step, growing=None, protected=None):
        """Yield the refinement; from phase 2 on only the fine layer grows, and protected Gaussians are not pruned.

        Arguments are those of `CloneSplit.refine`: ``growing`` and ``protected`` are bool [N] or None.
        """
        growing = self.fine if self.phase(step)[1] else growing
        protected = self.is_protected(step) if self.protects else protected
        yield from super().refine(step, growing, protected)

    def sample(self, step: int, views: list[TrainingView], method: MethodConfig) -> Event:
        """Return a sampling event on some views (docs/decisions/008-method.md)."""
        t = self.trainer
        options = RasterizeOptions(rule=t.config.rule, background=t.background, max_instances=t.max_instances)
        protected = self.is_protected(step) if method.pm else torch.zeros_like(self.fine)
        capacity = t.capacity - len(t.table)
        return sampling_event(
            t.gaussians, self.fine, protected, views, method,
            step=step, capacity=capacity, options=options, generator=t.generator,
        )  # fmt: skip

    STATE = staticmethod(schema.fields({"was_reset": schema.flag, "events": schema.items(EVENT)}))

    def state(self):
        """Return no tensors [...] of its own, and the events so far."""
        tensors, plain = super().state()
        return tensors, plain | {"events": self.events}

    def load(self, tensors, plain):
        """Load the events so far; ``tensors`` [...] are not read."""
        super().load(tensors, plain)
        self.events = plain["events"]
