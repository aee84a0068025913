"""One step: render, loss, gradients, update; eager, or captured as a CUDA graph."""

from __future__ import annotations

import functools
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch

from warpgs.device import available_bytes
from warpgs.errors import ResourceError
from warpgs.kernels.graphs import CapturedGraph, GraphMemory
from warpgs.kernels.tiles import BYTES_PER_INSTANCE, MAX_INSTANCES, InstanceMemory
from warpgs.kernels.update import NOT_FINITE, SHIFT, Setting, begin_step, end_step, opacity_decay, opacity_dropout
from warpgs.pipeline.metrics.scores import masked_mse
from warpgs.pipeline.model.limits import NO_LIMITS, Limits
from warpgs.pipeline.model.table import Table
from warpgs.pipeline.train.loss import LossInputs, LossTerm, Target, outputs_of, term_values
from warpgs.pipeline.train.schedule import over
from warpgs.pipeline.train.strategies.base import Strategy
from warpgs.pipeline.train.views import Kind, LearnedViews, Rows, ViewStack, current, seen
from warpgs.render.compose import compose, count_instances, inputs_of
from warpgs.render.options import RasterizeOptions, image_settings
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians, Render

# Decay of opacities: each step lowers every opacity by a fraction, so that Gaussians without support in the photographs
# fade.
#
# The idea comes from Binocular3DGS (Han et al. 2024, arXiv 2410.18822); docs/decisions/023-opacity-decay.md has
# measurements.

LEAST_LOGIT = -15.0
"""Logit below which no opacity decays further, far below the pruning threshold."""


@torch.no_grad()
def decay_opacities(logits: torch.Tensor, fraction: float, going: torch.Tensor, used: torch.Tensor | None = None) -> None:
    """Lower every opacity by a fraction, in place; the call may be part of a captured step.

    Args:
        logits: Logits of opacities, float32, shape [N].
        fraction: Fraction by which an opacity is lowered, in [0, 1); 0 changes nothing.
        going: Whether the step is taken, bool, shape [1]; if False, nothing changes.
        used: Gaussians whose opacities change, bool, shape [N]; None for all.
    """
    kept = 1 - fraction
    if kept == 1:  # also a fraction below the rounding of float64
        return
    new = torch.where(logits > LEAST_LOGIT, opacity_decay(logits, kept), logits)
    logits.copy_(torch.where(going if used is None else going & used, new, logits))


# One training step, called eagerly on a CPU and captured as a CUDA graph on a GPU.
#
# With few views and small images, a GPU needs less time for a step than Python needs to launch it. So on a GPU the
# whole step is captured, from the choice of the view to the changes after Adam, and replayed. Learning rates and views
# of several steps are uploaded at once; losses are read at the end of these steps. On a CPU the same function is called
# for each step.

MAX_STEPS = 100
"""Largest number of steps between two reads of results from the device."""
MAX_VIEWS = 200
"""Largest number of rendered views between two reads of results, for steps of several views; a single step may have more. A
request to stop waits for the next read."""


def steps_at_once(batch: int) -> int:
    """Return the largest number of steps of ``batch`` views before results are read back."""
    return min(MAX_STEPS, max(1, MAX_VIEWS // batch))


@dataclass(frozen=True)
class StepPlan:
    """Choices that are fixed when a step is captured; steps of equal plans share a CUDA graph."""

    degree: int
    """Spherical-harmonics degree in use."""
    half_size: bool
    """True if views have half their size."""
    terms: tuple[LossTerm, ...]
    """Loss terms, in the order in which they are summed."""
    phase: Hashable
    """Value of `Strategy.phase`."""
    limits: Limits = NO_LIMITS
    """Limits that the step holds every Gaussian to."""
    opacity_decay: float = 0.0
    """Fraction by which the step lowers every opacity."""
    spares_unused: bool = False
    """True to keep the opacity of Gaussians that the step does not use."""


class StepBuffers:
    """Tensors that a series of steps reads and writes on the device: views, learning rates, losses, and the stop flag."""

    def __init__(self, device: torch.device, lrs: int, rows: int | None = None):
        """Allocate for ``rows`` steps of ``lrs`` learning rates each; None for `MAX_STEPS` on CUDA and one elsewhere."""
        self.device = device
        if rows is None:
            rows = MAX_STEPS if device.type == "cuda" else 1
        self.view_rows = torch.zeros(rows, dtype=torch.int64, device=device)
        """Row of each step's view in its stack."""
        self.lr_rows = torch.ones(rows, lrs, device=device, dtype=torch.float32)
        """Learning rates of each step (`Table.lr_row` of all tables)."""
        self.setting_rows = torch.zeros(rows, len(Setting), device=device, dtype=torch.float32)
        """Settings of each step, by `Setting`."""
        self.counter = torch.zeros(1, dtype=torch.int64, device=device)
        """Number of the current step in its series. After a step stops, neither this number nor any Gaussian changes."""
        self.stop = torch.zeros(1, dtype=torch.int32, device=device)
        """0 while steps continue, else the reason why they stopped."""
        self.history = torch.zeros(rows, 2, device=device, dtype=torch.float32)
        """Loss and mean squared error of each step."""
        self.one = torch.ones((), device=device, dtype=torch.float32)
        """Gradient of the loss."""

    def load(self, rows: list[int], lrs: list[list[float]], settings: list[tuple[float, ...]]) -> None:
        """Upload view rows, learning rates and settings (7 each) of the next steps, at most as many as were allocated."""
        self.counter.zero_()
        self.stop.zero_()
        self.view_rows[: len(rows)] = torch.tensor(rows, dtype=torch.int64, device="cpu").to(self.device)
        self.lr_rows[: len(lrs)] = torch.tensor(lrs, dtype=torch.float32, device="cpu").to(self.device)
        self.setting_rows[: len(settings)] = torch.tensor(settings, dtype=torch.float32, device="cpu").to(self.device)

    def result(self) -> tuple[int, int, list[list[float]]]:
        """Return the number of steps taken, the stop flag, and the losses and errors of these steps and of the next one."""
        done, stop = int(self.counter), int(self.stop)
        return done, stop, self.history[: done + 1].tolist()

    def begin(self, views: ViewStack) -> tuple[torch.Tensor, ...]:
        """Return learning rates, settings [7], viewmat [1, 4, 4], K [1, 3, 3] and image [H, W, 3] of the current step."""
        if self.device.type == "cpu":  # no copies
            step, row = int(self.counter), int(self.view_rows[int(self.counter)])
            view = views.viewmats[row : row + 1], views.Ks[row : row + 1], views.images[row]
            return self.lr_rows[step], self.setting_rows[step], *view
        rows = (self.view_rows, self.lr_rows, self.setting_rows, views.viewmats, views.Ks, views.images)
        return begin_step(self.counter, *rows)

    def of_view(self, maps: Rows) -> torch.Tensor:
        """Return the entry of the step's view in maps [V, ...]. Call it before `end_step` counts the step."""
        if self.device.type == "cpu":
            return maps[int(self.view_rows[int(self.counter)])]
        assert isinstance(maps, torch.Tensor)  # on CUDA stacks are tensors
        return maps.index_select(0, self.view_rows.index_select(0, self.counter))[0]


Renderer = Callable[[Gaussians, Camera, int, "torch.Tensor | None", "torch.Tensor | None"], Render]
"""Function that renders for a camera with a leading axis of 1. Arguments: Gaussians, camera, degree, opacity factors, and a
shift of the background [3]."""


def eager_renderer(options: RasterizeOptions, max_instances: int | None) -> Renderer:
    """Return a renderer that allocates memory for each render, and renders in chunks of at most ``max_instances``."""

    def render(
        gaussians: Gaussians, camera: Camera, degree: int, factors: torch.Tensor | None, shift: torch.Tensor | None
    ) -> Render:
        behind = options.background if shift is None else options.background + shift
        own = replace(
            options, sh_degree=degree, background=behind, opacity_factors=factors, max_instances=max_instances,
            record=False,  # it would allocate more than was planned
        )  # fmt: skip
        return _single(rasterize(gaussians, camera, own))

    return render


def captured_renderer(options: RasterizeOptions, capacity: int, overflow: torch.Tensor) -> Renderer:
    """Return a renderer with a fixed capacity of instances, which sets ``overflow`` [1] if they do not fit."""
    backgrounds, memory = options.background[None], InstanceMemory(capacity=capacity, overflow=overflow)

    def render(
        gaussians: Gaussians, camera: Camera, degree: int, factors: torch.Tensor | None, shift: torch.Tensor | None
    ) -> Render:
        behind = backgrounds if shift is None else backgrounds + shift
        settings = image_settings(camera, degree, options)
        images, projected, tile_counts = compose(inputs_of(gaussians, camera, factors), behind, settings, memory)
        return _single(Render(*images, projected, tile_counts))

    return render


def _single(batch: Render) -> Render:
    """Return a render of one camera without the leading axis of its images."""
    # not p[0], whose gradient would be a copy among zeros
    return replace(batch, **{n: getattr(batch, n).squeeze(0) for n in ("rgb", "alpha", "depth")})


@dataclass(frozen=True)
class Learned:
    """The tables and the strategy that steps change."""

    table: Table
    """The Gaussians."""
    views: LearnedViews
    """View modules with their parameters; often none."""
    strategy: Strategy
    """Density strategy."""
    dropout_seed: int | None
    """Seed of the opacity dropout; None without dropout."""
    cameras: tuple[torch.Tensor, torch.Tensor]
    """Training cameras, as `Limits.hold` takes them."""

    @property
    def params(self) -> dict[str, torch.Tensor]:
        """All parameters by name, of any shape [...]: of the Gaussians, and of view modules as ``views.NAME``."""
        return self.table.params | {f"views.{n}": t for n, t in self.views.table.params.items()}


@dataclass(frozen=True)
class ViewGradients:
    """Contribution of one view to a step."""

    gradients: list[torch.Tensor]
    """Gradients of the loss by the parameters of the Gaussians, then by those of view modules, in the order of the tables."""
    statistics: Mapping[str, torch.Tensor]
    """Result of `Strategy.statistics`."""
    lrs: torch.Tensor
    """Learning rates of the step, shape [R]."""
    settings: torch.Tensor
    """Settings of the step, shape [7]."""
    going: torch.Tensor
    """True if nothing stops the step, bool, shape [1]."""


@dataclass(frozen=True)
class Forward:
    """Forward pass of a step, up to the inputs of the loss."""

    rendered: Render
    """The render, with its colours as changed by view modules."""
    inputs: LossInputs
    """Inputs of the terms of the loss."""
    of_views: Mapping[str, torch.Tensor]
    """Terms that view modules add, by module name, shape [] each."""
    lrs: torch.Tensor
    """Learning rates of the step, shape [R]."""
    settings: torch.Tensor
    """Settings of the step, shape [7]."""


def step(learned: Learned, views: ViewStack, buffers: StepBuffers, plan: StepPlan, render: Renderer) -> None:
    """Take one training step: render the next view, compute the loss, update all parameters.

    If the render overflows or the loss is not finite, no parameter changes, and ``buffers.stop`` is set.

    Args:
        learned: Tables and strategy that the step changes.
        views: Views of one kind.
        buffers: Settings of the steps, and their results.
        plan: Fixed choices of the step.
        render: Renderer.
    """
    found = view_gradients(learned, views, buffers, plan, render)
    update(learned, plan, found, buffers.stop)


def view_gradients(learned: Learned, views: ViewStack, buffers: StepBuffers, plan: StepPlan, render: Renderer) -> ViewGradients:
    """Render the next view; return its gradients and statistics. Loss and stop flag go to ``buffers``.

    Arguments are those of `step`.
    """
    table, strategy = learned.table, learned.strategy
    found = forward(table.gaussians, learned.views, learned.dropout_seed, views, buffers, plan, render)
    loss = total_loss(plan, found.inputs, strategy, tuple(found.of_views.values()))

    rendered, target = found.rendered, found.inputs.target
    params = [*table.params.values(), *learned.views.table.params.values()]
    *gradients, v_projected = torch.autograd.grad(loss, [*params, rendered.projected], buffers.one, materialize_grads=True)
    with torch.no_grad():
        mse = masked_mse(rendered.rgb, target.image, target.mask)
        going = end_step(loss, mse, buffers.counter, buffers.stop, buffers.history)
        statistics = strategy.statistics(plan.phase, v_projected, rendered.visible & going, views.size)
    return ViewGradients(gradients, statistics, found.lrs, found.settings, going)


def forward(
    gaussians: Gaussians, learned: LearnedViews, dropout_seed: int | None, views: ViewStack, buffers: StepBuffers,
    plan: StepPlan, render: Renderer,
) -> Forward:  # fmt: skip
    """Render the next view, and gather the inputs of the loss terms.

    Args:
        gaussians: The Gaussians.
        learned: View modules with their parameters.
        dropout_seed: Seed of the opacity dropout; None without dropout.
        views: Views of one kind.
        buffers: Settings of the steps.
        plan: Fixed choices of the step.
        render: Renderer.
    """
    lrs, settings, viewmat, K, image = buffers.begin(views)
    mask = None if views.masks is None else buffers.of_view(views.masks)
    number = buffers.of_view(views.numbers).view(1)
    values = learned.values(number)
    alpha = shift = None
    if views.alphas is not None:
        alpha, shift = buffers.of_view(views.alphas), settings[SHIFT]
        image = over(image, alpha, shift)
    target = Target(image, mask, {n: buffers.of_view(t) for n, t in views.maps.items()}, alpha)
    factors = None
    if dropout_seed is not None:
        factors = opacity_dropout(len(gaussians), settings, dropout_seed)
    given = views.camera(viewmat, K, buffers.of_view(views.distortions)[None] if views.distortions.numel() else None)
    camera = learned.before_render(given, values)
    rendered = render(gaussians, camera, plan.degree, factors, shift)
    of_view = {n: t[0] for n, t in values.items()}
    rendered = replace(rendered, rgb=seen(learned.modules, rendered.rgb, of_view))
    outputs = {n: getattr(rendered, n) for n in outputs_of(plan.terms)}
    lens = None if camera.distortion is None else camera.distortion[0]
    single = replace(camera, viewmat=camera.viewmat[0], K=camera.K[0], distortion=lens)
    inputs = LossInputs(outputs, target, gaussians, single, settings[Setting.STEP])
    return Forward(rendered, inputs, learned.regularisation(of_view), lrs, settings)


def total_loss(plan: StepPlan, inputs: LossInputs, strategy: Strategy, of_views: Sequence[torch.Tensor] = ()) -> torch.Tensor:
    """Return the sum of the loss terms, the terms of view modules (``of_views`` [] each) and the strategy's term, shape []."""
    values = [*term_values(plan.terms, inputs), *of_views]
    extra = strategy.regularisation(plan.phase, inputs.gaussians)
    return sum(values[1:] if extra is None else [*values[1:], extra], values[0])


@torch.no_grad()
def update(learned: Learned, plan: StepPlan, found: ViewGradients, stop: torch.Tensor) -> None:
    """Update all parameters and columns; nothing changes if ``stop`` (int32, [1]) is not 0."""
    descend(learned, plan, found, stop, list(learned.table.params))
    settle(learned, plan, found)


@torch.no_grad()
def descend(
    learned: Learned, plan: StepPlan, found: ViewGradients, stop: torch.Tensor, names: list[str], rows: slice = slice(None)
) -> None:
    """Update parameters by Adam; nothing changes if ``stop`` (int32, [1]) is not 0.

    Args:
        learned: Tables that the step changes.
        plan: Fixed choices of the step.
        found: Gradients and learning rates.
        stop: Not 0 to change nothing, int32, shape [1].
        names: Parameters of the Gaussians. The parameters of view modules are updated together with the means.
        rows: Gaussians to update.
    """
    table, views = learned.table, learned.views.table
    split = 3 * len(table.params)
    own, of_views = dict(zip(table.params, found.gradients)), found.gradients[len(table.params) :]
    factors = learned.strategy.lr_factors(plan.phase) if "means" in names else None
    table.adam_step({n: own[n] for n in names}, found.lrs[:split], stop, factors, rows)
    if "means" in names:
        views.adam_step(dict(zip(views.params, of_views)), found.lrs[split:], stop)


@torch.no_grad()
def settle(learned: Learned, plan: StepPlan, found: ViewGradients) -> None:
    """Apply the changes after Adam: opacity decay, the strategy's own changes, limits, statistics."""
    table, strategy = learned.table, learned.strategy
    gradient = found.gradients[list(table.params).index("logit_opacities")]
    used = gradient != 0 if plan.spares_unused else None
    decay_opacities(table.params["logit_opacities"].detach(), plan.opacity_decay, found.going, used)
    strategy.after_step(plan.phase, found.settings, found.going)
    plan.limits.hold(table.params, learned.cameras, found.going)
    for name, value in found.statistics.items():
        table.columns[name] += value


CAPACITY_FACTOR = 1.3
"""Capacity of a captured step for instances, as a multiple of the largest number of any view at the time of capture."""
DEAD_BYTES = 2**30
"""Largest memory of unused graphs that is kept [bytes]. Freeing it takes milliseconds, in which the device waits."""


class OverLimitError(ResourceError):
    """A captured step would exceed the memory limit of the fit."""


class Capacities:
    """Capacities of captured steps for instances, by kind of view and plan."""

    def __init__(self, learned: Learned, options: RasterizeOptions):
        """Compute nothing yet.

        Args:
            learned: Tables that steps change.
            options: Rule, background [3] and antialiasing of the fit.
        """
        self.learned, self.options = learned, options
        self._known: dict[tuple[Hashable, StepPlan], int] = {}

    def clear(self) -> None:
        """Drop all capacities, because the Gaussians have changed."""
        self._known.clear()

    def of(
        self, kinds: Sequence[Kind], stacks: Mapping[Kind, ViewStack], plan: StepPlan, max_instances: int | None
    ) -> dict[Kind, int]:
        """Return the capacity for each kind, computed at its first use.

        Args:
            kinds: Kinds of views.
            stacks: Views by kind.
            plan: Fixed choices of the steps.
            max_instances: Largest capacity; None for no limit.

        Raises:
            OverLimitError: A capacity would be above ``max_instances``.
            ResourceError: The instances would not fit into memory.
        """
        self._known = {k: c for k, c in self._known.items() if k[1] == plan}
        found = {}
        for kind in dict.fromkeys(kinds):
            if (kind, plan) not in self._known:
                now = current(stacks[kind], self.learned.views)
                self._known[kind, plan] = instance_capacity(self.learned.table.gaussians, now, plan.degree, self.options)
            found[kind] = self._known[kind, plan]
            if max_instances is not None and found[kind] > max_instances:
                raise OverLimitError(
                    f"a captured step would need capacity for {found[kind]:,} instances, but the limit allows {max_instances:,}"
                )
        return found


class StepGraphs:
    """Captured steps, one for each plan and kind of view, captured at first use."""

    def __init__(
        self, learned: Learned, buffers: StepBuffers, options: RasterizeOptions,
        work: Callable[[Learned, ViewStack, StepBuffers, StepPlan, Renderer], object] = step,
    ):  # fmt: skip
        """Begin without captured steps.

        Args:
            learned: Tables and strategy that steps change.
            buffers: Settings and results of steps.
            options: Rule, background [3] and antialiasing of the fit.
            work: Function that is captured.
        """
        self.work = work
        self.learned, self.buffers, self.options = learned, buffers, options
        device = buffers.device
        self.stream = torch.cuda.Stream(device)
        """Stream of captures, always the same one, since torch reuses freed memory only on the stream that used it before."""
        self.memory = GraphMemory(device)
        """Account of the memory that torch keeps for deleted graphs."""
        self.capacities = Capacities(learned, options)
        """Capacities of the graphs."""
        self._graphs: dict[tuple[Hashable, StepPlan], CapturedGraph] = {}

    def clear(self) -> None:
        """Drop all graphs, because the tensors that they refer to have changed."""
        self._graphs.clear()
        self.capacities.clear()

    def capture_all(
        self, kinds: Sequence[Kind], stacks: Mapping[Kind, ViewStack], plan: StepPlan, max_instances: int | None
    ) -> list[CapturedGraph]:
        """Return a graph for each of several steps with the same plan; missing graphs are captured first.

        Args:
            kinds: Kind of each step's view.
            stacks: Views by kind.
            plan: Fixed choices of the steps.
            max_instances: Largest capacity for instances; None for no limit.

        Raises:
            OverLimitError: The capacity of a graph would be above ``max_instances``.
            ResourceError: The instances would not fit into memory.
        """
        self._graphs = {k: g for k, g in self._graphs.items() if k[1] == plan}
        for kind in dict.fromkeys(kinds):
            if (kind, plan) in self._graphs:
                continue
            capacity = self.capacities.of([kind], stacks, plan, max_instances)[kind]
            self.memory.give_back(0 if max_instances is not None else DEAD_BYTES)
            render = captured_renderer(self.options, capacity, self.buffers.stop)
            work = functools.partial(self.work, self.learned, stacks[kind], self.buffers, plan, render)
            self._graphs[kind, plan] = self.capture(work)
        return [self._graphs[kind, plan] for kind in kinds]

    def capture(self, work: Callable[[], object]) -> CapturedGraph:
        """Return the graph of a function that changes nothing if the stop flag is set."""
        buffers = self.buffers
        here, loaded = torch.cuda.current_stream(buffers.device), buffers.view_rows.clone()
        self.stream.wait_stream(here)
        with torch.cuda.stream(self.stream):
            # a first run loads kernels and fills caches, which is not allowed during a capture; it changes no parameter
            buffers.stop.fill_(NOT_FINITE)
            buffers.view_rows.zero_()
            work()
            buffers.stop.zero_()
            buffers.view_rows.copy_(loaded)
            self.stream.synchronize()
            captured = CapturedGraph(work, self.stream)
        here.wait_stream(self.stream)
        return captured


@torch.no_grad()
def instance_capacity(gaussians: Gaussians, views: ViewStack, degree: int, options: RasterizeOptions) -> int:
    """Return the capacity of a captured step for (Gaussian, tile) instances, over all views of a stack.

    Raises:
        ResourceError: The instances would not fit into memory.
    """
    counts = [count_instances(inputs_of(gaussians, c), image_settings(c, degree, options)) for c in views.cameras()]
    wanted = int(CAPACITY_FACTOR * int(torch.stack(counts).max())) + 1024
    budget = available_bytes(gaussians.means.device) * 4 // 5
    if wanted > MAX_INSTANCES or wanted * BYTES_PER_INSTANCE > budget:
        raise ResourceError(
            f"a step needs {wanted * BYTES_PER_INSTANCE / 2**30:.2f} GiB for {wanted:,} (Gaussian, tile) instances, but "
            f"{budget / 2**30:.2f} GiB may be used; fit smaller images with --downscale, or lower --max-gaussians"
        )
    return wanted
