"""Sampling: fine Gaussians are added behind pixels of the training views, in two layers, and protected for some steps."""

import math
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, NamedTuple

import torch

from warpgs.constants import ALPHA_CUT
from warpgs.device import FLOAT, SAMPLING, Needs, StepSizes
from warpgs.geometry import back_project_tensors, logit
from warpgs.kernels.update import Setting
from warpgs.pipeline.model.edit import SEEN, coverage, in_batches
from warpgs.pipeline.model.start import isotropic
from warpgs.pipeline.model.table import Column, DensityUpdate
from warpgs.pipeline.train.schedule import Phases
from warpgs.pipeline.train.strategies.base import Growth, Strategy, StrategyContext, register
from warpgs.pipeline.train.strategies.clone_split import GradientGrowth
from warpgs.pipeline.train.views import TrainingView, half_size_camera
from warpgs.plugins import is_ours
from warpgs.render.options import RasterizeOptions
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians, Tensors
from warpgs.schema import Checked, Within, fields, items, real, whole

COARSE, FINE = 0, 1
"""Numbers of the layers: of Gaussians that were not sampled, and of sampled ones."""
NOT_SAMPLED = -(2**30)
"""Value of ``created_step`` in the coarse layer, whose Gaussians were not sampled."""
MAX_VIEWS = 8
"""Largest number of views in which one event samples; of more views, a random subset is taken."""
MAX_WEIGHED = 32
"""Largest number of views over which blending weights are summed to choose Gaussians for eviction."""
MIN_ALPHA, BORDER = 0.5, 2
"""Rendered opacity above which a pixel may receive a Gaussian, and width of the image border in which none is sampled [px]."""
OPACITY = 0.1
"""Initial opacity of a fine Gaussian, that of the first Gaussians."""
PROTECTED_STEPS, PROTECTED_OPACITY = 500, 0.05
"""Age up to which a sampled Gaussian is protected [steps] (T_protect, five densification intervals), and its smallest opacity
(alpha_minimum, ten times the pruning threshold). The paper gives neither value."""
PRUNE_EVERY, PRUNE_VIEWS, PRUNE_LEAST, PRUNE_LATE = 500, 40, 8, (0, 13 / 16, 3 / 8)
"""Steps between removals of unseen Gaussians while the set grows: at most a tenth of the fit, but at least the second number
for each view, since a removal renders all of them. Fewest steps for each view of a fit with any removal, which takes as long as
0.8 steps for each view. And times of the last removals as fractions of phase 3, the third only in a fit that is long enough for
three by the second number."""
AVERAGE_LAST = 0.05
"""Fraction of the steps over which parameters are averaged at the end (docs/decisions/029-mean-of-the-last-steps.md). Removals
are before them: the mean begins anew after a removal."""


def removals(p: Phases, views: int) -> set[int]:
    """Return the numbers of steps done when Gaussians that none of some views shows are removed."""
    most = max(p.planned // (PRUNE_VIEWS * max(1, views)), 2) if p.planned >= PRUNE_LEAST * views else 0
    last = p.steps - int(AVERAGE_LAST * p.steps)
    late = {min(p.stable_start + int(part * (p.steps - p.stable_start)), last) for part in PRUNE_LATE[:most]}
    every = max(1, min(PRUNE_EVERY, p.planned // 10), PRUNE_VIEWS * views)
    return {s for s in range(every, p.stable_start, every) if s > p.refine} | {s for s in late if s < p.steps}


COARSE_LR_FACTOR = 0.1
"""Factor on the learning rate of the coarse layer's means from phase 2 on, with two layers."""


@dataclass(frozen=True)
class SamplerConfig(Checked, group="method.sampler."):
    """Placement of fine Gaussians at one event."""

    fraction: Annotated[float, Within(0, 1, "(")] = 0.005
    """Gaussians per event and view, as a fraction of the view's pixels."""
    footprint: Annotated[float, Within(0, math.inf, "()")] = 1.0
    """Initial standard deviation of a fine Gaussian [px], in the view of its pixel."""
    max_fraction: Annotated[float, Within(0, math.inf, ")")] = 0.5
    """Largest number of fine Gaussians, as a fraction of the coarse ones."""


@dataclass(frozen=True)
class MethodConfig(Checked, group="method."):
    """Settings of strategies sampling and paper."""

    hier: bool | None = False
    """Two layers: from phase 2 on, the coarse layer is neither cloned nor split, and its means move slowly. None: chosen by the
    number of views."""
    sampler: SamplerConfig = field(default_factory=SamplerConfig)


@dataclass(frozen=True)
class SampledView:
    """Maps and samples of an event in one view, on the device of the fit."""

    view: int
    """Index of the training view."""
    rendered: torch.Tensor
    """Colours before the event, shape [H, W, 3]."""
    scores: Tensors
    """Scores by name, each [H, W] in [0, 1]; the last one is their sum, the importance. Empty for uniform sampling."""
    gate: torch.Tensor
    """Pixels that could be sampled, bool, shape [H, W]."""
    quantile: float
    """Quantile of a score that the gate used, as `Strategy` of the paper does; 0 for none."""
    at: torch.Tensor
    """Rows and columns of the sampled pixels, int64, shape [S, 2]."""


class Rendered(NamedTuple):
    """A render of a view before an event, and the pixels that can be sampled."""

    rgb: torch.Tensor
    """Rendered colours after the view modules of the fit, shape [H, W, 3]; those of the photograph if nothing reads them."""
    surface: torch.Tensor
    """Rendered z-depth [u], shape [H, W]; the consistent depth if nothing reads it."""
    depth: torch.Tensor
    """Depth that Gaussians are placed at [u], shape [H, W]."""
    valid: torch.Tensor
    """Pixels that can be sampled, bool, shape [H, W]."""


def valid_pixels(alpha: torch.Tensor, depth: torch.Tensor, mask: torch.Tensor | None) -> torch.Tensor:
    """Return the unmasked pixels with enough opacity and positive, finite depth, away from the border; all maps are [H, W]."""
    valid = (alpha > MIN_ALPHA) & torch.isfinite(depth) & (depth > 0)
    if mask is not None:
        valid &= mask > 0
    inner = torch.zeros_like(valid)
    inner[BORDER : valid.shape[0] - BORDER, BORDER : valid.shape[1] - BORDER] = True
    return valid & inner


def sample_pixels(score: torch.Tensor, gate: torch.Tensor, count: int, uniform: torch.Tensor | None) -> torch.Tensor:
    """Sample pixels within a gate without replacement, with probability proportional to a score (P_sample).

    Successive sampling: the ``count`` smallest of E_i / score_i with exponential E_i (Efraimidis and Spirakis 2006).

    Returns rows and columns, int64, shape [S, 2], with S = ``count`` or the number of gated pixels with a positive score.
    ``uniform`` are random numbers in [0, 1), float64, [H, W], on the CPU. If it is None, the highest scores are taken instead.
    """
    allowed = gate & (score > 0)
    count = min(count, int(allowed.sum()))
    key = score.double()
    if uniform is not None:
        key = key / -torch.log1p(-uniform.to(score.device))
    key = torch.where(allowed, key, -1.0)
    chosen = torch.topk(key.flatten(), count).indices.sort().values
    return torch.stack([chosen // score.shape[1], chosen % score.shape[1]], 1)


def fine_gaussians(
    camera: Camera, image: torch.Tensor, depth: torch.Tensor, at: torch.Tensor, footprint: float, coefficients: int
) -> dict[str, torch.Tensor]:
    """Return isotropic Gaussians behind pixels ``at`` [S, 2], ``footprint`` pixels wide, in the image's colours: rows [S, ...].

    ``image`` has shape [H, W, 3] and ``depth`` is z-depth [u], shape [H, W]; there are ``coefficients`` harmonics per channel.
    """
    rows, columns = at.unbind(1)
    depths = depth[rows, columns]
    means = back_project_tensors(camera, torch.stack([columns, rows], 1).to(depth.dtype) + 0.5, depths)
    focal = 0.5 * (camera.K[0, 0] + camera.K[1, 1])
    log_sizes = (math.log(footprint) + (depths / focal).double().log()).to(depths.dtype)
    return isotropic(means, image[rows, columns], log_sizes, torch.full_like(depths, logit(OPACITY)), coefficients).tensors()


def weight_sums(gaussians: Gaussians, cameras: list[Camera], options: RasterizeOptions) -> torch.Tensor:
    """Return the sum of blending weights of each Gaussian over at most `MAX_WEIGHED` cameras, evenly spaced, shape [N]."""
    weigh = replace(options, contributions=True, sh_degree=0)
    total = torch.zeros(len(gaussians), device=gaussians.means.device, dtype=torch.float32)
    for render in in_batches(gaussians, cameras[:: -(-len(cameras) // MAX_WEIGHED)], weigh):
        for weights in render.weight_sums:
            total += weights
    return total


_COUNT = whole(0)
EVENT = fields({"step": _COUNT, "added": _COUNT, "evicted": _COUNT, "quantiles": items(real)})
"""Schema of a stored event."""


def drawn(generator: torch.Generator, shapes: Mapping[int, torch.Size]) -> Iterator[Any]:
    """Yield the views of an event, by their numbers, then a random number in [0, 1) for each pixel of each, float64 [H, W]."""
    numbers = list(shapes)
    if len(numbers) > MAX_VIEWS:
        order = torch.randperm(len(numbers), generator=generator, device="cpu")
        numbers = [numbers[i] for i in sorted(order[:MAX_VIEWS].tolist())]
    yield numbers
    for i in numbers:
        yield torch.rand(shapes[i], dtype=torch.float64, generator=generator, device="cpu")


def drawn_ahead(own: torch.Generator, shapes: Mapping[int, torch.Size]) -> tuple[Any, list[Any], torch.Tensor]:
    """Return the state and views for which `drawn` yields the values, the values, and the state after them."""
    return (own.get_state(), shapes), list(drawn(own, shapes)), own.get_state()


@register("sampling")
class Sampling(Strategy):
    """Growth by gradients; and at events in phase 2, fine Gaussians behind pixels that are sampled uniformly.

    Its settings are `FitConfig.density`, `FitConfig.method` and `FitConfig.phases`. A derived class may sample by scores, see
    `importance`.
    """

    STATE = staticmethod(fields({**GradientGrowth.STATE, "events": items(EVENT)}))
    samples = True
    consistent: bool = True
    """Whether new Gaussians are placed at the depth that other views confirm, where it exists, instead of rendered depth."""
    gated: bool = True
    """Whether views with consistent depth are sampled only where it exists."""
    at_random: bool = True
    """Whether pixels are sampled in proportion to their importance; otherwise the most important ones are taken."""
    protects: bool = True
    """Whether young fine Gaussians are protected."""
    prunes_unseen: bool = True
    """Whether Gaussians that no training view shows are removed."""
    scored: bool = False
    """Whether importance is not the same everywhere."""
    asked_quantile: float = 0.0
    """Quantile of a score below which the gate rejects pixels; 0 for none."""

    def __init__(self, context: StrategyContext):
        """Begin without events."""
        super().__init__(context)
        self.gradients = GradientGrowth(context)
        self.method = context.settings[MethodConfig]
        """Settings."""
        self.events: list[dict[str, Any]] = []
        """Step of each sampling event, Gaussians added and evicted, and the quantile of the gate in each view."""
        self._ahead: Future[Any] | None = None
        self.on_event: Callable[[int, list[SampledView]], None] | None = None
        """Function that is called with the step and the samples of each view after events, at the steps ``shown`` if given."""
        self.shown: Collection[int] | None = None

    def before_event(self, views: Mapping[int, TrainingView], rendered: Mapping[int, Rendered]) -> None:
        """Prepare an event in some views, by their index among the training views."""

    def importance(self, number: int, view: TrainingView, rendered: Rendered) -> dict[str, torch.Tensor]:
        """Return scores of the pixels of a view by name, [H, W] each; the last one is the importance. None: all are equal."""
        return {}

    def gate(self, number: int, valid: torch.Tensor, wanted: int) -> tuple[torch.Tensor, float]:
        """Return the pixels that may be sampled, of the ``valid`` ones [H, W], and the quantile that was used."""
        return valid, 0.0

    def render_before(self, view: TrainingView, reads: bool) -> Rendered:
        """Return depths for Gaussians in a view; render it if an event ``reads`` colours, or if depth is not known."""
        t, known = self.context, view.consistent
        if known is not None and self.consistent and self.gated and not reads:
            return Rendered(view.image, known, known, valid_pixels((known > 0).float(), known, view.countable))
        render = rasterize(t.gaussians, view.camera, t.render_options())
        depth, alpha = render.depth, render.alpha
        if self.consistent and view.consistent is not None:
            known = view.consistent > 0
            depth = torch.where(known, view.consistent, depth)
            alpha = torch.where(known, 1.0, 0.0 if self.gated else alpha)
        return Rendered(view.seen(render.rgb), render.depth, depth, valid_pixels(alpha, depth, view.countable))

    def _shows(self, step: int) -> bool:
        """Return whether the event after a step is shown."""
        return self.on_event is not None and (self.shown is None or step in self.shown)

    @torch.no_grad()
    def sample(
        self, step: int, views: Mapping[int, TrainingView], fraction: float, max_fraction: float
    ) -> tuple[DensityUpdate, int, list[SampledView]]:
        """Return the change by an event on views by index, the number of evicted Gaussians, and the samples of each view."""
        # docs/decisions/008-method.md
        t = self.context
        draws = self._draws({i: v.image.shape[:2] for i, v in views.items()})
        numbers, sampled, rows = next(draws), [], []
        reads = self.scored or self._shows(step) or not is_ours(type(self))
        rendered = {i: self.render_before(views[i], reads) for i in numbers}
        self.before_event({i: views[i] for i in numbers}, rendered)
        for i, r in rendered.items():
            view, wanted = views[i], max(1, round(fraction * r.valid.numel()))
            scores = self.importance(i, view, r)
            gate, quantile = self.gate(i, r.valid, wanted)
            score = [*scores.values()][-1] if scores else torch.ones_like(r.depth)
            at = sample_pixels(score, gate, wanted, next(draws) if self.at_random else None)
            footprint, coefficients = self.method.sampler.footprint, t.gaussians.sh.shape[1]
            rows.append(fine_gaussians(view.camera, view.image, r.depth, at, footprint, coefficients))
            sampled.append(SampledView(i, r.rgb, scores, gate, quantile, at))
        added = {n: torch.cat([r[n] for r in rows]) for n in rows[0]}
        return *self._within_limits(step, added, views.values(), max_fraction), sampled

    def before_steps(self, last: int) -> None:
        """Draw the random numbers of an event after the step ``last`` in a thread, 8 bytes for each pixel of its views."""
        # a class of others may draw numbers of its own
        if last in self.context.phases.events and self.at_random and is_ours(type(self)):
            shapes = {i: v.image.shape[:2] for i, v in enumerate(self.context.views)}
            thread = ThreadPoolExecutor(1)
            self._ahead = thread.submit(drawn_ahead, self.context.generator.clone_state(), shapes)
            thread.shutdown(wait=False)

    def _draws(self, shapes: Mapping[int, torch.Size]) -> Iterator[Any]:
        """Return what `drawn` yields for views of these shapes; numbers that were drawn ahead, if nothing was drawn since."""
        ahead, self._ahead, generator = self._ahead, None, self.context.generator
        if ahead is not None:
            (state, known), values, after = ahead.result()
            if known == shapes and torch.equal(state, generator.get_state()):
                generator.set_state(after)
                return iter(values)
        return drawn(generator, shapes)

    def _within_limits(
        self, step: int, added: dict[str, torch.Tensor], views: Iterable[TrainingView], max_fraction: float
    ) -> tuple[DensityUpdate, int]:
        """Return the change that adds rows [S, ...] within the limits of their number, and how many others are evicted.

        If the fine layer reaches ``max_fraction`` of the coarse one, or the set its capacity, the unprotected fine Gaussians
        that contribute least to the views are evicted. New Gaussians beyond these limits are not added.
        """
        t, fine, total = self.context, self.fine, len(self.context.table)
        count, evicted, fine_count = len(added["means"]), 0, int(fine.sum())
        over = max(fine_count + count - int(max_fraction * (total - fine_count)), count - (t.capacity - total))
        keep = torch.ones_like(fine)
        if over > 0:
            # half size suffices to rank the Gaussians
            weights = weight_sums(t.gaussians, [half_size_camera(v.camera) for v in views], t.render_options())
            candidates = fine & ~self.is_protected(step) if self.protects else fine
            weights = torch.where(candidates, weights, torch.inf)
            ids = torch.topk(weights, min(over, int(candidates.sum())), largest=False).indices
            keep[ids], evicted = False, len(ids)
            if over > evicted:  # spread over the views, as they were sampled
                order = torch.randperm(count, generator=t.generator, device="cpu")
                left = order[: max(0, count - (over - evicted))].sort().values.to(fine.device)
                added = {name: rows[left] for name, rows in added.items()}
        parents = torch.full((len(added["means"]),), -1, dtype=torch.int64, device=fine.device)
        columns = {"level": FINE, "created_step": step}
        return DensityUpdate(torch.nonzero(keep).squeeze(1), added, parents, columns), evicted

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes that an event keeps for its views: render, three scores and their sum."""
        return {SAMPLING: 7 * FLOAT * sizes.pixels * min(sizes.views, MAX_VIEWS)}

    def columns(self) -> Mapping[str, Column]:
        """Return the columns for gradients, each Gaussian's layer, and the step at which the Gaussian was sampled."""
        own = {"level": Column(COARSE, torch.int32), "created_step": Column(NOT_SAMPLED, torch.int32)}
        return {**self.gradients.columns(), **own}

    @property
    def fine(self) -> torch.Tensor:
        """Gaussians of the fine layer, bool, shape [N]."""
        return self.context.table.columns["level"] == FINE

    def is_protected(self, step: int | torch.Tensor) -> torch.Tensor:
        """Return the Gaussians that are young enough for protection at a step, bool, shape [N]."""
        return step - self.context.table.columns["created_step"] <= PROTECTED_STEPS

    def is_layered(self, step: int) -> bool:
        """Return whether only the fine layer grows and the coarse layer moves slowly: with two layers, from phase 2 on."""
        return bool(self.method.hier) and step > self.context.phases.refine

    def growth(self) -> Growth:
        """Return the times of refinement and sampling; events are listed, since they lower PSNR by up to 3 dB for a while."""
        phases = self.context.phases
        return Growth(phases.refine, self.gradients.growth().ends, phases.events)

    def phase(self, step: int) -> Hashable:
        """Return whether gradients are gathered, and whether the coarse layer moves slowly."""
        return self.gradients.gathers(step), self.is_layered(step)

    def lr_factors(self, phase: Any) -> torch.Tensor | None:
        """Return `COARSE_LR_FACTOR` for the coarse layer and 1 for the fine one, shape [N]; None if all are 1."""
        return torch.where(self.fine, 1.0, COARSE_LR_FACTOR) if phase[1] else None

    def after_step(self, phase: Any, settings: torch.Tensor, going: torch.Tensor) -> None:
        """Raise the opacities of protected Gaussians to alpha_minimum; ``settings`` [7], ``going`` [1]."""
        if self.protects:
            logits = self.context.table.params["logit_opacities"].detach()
            held = self.is_protected(settings[Setting.NUMBER]) & going
            logits.copy_(torch.where(held, logits.clamp_min(logit(PROTECTED_OPACITY)), logits))

    def statistics(self, phase: Any, v_projected: torch.Tensor, visible: torch.Tensor, size: tuple[int, int]) -> Tensors:
        """Return statistics of gradients, [N] each; ``v_projected`` has shape [1, N, 12], ``visible`` [1, N]."""
        return self.gradients.statistics(v_projected, visible, size) if phase[0] else {}

    def due(self, step: int) -> bool:
        """Return whether the set changes after a step."""
        return self.gradients.due(step) or step in self.context.phases.events

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Refine, reset opacities and sample, each if it is due.

        With two layers, only the fine layer grows from phase 2 on. Protected Gaussians are not pruned.
        """
        views = self.context.views
        if self.gradients.refines(step):
            growing = self.fine if self.is_layered(step) else None
            yield from self.gradients.refine(growing, self.is_protected(step) if self.protects else None)
        if self.gradients.resets(step):
            self.gradients.reset_opacities()
        if step in self.context.phases.events:
            sampler = self.method.sampler
            change, evicted, sampled = self.sample(step, dict(enumerate(views)), sampler.fraction, sampler.max_fraction)
            yield change
            quantiles = [v.quantile for v in sampled]
            self.events.append({"step": step, "added": len(change.parents), "evicted": evicted, "quantiles": quantiles})
            if self.on_event is not None and self._shows(step):
                self.on_event(step, sampled)

    def prunes(self, step: int) -> bool:
        """Return whether unseen Gaussians are removed after a step."""
        # after opacities were reset, no view shows any Gaussian
        possible = self.prunes_unseen and not self.gradients.config.reset_every
        return possible and step in removals(self.context.phases, len(self.context.views))

    def prune(self, step: int) -> Iterator[DensityUpdate]:
        """Remove Gaussians whose blending weight is below `SEEN` in all training views.

        Before the last removal, protected ones go only below the smallest alpha: others may still come to the front.
        """
        t = self.context
        maxima = coverage(t.gaussians, [v.camera for v in t.views], t.render_options())[0]
        least = torch.full_like(maxima, SEEN)
        if self.protects and step < max(removals(t.phases, len(t.views)), default=0):
            least[self.is_protected(step)] = ALPHA_CUT
        seen = maxima >= least
        if not bool(seen.all()) and bool(seen.any()):
            yield DensityUpdate(torch.nonzero(seen).squeeze(1))

    def catch_up(self, step: int, views: list[TrainingView], held: int) -> Iterator[DensityUpdate]:
        """Sample fine Gaussians in the blocks that were held out, as many per pixel as elsewhere."""
        pixels = sum(v.image[..., 0].numel() for v in views)
        fraction = int(self.fine.sum()) / (pixels - held) * held / pixels
        if not fraction * pixels >= 1:
            return
        for first in range(0, len(views), MAX_VIEWS):
            some = {i: views[i] for i in range(first, min(first + MAX_VIEWS, len(views)))}
            yield self.sample(step, some, min(1.0, fraction), 1e6)[0]

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Return no tensors [...], and the events so far."""
        return {}, {**self.gradients.state(), "events": self.events}

    def load(self, tensors: Tensors, plain: dict[str, Any]) -> None:
        """Load the events so far; ``tensors`` [...] are not read."""
        self.gradients.load(plain)
        self.events = plain["events"]
