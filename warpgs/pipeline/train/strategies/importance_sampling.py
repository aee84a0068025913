"""One sampling event of phase 2: score the views, draw pixels, put fine Gaussians behind them (paper, section "Method")."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field

import numpy as np
import torch

from warpgs.errors import UsageError
from warpgs.pipeline.model.layers import Layers, ProtectConfig
from warpgs.pipeline.train.strategies import importance as scoring
from warpgs.pipeline.train.strategies.clone_split import DensityUpdate
from warpgs.pipeline.train.strategies.importance import ImportanceConfig
from warpgs.pipeline.train.strategies.sampler import SamplerConfig, fine_gaussians, geometry_gate, sample_pixels, valid_pixels
from warpgs.render.rasterize import RasterizeOptions, rasterize
from warpgs.scene import Camera, Gaussians, Prior, View, ViewDepth

MAX_VIEWS = 8
"""Views that one event looks at; drawn at random where there are more."""


@dataclass(frozen=True)
class MethodConfig:
    """The paper's parts, each by itself (its Table 2), and what they are made of. All off is plain 3D Gaussian splatting."""

    events: bool = False
    """Sampling events: fine Gaussians are added in phase 2."""
    hier: bool = False
    """Two layers: from phase 2 on the coarse one is neither cloned nor split, and moves slowly."""
    s_render: bool = True
    """The rendering residual has its weight in the importance."""
    s_semantic: bool = True
    """The semantic score has its weight in the importance."""
    s_geometry: bool = True
    """The geometric score has its weight in the importance; the gate uses it in any case."""
    ra: bool = True
    """Reliability assessment: only pixels of high geometric score are drawn, and with ``sampler.depth`` confirmed only those
    whose depth other views confirm."""
    agp: bool = True
    """Adaptive Gaussian placement: pixels are drawn at random by importance, not the highest ones."""
    pm: bool = True
    """Protection mechanism: young fine Gaussians keep a least opacity and are not pruned."""
    coarse_lr_factor: float = 0.1
    """Share of the position rate that the coarse layer moves with from phase 2 on."""
    importance: ImportanceConfig = field(default_factory=ImportanceConfig)
    sampler: SamplerConfig = field(default_factory=SamplerConfig)
    protect: ProtectConfig = field(default_factory=ProtectConfig)

    def __post_init__(self):
        if not 0 <= self.coarse_lr_factor <= 1:
            raise UsageError(f"method coarse rate {self.coarse_lr_factor} must lie between 0 and 1")

    def weights(self, semantics: bool = True) -> tuple[float, float, float]:
        """Weights of the render, semantic and geometric score that are switched on, summing to 1.

        ``semantics`` is False where nothing is known of a view's.
        """
        semantic = self.s_semantic and semantics
        return scoring.weights(self.importance, render=self.s_render, semantic=semantic, geometry=self.s_geometry)


@dataclass(frozen=True)
class TrainingView:
    """A view on the device, with the scores that do not change."""

    camera: Camera
    image: torch.Tensor
    """Colours in [0, 1], shape [H, W, 3]."""
    mask: torch.Tensor | None
    """1 where a pixel counts, else 0, shape [H, W]; None where all count."""
    semantic: torch.Tensor | None = None
    """S_semantic in [0, 1], shape [H, W]; None where nothing is known of it."""
    geometry: torch.Tensor | None = None
    """S_geometry in [0, 1], shape [H, W]; None before `scored`."""
    consistent: torch.Tensor | None = None
    """z-depth [u] that other views confirm, 0 where none does, shape [H, W]; None where nothing is confirmed."""
    disparity: torch.Tensor | None = None
    """Relative inverse depth in [0, 1] for the loss, shape [H, W]; None where the loss does not look at depth."""

    @staticmethod
    def of(view: View, device: torch.device) -> TrainingView:
        """A view's pixels, mask and camera in float32 on a device."""

        def there(array):
            return torch.as_tensor(array, dtype=torch.float32, device=device)

        c = view.camera
        camera = Camera(there(c.viewmat), there(c.K), c.width, c.height)
        return TrainingView(camera, there(view.image), None if view.mask is None else there(view.mask))

    def scored(self, prior: Prior, depth: ViewDepth | None, config: MethodConfig) -> TrainingView:
        """The same view with the scores of its prior and the depth that other views confirm."""
        maps = {n: torch.as_tensor(getattr(prior, n), dtype=torch.float32, device=self.image.device)
                for n in ("disparity", "confidence", "boundary", "foreground")}  # fmt: skip
        valid = None if self.mask is None else self.mask > 0
        geometry = scoring.geometry_score(maps.pop("disparity"), config.importance.curvature, valid)
        semantic = scoring.semantic_score(**maps)
        consistent = None
        if depth is not None and depth.valid.any():
            consistent = torch.as_tensor(np.where(depth.valid, depth.depth, 0), dtype=torch.float32, device=self.image.device)
        known = semantic if bool(semantic.any()) else None
        return dataclasses.replace(self, semantic=known, geometry=geometry, consistent=consistent)

    def depth_supervised(self, prior: Prior) -> TrainingView:
        """The same view with the disparity of its prior, for the depth term of the loss."""
        disparity = torch.as_tensor(prior.disparity, dtype=torch.float32, device=self.image.device)
        return dataclasses.replace(self, disparity=disparity)


def depth_supervised_views(views: list[TrainingView], priors: list[Prior]) -> tuple[list[TrainingView], str]:
    """The views with what the depth term compares their depth with, and a sentence on where there is anything."""
    known = sum(bool(p.disparity.any()) for p in priors)
    more = "" if known else "; --depth-model, or a start by --init.source sweep or flow, makes priors"
    note = f"depth term: in {known} of {len(views)} views, those whose prior knows a depth{more}"
    return [v.depth_supervised(p) for v, p in zip(views, priors, strict=True)], note


@dataclass(frozen=True)
class SampledView:
    """What an event saw and did in one view; maps on the device of the fit."""

    view: int
    """Number of the training view."""
    rendered: torch.Tensor
    """Colours before the event, shape [H, W, 3]."""
    scores: tuple[torch.Tensor, torch.Tensor, torch.Tensor]
    """Render, semantic and geometric score, each [H, W] in [0, 1]."""
    score: torch.Tensor
    """Their weighted sum, shape [H, W]."""
    gate: torch.Tensor
    """Pixels that could be drawn, shape [H, W]."""
    quantile: float
    """Quantile of the geometric score that the gate used; lower than asked for where too few pixels passed."""
    at: torch.Tensor
    """Rows and columns of the pixels drawn, shape [S, 2]."""


@dataclass(frozen=True)
class Event:
    """One sampling event."""

    change: DensityUpdate
    """Rows that stay and rows that are new."""
    evicted: int
    """Fine Gaussians removed to make room."""
    views: tuple[SampledView, ...]
    """What happened in each view."""


def sample_view(
    gaussians: Gaussians, view: TrainingView, number: int, config: MethodConfig, options: RasterizeOptions,
    generator: torch.Generator,
) -> tuple[SampledView, dict[str, torch.Tensor]]:  # fmt: skip
    """Score one view, draw its pixels, and make the fine Gaussians behind them."""
    c = config.sampler
    render = rasterize(gaussians, view.camera, options)
    depth, alpha = render.depth, render.alpha
    if c.depth == "consistent" and view.consistent is not None:
        known = view.consistent > 0
        depth = torch.where(known, view.consistent, depth)
        alpha = torch.where(known, 1.0, 0.0 if config.ra else alpha)
    valid = valid_pixels(alpha, depth, view.mask, c)
    known = view.semantic is not None
    semantic = view.semantic if known else torch.zeros_like(view.geometry)
    scores = (scoring.render_score(render.rgb, view.image, valid), semantic, view.geometry)
    score = scoring.importance(scores, config.weights(known))
    wanted = max(1, round(c.fraction * valid.numel()))
    gate, quantile = geometry_gate(view.geometry, valid, c.gate_quantile if config.ra else 0.0, wanted)
    at = sample_pixels(score, gate, wanted, generator, random=config.agp)
    rows = fine_gaussians(view.camera, view.image, depth, at, c, gaussians.sh.shape[1])
    return SampledView(number, render.rgb, scores, score, gate, quantile, at), rows


def least_contributing(
    gaussians: Gaussians, candidates: torch.Tensor, count: int, views: list[TrainingView], options: RasterizeOptions
) -> torch.Tensor:
    """Numbers of the ``count`` candidates (bool [N]) whose blending weights over all views sum to least, int64."""
    total = torch.zeros(len(gaussians), device=gaussians.means.device)
    for view in views:
        total += rasterize(gaussians, view.camera, options).weight_sums[0]
    total = torch.where(candidates, total, torch.inf)
    return torch.topk(total, min(count, int(candidates.sum())), largest=False).indices


@torch.no_grad()
def sampling_event(
    gaussians: Gaussians,
    layers: Layers,
    views: list[TrainingView],
    config: MethodConfig,
    *,
    step: int,
    capacity: int,
    rule: str,
    background: torch.Tensor,
    generator: torch.Generator,
    max_instances: int | None = None,
) -> Event:
    """Add fine Gaussians where the importance of the training views says.

    Where the fine layer is as large as it may be (``sampler.max_share`` of the coarse one), those of its Gaussians that
    contribute least to the training views make room, the protected ones excepted; what still has no room is not added.

    Args:
        gaussians: The current set, N rows.
        layers: Their layers and births.
        views: Training views with their scores.
        config: Switches and settings.
        step: Steps done.
        capacity: Gaussians that may be added before the whole set is full.
        rule: Cut-offs of the rasterizer.
        background: Colour behind the scene, shape [3].
        generator: CPU generator; the same numbers on every device.
        max_instances: As in RasterizeOptions.

    Returns:
        The change and what led to it.
    """
    options = RasterizeOptions(rule=rule, background=background, max_instances=max_instances)
    numbers = list(range(len(views)))
    if len(views) > MAX_VIEWS:
        numbers = sorted(torch.randperm(len(views), generator=generator)[:MAX_VIEWS].tolist())
    drawn, rows = zip(*(sample_view(gaussians, views[i], i, config, options, generator) for i in numbers))
    added = {name: torch.cat([r[name] for r in rows]) for name in rows[0]}
    count = len(added["means"])

    fine = layers.fine
    coarse_count, fine_count = int((~fine).sum()), int(fine.sum())
    over = max(fine_count + count - int(config.sampler.max_fraction * coarse_count), count - capacity)
    keep = torch.ones(len(gaussians), dtype=torch.bool, device=fine.device)
    evicted = 0
    if over > 0:
        free = fine & ~layers.is_protected(step, config.protect) if config.pm else fine
        weigh = dataclasses.replace(options, contributions=True)
        ids = least_contributing(gaussians, free, over, views, weigh)
        keep[ids] = False
        evicted = len(ids)
        if over > evicted:  # spread over the views, as they were drawn
            left = torch.randperm(count, generator=generator)[: max(0, count - (over - evicted))].sort().values.to(fine.device)
            added = {name: t[left] for name, t in added.items()}
            count = len(left)
    parents = torch.full((count,), -1, dtype=torch.int64, device=fine.device)
    return Event(DensityUpdate(torch.nonzero(keep).squeeze(1), added, parents), evicted, drawn)
