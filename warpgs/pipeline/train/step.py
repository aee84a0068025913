"""One step: render, loss, gradients, update; eager, or captured as a CUDA graph."""

import functools
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from warpgs.device import available_bytes, keep_freed_memory
from warpgs.errors import ResourceError
from warpgs.kernels.graphs import CapturedGraph, GraphMemory
from warpgs.kernels.project import project_inputs
from warpgs.kernels.tiles import BYTES_PER_INSTANCE, MAX_INSTANCES, InstanceMemory
from warpgs.kernels.update import NOT_FINITE, SHIFT, Setting, begin_step, end_step, opacity_decay, opacity_dropout
from warpgs.pipeline.metrics.scores import masked_mse
from warpgs.pipeline.model.limits import NO_LIMITS, Limits
from warpgs.pipeline.model.table import Table
from warpgs.pipeline.train.loss import LossInputs, LossTerm, Target, outputs_of, term_values
from warpgs.pipeline.train.schedule import over
from warpgs.pipeline.train.strategies.base import Strategy
from warpgs.pipeline.train.views import Kind, LearnedViews, Rows, ViewStack, camera_at, current, seen
from warpgs.plugins import returned
from warpgs.render.compose import bin_and_blend, inputs_of
from warpgs.render.options import RasterizeOptions, image_settings
from warpgs.render.rasterize import rasterize
from warpgs.scene import Camera, Gaussians, Render, Tensors

# Decay of opacities: each step lowers every opacity by a fraction, so that Gaussians without support in the photographs
# fade.
#
# The idea comes from Binocular3DGS (Han et al. 2024, arXiv 2410.18822); docs/decisions/023-opacity-decay.md has
# measurements.

LEAST_LOGIT = -15.0
"""Logit below which no opacity decays further, far below the pruning threshold."""


@torch.no_grad()
def decay_opacities(logits: Tensor, fraction: float, going: Tensor, used: Tensor | None = None) -> None:
    """Lower opacities (logits [N]) by a fraction in place, of Gaussians ``used`` [N] or all, if ``going`` [1] is True."""
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

    def load(self, rows: list[int], lrs: list[list[float]], settings: list[tuple[float, ...]]) -> None:
        """Upload view rows, learning rates and settings (7 each) of the next steps, at most as many as were allocated."""
        self.counter.zero_()
        self.stop.zero_()
        for tensor, values in ((self.view_rows, rows), (self.lr_rows, lrs), (self.setting_rows, settings)):
            tensor[: len(values)] = torch.tensor(values, dtype=tensor.dtype, device="cpu").to(self.device)

    def result(self) -> tuple[int, int, list[list[float]]]:
        """Return the number of steps taken, the stop flag, and the losses and errors of these steps and of the next one."""
        done, stop = int(self.counter), int(self.stop)
        return done, stop, self.history[: done + 1].tolist()

    def begin(self, views: ViewStack) -> tuple[Tensor, ...]:
        """Return learning rates, settings [7], viewmat [1, 4, 4], K [1, 3, 3] and image [H, W, 3] of the current step."""
        cameras = views.camera
        if self.device.type == "cpu":  # no copies
            step, row = int(self.counter), int(self.view_rows[int(self.counter)])
            view = cameras.viewmat[row : row + 1], cameras.K[row : row + 1], views.images[row]
            return self.lr_rows[step], self.setting_rows[step], *view
        rows = (self.view_rows, self.lr_rows, self.setting_rows, cameras.viewmat, cameras.K, views.images)
        return begin_step(self.counter, *rows)

    def of_view(self, maps: Rows) -> Tensor:
        """Return the entry of the step's view in maps [V, ...]. Call it before `end_step` counts the step."""
        if self.device.type == "cpu":
            return maps[int(self.view_rows[int(self.counter)])]
        assert isinstance(maps, Tensor)  # on CUDA stacks are tensors
        return maps.index_select(0, self.view_rows.index_select(0, self.counter))[0]


Renderer = Callable[[Gaussians, Camera, int, "Tensor | None", "Tensor | None"], Render]
"""Function that renders for a camera with a leading axis of 1. Arguments: Gaussians, camera, degree, opacity factors, and a
shift of the background [3]."""


def eager_renderer(options: RasterizeOptions, max_instances: int | None) -> Renderer:
    """Return a renderer that allocates memory for each render, and renders in chunks of at most ``max_instances``."""

    def render(gaussians: Gaussians, camera: Camera, degree: int, factors: Tensor | None, shift: Tensor | None) -> Render:
        behind = options.background if shift is None else options.background + shift
        own = replace(
            options, sh_degree=degree, background=behind, opacity_factors=factors, max_instances=max_instances,
            record=False,  # it would allocate more than was planned
        )  # fmt: skip
        return _single(rasterize(gaussians, camera, own))

    return render


def captured_renderer(options: RasterizeOptions, capacity: int, overflow: Tensor) -> Renderer:
    """Return a renderer with a fixed capacity of instances, which sets ``overflow`` [1] if they do not fit."""
    backgrounds, memory = options.background[None], InstanceMemory(capacity=capacity, overflow=overflow)

    def render(gaussians: Gaussians, camera: Camera, degree: int, factors: Tensor | None, shift: Tensor | None) -> Render:
        behind = backgrounds if shift is None else backgrounds + shift
        settings = image_settings(camera, degree, options)
        projected, tile_counts = project_inputs(inputs_of(gaussians, camera, factors), settings)
        images = bin_and_blend(projected, tile_counts, behind, settings, memory)
        return _single(Render(*images, projected, tile_counts))

    return render


def _single(batch: Render) -> Render:
    """Return a render of one camera without the leading axis of its images."""
    # not p[0], whose gradient would be a copy among zeros
    return replace(batch, **{n: getattr(batch, n).squeeze(0) for n in ("rgb", "alpha", "depth")})


def total_loss(plan: StepPlan, inputs: LossInputs, strategy: Strategy, of_views: Sequence[Tensor] = ()) -> Tensor:
    """Return the sum of the loss terms, the terms of view modules (``of_views`` [] each) and the strategy's term, shape []."""
    values = [*term_values(plan.terms, inputs), *of_views]
    extra = strategy.regularisation(plan.phase, inputs.gaussians)
    returned(strategy, "regularisation", extra, (Tensor, type(None)), "a tensor of shape [], or None", shape=())
    return sum(values[1:] if extra is None else [*values[1:], extra], values[0])


CAPACITY_FACTOR = 1.3
"""Capacity of a captured step for instances, as a multiple of the largest number of any view at the time of capture."""
DEAD_BYTES = 2**30
"""Largest memory of unused graphs that is kept [bytes]. Freeing it takes milliseconds, in which the device waits."""


class OverLimitError(ResourceError):
    """A captured step would exceed the memory limit of the fit."""


class StepTaker:
    """Parts of a fit that steps change, and its steps of one view, from Python or captured for a plan and kind of view."""

    kept_sums = 0
    """Number of sums of gradients that a step of several views keeps."""

    def __init__(
        self, table: Table, views: LearnedViews, strategy: Strategy, cameras: Sequence[Tensor],
        options: RasterizeOptions, dropout_seed: int | None = None,
    ):  # fmt: skip
        """Begin without captured steps; ``cameras`` are for limits of sizes, and without a seed there is no dropout."""
        self.table, self.views, self.strategy, self.cameras = table, views, strategy, cameras
        self.options, self.dropout_seed, device = options, dropout_seed, table.device
        self.buffers = StepBuffers(device, 3 * (len(table.params) + len(views.table.params)))
        self.cuda = device.type == "cuda"
        keep_freed_memory()
        if self.cuda:
            self.stream = torch.cuda.Stream(device)
            """Stream of captures, always the same one: torch reuses freed memory only on the stream that used it before."""
            self.memory = GraphMemory(device)
            """Account of the memory that torch keeps for deleted graphs."""
        self.stacks: Mapping[Kind, ViewStack] = {}
        """Views to step through; the trainer sets them, and whether steps are ``captured``."""
        self.captured = False
        self._graphs: dict[tuple[Kind, StepPlan], CapturedGraph] = {}
        self._capacities: dict[tuple[Kind, StepPlan], int] = {}

    @property
    def params(self) -> dict[str, Tensor]:
        """All parameters by name, of any shape [...]: of the Gaussians, and of view modules as ``views.NAME``."""
        return self.table.params | {f"views.{n}": t for n, t in self.views.table.params.items()}

    def step(self, views: ViewStack, buffers: StepBuffers, plan: StepPlan, render: Renderer) -> None:
        """Render the next of some views of one kind, compute the loss, and update all parameters.

        If the render overflows or the loss is not finite, no parameter changes, and ``buffers.stop`` is set.
        """
        gradients, statistics, lrs, settings, going = self.view_gradients(views, buffers, plan, render)
        self.descend(plan, gradients, lrs, buffers.stop, list(self.table.params))
        self.settle(plan, gradients, statistics, settings, going)

    def view_gradients(
        self, views: ViewStack, buffers: StepBuffers, plan: StepPlan, render: Renderer
    ) -> tuple[list[Tensor], Tensors, Tensor, Tensor, Tensor]:
        """Render the next view; return its gradients and statistics, learning rates, settings [7], and whether it goes on [1].

        Gradients are in the order of the parameters. Loss and stop flag go to ``buffers``.
        """
        rendered, inputs, of_views, lrs, settings = self.forward(views, buffers, plan, render)
        loss = total_loss(plan, inputs, self.strategy, tuple(of_views.values()))
        leaves = [*self.params.values(), rendered.projected]
        # without a gradient of the loss: to check one, torch imports sympy, for 0.2 s
        *gradients, v_projected = torch.autograd.grad(loss, leaves, materialize_grads=True)
        with torch.no_grad():
            mse = masked_mse(rendered.rgb, inputs.target.image, inputs.target.mask)
            going = end_step(loss, mse, buffers.counter, buffers.stop, buffers.history)
            size = views.camera.width, views.camera.height
            statistics = self.strategy.statistics(plan.phase, v_projected, rendered.visible & going, size)
            what, names = "a tensor [N] for each of some of its columns, by name", self.table.columns
            sizes = {"each": Tensor, "shape": (len(self.table),), "names": names}
            returned(self.strategy, "statistics", statistics, Mapping, what, **sizes)
        return gradients, statistics, lrs, settings, going

    def forward(
        self, views: ViewStack, buffers: StepBuffers, plan: StepPlan, render: Renderer
    ) -> tuple[Render, LossInputs, Tensors, Tensor, Tensor]:
        """Render the next view; return the render, inputs of the loss, terms of view modules, learning rates and settings."""
        gaussians = self.table.gaussians
        lrs, settings, viewmat, K, image = buffers.begin(views)
        mask = None if views.masks is None else buffers.of_view(views.masks)
        values = self.views.values(buffers.of_view(views.numbers).view(1))
        alpha = shift = None
        if views.alphas is not None:
            alpha, shift = buffers.of_view(views.alphas), settings[SHIFT]
            image = over(image, alpha, shift)
        target = Target(image, mask, {n: buffers.of_view(t) for n, t in views.maps.items()}, alpha)
        factors = None if self.dropout_seed is None else opacity_dropout(len(gaussians), settings, self.dropout_seed)
        distortion = None if views.camera.distortion is None else buffers.of_view(views.camera.distortion)[None]
        camera = self.views.before_render(replace(views.camera, viewmat=viewmat, K=K, distortion=distortion), values)
        rendered = render(gaussians, camera, plan.degree, factors, shift)
        of_view = {n: t[0] for n, t in values.items()}
        rendered = replace(rendered, rgb=seen(self.views.modules, rendered.rgb, of_view))
        outputs = {n: getattr(rendered, n) for n in outputs_of(plan.terms)}
        inputs = LossInputs(outputs, target, gaussians, camera_at(camera, 0), settings[Setting.STEP])
        return rendered, inputs, self.views.regularisation(of_view), lrs, settings

    @torch.no_grad()
    def descend(
        self, plan: StepPlan, gradients: list[Tensor], lrs: Tensor, stop: Tensor, names: list[str], rows: slice = slice(None)
    ) -> None:
        """Update rows of named parameters of the Gaussians by Adam, and view modules with the means, if ``stop`` [1] is 0."""
        table, views = self.table, self.views.table
        split, own = 3 * len(table.params), dict(zip(table.params, gradients))
        factors = self.strategy.lr_factors(plan.phase) if "means" in names else None
        what = "factors, shape [N], or None"
        returned(self.strategy, "lr_factors", factors, (Tensor, type(None)), what, shape=(len(table),))
        table.adam_step({n: own[n] for n in names}, lrs[:split], stop, factors, rows)
        if "means" in names:
            views.adam_step(dict(zip(views.params, gradients[len(own) :])), lrs[split:], stop)

    @torch.no_grad()
    def settle(self, plan: StepPlan, gradients: list[Tensor], statistics: Tensors, settings: Tensor, going: Tensor) -> None:
        """Apply the changes after Adam: opacity decay, the strategy's own changes, limits, statistics."""
        table = self.table
        used = gradients[list(table.params).index("logit_opacities")] != 0 if plan.spares_unused else None
        decay_opacities(table.params["logit_opacities"].detach(), plan.opacity_decay, going, used)
        self.strategy.after_step(plan.phase, settings, going)
        plan.limits.hold(table.params, self.cameras, going)
        for name, value in statistics.items():
            table.columns[name] += value

    def take(self, places: list[tuple[Kind, int]], settings: Callable[[], Sequence[tuple[float, ...]]], plan: StepPlan) -> None:
        """Take the steps whose learning rates and settings the buffers hold, with the views at these kinds and rows.

        With several views in a step, ``places`` and ``settings`` list those of each slot, step by step. A view has at most
        `StrategyContext.max_instances` (Gaussian, tile) instances at a time; if a graph would exceed them, OverLimitError is
        raised, and nothing was changed.
        """
        for work in self.works(self.step, [kind for kind, _ in places], self.buffers, plan):
            work()

    def works(
        self, function: Callable[[ViewStack, StepBuffers, StepPlan, Renderer], object], kinds: Sequence[Kind],
        buffers: StepBuffers, plan: StepPlan,
    ) -> list[Callable[[], Any]]:  # fmt: skip
        """Return the work of ``function`` for a view of each of some kinds; missing graphs are captured first."""
        max_instances = self.strategy.context.max_instances
        if not (self.captured and self.cuda):
            render = eager_renderer(self.options, max_instances)
            return [functools.partial(function, self.stacks[kind], buffers, plan, render) for kind in kinds]
        if self.table.settle():
            self.clear()
        self._graphs = {k: g for k, g in self._graphs.items() if k[1] == plan}
        for kind in dict.fromkeys(kinds):
            if (kind, plan) not in self._graphs:
                capacity = self.capacity(kind, plan)
                self.memory.give_back(0 if max_instances is not None else DEAD_BYTES)
                render = captured_renderer(self.options, capacity, buffers.stop)
                work = functools.partial(function, self.stacks[kind], buffers, plan, render)
                self._graphs[kind, plan] = self.capture(work, buffers)
        return [self._graphs[kind, plan].replay for kind in kinds]

    def capacity(self, kind: Kind, plan: StepPlan) -> int:
        """Return the capacity of captured steps with a kind of view, or raise OverLimitError above ``max_instances``."""
        max_instances = self.strategy.context.max_instances
        self._capacities = {k: c for k, c in self._capacities.items() if k[1] == plan}
        if (kind, plan) not in self._capacities:
            now = current(self.stacks[kind], self.views)
            self._capacities[kind, plan] = instance_capacity(self.table.gaussians, now, plan.degree, self.options)
        wanted = self._capacities[kind, plan]
        if max_instances is not None and wanted > max_instances:
            raise OverLimitError(f"a captured step needs capacity for {wanted:,} instances; the limit allows {max_instances:,}")
        return wanted

    def capture(self, work: Callable[[], object], buffers: StepBuffers) -> CapturedGraph:
        """Return the graph of a function that changes nothing if the stop flag is set."""
        here, loaded = torch.cuda.current_stream(buffers.device), buffers.view_rows.clone()
        self.stream.wait_stream(here)
        with torch.cuda.stream(self.stream), self.table.with_spare_rows():
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

    def clear(self) -> None:
        """Drop all graphs, because the tensors that they refer to have changed; they are captured again."""
        self._graphs.clear()
        self._capacities.clear()

    def agreed(self, stopped: bool) -> bool:
        """Return whether to end after the last step; all processes get the same answer."""
        return stopped

    def stopped_slot(self) -> int:
        """Return the first slot that stopped the last steps; 0 if none did, or in steps of one view."""
        return 0


@torch.no_grad()
def instance_capacity(gaussians: Gaussians, views: ViewStack, degree: int, options: RasterizeOptions) -> int:
    """Return the capacity of a captured step for (Gaussian, tile) instances, over all views of a stack."""
    cameras = [camera_at(views.camera, i) for i in range(len(views.numbers))]
    counts = [project_inputs(inputs_of(gaussians, c), image_settings(c, degree, options))[1].sum() for c in cameras]
    wanted = int(CAPACITY_FACTOR * int(torch.stack(counts).max())) + 1024
    budget = available_bytes(gaussians.means.device) * 4 // 5
    if wanted > MAX_INSTANCES or wanted * BYTES_PER_INSTANCE > budget:
        raise ResourceError(
            f"a step needs {wanted * BYTES_PER_INSTANCE / 2**30:.2f} GiB for {wanted:,} (Gaussian, tile) instances, but "
            f"{budget / 2**30:.2f} GiB may be used; fit smaller images with --downscale, or lower --max-gaussians"
        )
    return wanted
