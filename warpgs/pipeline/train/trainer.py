"""The trainer: its loop, its stored state, and what runs before and after it."""

import contextlib
import math
import threading
import time
from collections.abc import Callable, Hashable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from warpgs.clock import section
from warpgs.device import available_bytes, format_bytes, is_out_of_memory, no_memory_message, return_freed_memory
from warpgs.errors import DataError, NotFiniteError, OutOfMemoryError, ResourceError, UsageError
from warpgs.io.images import without_masked
from warpgs.kernels.update import NOT_FINITE, Setting
from warpgs.pipeline.metrics.scores import psnr_of, render_view, score
from warpgs.pipeline.model.edit import stored_degrees
from warpgs.pipeline.model.limits import camera_centers, camera_rows, scene_radius
from warpgs.pipeline.model.start import initial_gaussians, scene_extent, sweeps
from warpgs.pipeline.model.table import Column, Table, model_bytes
from warpgs.pipeline.train.batch import BatchSteps, Tree
from warpgs.pipeline.train.memory import Layout, most_instances, plan
from warpgs.pipeline.train.schedule import Phases, StepReport, plan_phases, random_shift, sh_degree
from warpgs.pipeline.train.settings import FitConfig, is_cutout
from warpgs.pipeline.train.setup import prepare, prepared_views, terms_of
from warpgs.pipeline.train.step import CAPACITY_FACTOR, OverLimitError, StepPlan, StepTaker, steps_at_once
from warpgs.pipeline.train.stopping import STATE, Stopping
from warpgs.pipeline.train.strategies.base import Strategy, StrategyContext, find_strategy
from warpgs.pipeline.train.views import LearnedViews, TrainingView, half_size, show_learned, stack_views, with_learned
from warpgs.plugins import is_ours, returned
from warpgs.priors.networks import in_threads
from warpgs.priors.sweep import sweep_depths
from warpgs.process import Detail, Say, silent
from warpgs.ranks import ALONE, Ranks
from warpgs.scene import Camera, Gaussians, PointCloud, Prior, Scene, Tensors, View
from warpgs.schema import Schema, SchemaError, anything, fields, items, mapping, number, text, whole

# Mean of the parameters over the last steps of a fit; after the last step it replaces the parameters.
#
# A step of one view moves the parameters towards that view, so the parameters of the last step favour the last views.
# The mean over many steps does not (Polyak and Juditsky 1992; Izmailov et al. 2018, arXiv 1803.05407).
# docs/decisions/029-mean-of-the-last-steps.md has measurements.

ALL_SAVED, CHECKPOINT_SECONDS = 1000, 20.0
"""Steps between checkpoints below which each is written; least time between others [s]."""
SAMPLES = 32
"""Least number of samples of a mean; a shorter mean takes every step."""
PREFIX = "mean."
"""Beginning of the names of stored tensors."""


class ParameterMean:
    """Sum of the parameters after evenly spaced steps near the end of a fit.

    Sums are in float32. With n samples, fewer than 2 `SAMPLES`, a mean has a rounding error of at most n 2^-24 of the largest
    sample: 4e-6 at most, and about 1e-7 in practice, which is as much as the rounding of the parameters themselves.
    """

    def __init__(self, fraction: float):
        """Begin without a sample; ``fraction`` of the steps, the last ones, are averaged, in [0, 1]; 0 for no mean."""
        self.fraction, self.count = fraction, 0
        self.sums: dict[str, torch.Tensor] = {}

    def samples(self, steps: int) -> range:
        """Return the steps after which a fit of ``steps`` steps takes a sample: the last one, and evenly spaced ones before."""
        length = int(self.fraction * steps)
        return range(steps, steps - length, -max(1, length // SAMPLES))

    def wait(self, step: int, steps: int) -> int:
        """Return the number of steps from ``step`` to the next sample; without one, to the end of the fit."""
        return min((s - step for s in self.samples(steps) if s > step), default=steps - step)

    @torch.no_grad()
    def update(self, step: int, steps: int, params: Tensors) -> bool:
        """Take a sample if it is due; after the last step, replace the parameters by the mean in place, and return True."""
        if step not in self.samples(steps):
            return False
        for name, value in params.items():
            self.sums[name] = self.sums[name].add_(value) if self.count else value.detach().clone()
        self.count += 1
        if step < steps:
            return False
        for name, value in params.items():
            value.detach().copy_(self.sums[name].div_(self.count))
        self.restart()
        return True

    def restart(self) -> None:
        """Forget all samples: the set of Gaussians changed, and rows are no longer the same Gaussians."""
        self.sums, self.count = {}, 0

    def state(self) -> dict[str, torch.Tensor]:
        """Return tensors by name, of any shape [...], from which the mean continues; empty without samples."""
        if not self.count:
            return {}
        count = torch.tensor([self.count], dtype=torch.int64, device="cpu")
        return {f"{PREFIX}{n}": t for n, t in self.sums.items()} | {f"{PREFIX}count": count}

    def load(self, tensors: Tensors, params: Tensors) -> None:
        """Load what `state` returned, for these current parameters, or raise DataError."""
        self.restart()
        stored = {n.removeprefix(PREFIX): t for n, t in tensors.items() if n.startswith(PREFIX)}
        if not stored:
            return
        count = stored.pop("count", None)
        kinds = {n: (t.shape, t.dtype) for n, t in stored.items()}
        counted = count is not None and count.shape == (1,) and count.dtype == torch.int64 and int(count) > 0
        if not counted or kinds != {n: (t.shape, t.dtype) for n, t in params.items()}:
            raise DataError("the stored mean of the parameters is damaged, or of another fit; restore it, or fit again")
        self.count = int(count)
        self.sums = {n: t.to(params[n].device).clone() for n, t in stored.items()}


def check_state(tensors: Tensors, plain: dict[str, Any], views: int, steps: int, *, strategy: Schema, stopping: Schema) -> None:
    """Raise DataError unless the parts of a stored state that are not rows of a table are valid; `Table.load` checks rows."""
    state = fields({
        "step": whole(0, steps), "order": items(whole(0, views - 1)), "extent": number(above=0), "notes": items(text),
        "strategy": mapping(anything), "stopping": stopping, "stable_start": whole(0, steps), "steps": whole(1, steps),
    })  # fmt: skip
    try:
        state(plain, "")
        strategy(plain["strategy"], "strategy")
    except SchemaError as e:
        raise DataError(f"the stored state is incomplete or damaged: {e}; restore the file, or fit the scene again") from e
    try:
        torch.Generator().set_state(tensors["generator"])
    except (KeyError, TypeError, RuntimeError) as e:
        raise DataError("generator, the state of the random numbers, is missing or damaged; restore it, or fit again") from e


DROPOUT_VIEWS = 3
"""Number of training views up to which dropout has its full probability; with more views it falls in proportion."""


class Trainer:
    """The state of one fit, and the operations that take its steps."""

    chosen: list[int] | None = None
    """Indices of the views of the steps in progress; None between steps."""

    def __init__(
        self, train: list[View], points: PointCloud | None, config: FitConfig, device: torch.device,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0), priors: list[Prior] | None = None,
        ready: Callable[[], object] = lambda: None, *, progress: Say = silent,
        ranks: Ranks = ALONE,
    ):  # fmt: skip
        """Set up the initial Gaussians.

        Automatic settings are chosen already (`warpgs.pipeline.train.settings.settings_by_views`). Priors are computed if they
        are None, and sampling or a loss term needs them. ``ready`` is called before the device is used, and ``progress`` with
        lines on the work before the first step. A fit has the same bits for any number of ``ranks``, which share the views of a
        step.
        """
        for module in config.view_modules:
            module.check(train)
        train = in_threads(without_masked, train)  # so that no pixel under a mask has an influence
        c, self.config, self.device, self.ranks, self.batch = config, config, device, ranks, config.batch
        self.generator = torch.Generator().manual_seed(c.seed)
        self.notes: list[str]
        """Notes on choices made before the first step, for the user."""
        train, start, priors, self.notes = prepare(train, points, c, device, priors, ready, progress)
        self.messages: list[str] = []
        """Messages for the user that were not shown yet."""
        cameras = [v.camera for v in train]
        extent, self.radius = scene_extent(cameras, start.cloud), scene_radius(cameras, start.cloud)
        """Radius of the scene [u], as `scene_radius` measures it."""
        self.scene_background, self.background = background, torch.tensor(background, dtype=torch.float32, device=device)
        self.half_resolution = c.half_resolution or 0.0
        """Fraction of the planned steps, from the first step on, in which views have half size."""
        self.dropout = c.dropout * min(1.0, DROPOUT_VIEWS / len(train))
        """Dropout probability at the last step."""
        self.cutout = is_cutout(train)  # then every view gets an opacity
        given = {n: any(getattr(v, n) is not None for v in train) for n in ("depth", "normals")}
        self.terms = terms_of(c, cutout=self.cutout, black=any(v.alpha_estimated for v in train), **given)
        self.step = 0  # taken
        self.memory_limit, self.captured = c.memory_limit, c.cuda_graph
        """Memory limit of steps [bytes], None for no limit; and whether steps may be captured. `spare_memory` changes both."""
        self.order: list[int] = []
        """Views still to come in the current pass over all views, in reverse order."""
        self.extrapolated = start.extrapolated > 0
        """True if the start has extrapolated points: opacity decay then spares Gaussians that a step does not use."""
        first = initial_gaussians(start.cloud, c.init, c.sh_degree, extent, device, start.extrapolated)
        self.table = Table.of_gaussians(first, {})
        self.first_count = len(self.table)
        """Number of Gaussians before the first step."""
        self.context = StrategyContext(
            c.groups(), c.strategy_config, self.table, self.generator, c.seed, plan_phases(c.phases, c.steps), extent, c.rule,
            self.background, antialiased=c.antialiased,
        )  # fmt: skip
        """The parts of the fit that the strategy works with: views, phases, the scene's size and others."""
        self.strategy, self.stopping = find_strategy(c.strategy)(self.context), Stopping(c.stopping)
        columns = returned(self.strategy, "columns", self.strategy.columns(), Mapping, "columns by name", each=Column)
        self.table.add_columns(columns)
        self.learned = LearnedViews(c.view_modules, train, device)
        """View modules with their parameters."""
        self.table.batch = self.learned.table.batch = c.batch
        self.mean = ParameterMean(c.optimizer.average_last)
        limiting, seed = (camera_centers(cameras, device), camera_rows(cameras, device)), c.seed if self.dropout > 0 else None
        parts = self.table, self.learned, self.strategy, limiting, self.context.render_options(), seed
        self.taker = StepTaker(*parts) if c.batch == 1 else BatchSteps(*parts, tree=Tree(c.batch, ranks))
        views, self.disparities = prepared_views(train, start, priors, c, self.terms, device)
        self.context.priors = priors or []
        self.set_views(with_learned(views, self.learned))
        self.strategy.setup()
        self.notes += self.stopping.begin(self.context, self.strategy, self.half_resolution)
        if self.stopping.active:
            self.set_views(self.stopping.hidden())

    @property
    def gaussians(self) -> Gaussians:
        """The current Gaussians, detached."""
        return self.context.gaussians

    @property
    def views(self) -> list[TrainingView]:
        """Views that are trained on."""
        return self.context.views

    @property
    def phases(self) -> Phases:
        """Current phases of the fit."""
        return self.context.phases

    @property
    def steps(self) -> int:
        """Steps of the fit: those of the settings, or fewer if phase 3 begins early."""
        return self.phases.steps

    def degree(self, step: int) -> int:
        """Return the degree of the harmonics in use at a step."""
        c = self.config
        return sh_degree(step, self.stopping.sh_every(c.sh_every, c.sh_degree), c.sh_degree)

    def plan_of(self, step: int) -> StepPlan:
        """Return the plan of step number ``step``, from 1."""
        c = self.config
        terms = tuple(t for t in self.terms if t.active(step, self.phases.planned))
        half = step <= self.half_resolution * self.phases.planned
        limits = c.limits.at(1.0 if step >= self.steps else self.phases.progress(step), self.radius, c.antialiased)
        phase = returned(self.strategy, "phase", self.strategy.phase(step), Hashable, "a hashable value")
        return StepPlan(self.degree(step), half, terms, phase, limits, c.optimizer.opacities_decay, self.extrapolated)

    def next_view(self) -> int:
        """Return the index of the next view. The order is random; each view comes once before any view comes again."""
        if not self.order:
            self.order = torch.randperm(len(self.views), generator=self.generator, device="cpu").tolist()
        return self.order.pop()

    def advance(self, limit: int = 1) -> list[StepReport]:
        """Take up to ``limit`` steps, and let the strategy change the set of Gaussians after the last step if a change is due.

        On CUDA, steps are replayed as graphs, several at a time, up to the next step after which the host has work. On a CPU,
        or if a memory limit does not allow graphs, one step is taken. After a NotFiniteError the Gaussians are as before.
        """
        with self._out_of_memory():
            return self._advance(limit)

    @contextlib.contextmanager
    def _out_of_memory(self) -> Iterator[None]:
        """Raise OutOfMemoryError for a lack of memory. If no step of the series was taken, its views come again."""
        try:
            yield
        except (MemoryError, RuntimeError) as e:
            if not is_out_of_memory(e):
                raise
            chosen, self.chosen = self.chosen, None
            intact = chosen is not None and int(self.taker.buffers.counter) == 0
            self.order += reversed(chosen if intact else [])
            raise OutOfMemoryError(no_memory_message(e, f" for step {self.step + 1}"), intact) from e

    def spare_memory(self) -> None:
        """Free unused memory, and run all further steps without graphs, in chunks that fit into the free memory."""
        self.taker.clear()
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
        return_freed_memory()
        held = self.layout.held(len(self.table))
        self.memory_limit, self.captured = held + available_bytes(self.device) * 4 // 5, False
        if self.config.memory_limit is not None:
            self.memory_limit = min(self.memory_limit, self.config.memory_limit)
        try:
            with self._out_of_memory():
                self.set_views(self.views)
        except UsageError as e:
            raise ResourceError(str(e)) from e
        self.messages.append(
            f"memory: step {self.step + 1} ran out of memory; now without CUDA graphs, in {format_bytes(self.memory_limit)}"
        )

    def _advance(self, limit: int) -> list[StepReport]:
        """Take steps as `advance` does."""
        begin, first, buffers = time.perf_counter(), self.step + 1, self.taker.buffers
        plan, count = self.plan_of(first), 1
        if self.layout.graphs:
            most = min(limit, steps_at_once(self.batch), self.mean.wait(self.step, self.steps))
            while count < most and self.plan_of(first + count) == plan and not self.is_due(first + count - 1):
                count += 1
        chosen = [self.next_view() for _ in range(count * self.batch)]
        places = [self.places[i + plan.half_size * len(self.views)] for i in chosen]
        steps = range(first, first + count)
        buffers.load([row for _, row in places[:count]], [self._lr_row(s) for s in steps], [self.settings(s) for s in steps])
        self.chosen = chosen
        self.taker.stacks, self.taker.captured = self.stacks, self.layout.graphs > 0
        if self.layout.graphs and self.stopping.ended is None:
            self.strategy.before_steps(steps[-1])
        try:
            self.taker.take(places, lambda: [self.settings(step, n) for step in steps for n in range(self.batch)], plan)
        except OverLimitError as e:
            self.taker.clear()
            self.layout.graphs = 0
            self.count_changed()
            self.messages.append(f"memory: from now on, steps run without CUDA graphs, because {e}")
            self.order += reversed(chosen)
            return self._advance(1)
        self.chosen = None
        done, stop, history = buffers.result()
        self.order += reversed(chosen[done * self.batch :])  # views of steps that were not taken come again
        self.step += done
        if stop == NOT_FINITE:
            error = NotFiniteError(f"the loss became {history[done][0]} at step {self.step + 1}")
            error.slot = self.taker.stopped_slot()
            error.view = chosen[done * self.batch + error.slot]
            raise error
        if stop:
            self.taker.clear()  # they are captured again with more capacity
        counts = [len(self.table)] * done
        if done == count:
            self._update()
            if self.mean.update(self.step, self.steps, self.taker.params):
                self._hold()
            counts[-1] = len(self.table)
        seconds = (time.perf_counter() - begin) / max(1, done)
        each = zip(steps, counts, history)  # history has the next step, too
        return [StepReport(step, loss, psnr_of(max(mse, 1e-12)), count, seconds) for step, count, (loss, mse) in each]

    def _hold(self) -> None:
        """Hold all Gaussians to the limits of the last step."""
        self.plan_of(self.step).limits.hold(self.table.params, self.taker.cameras)

    def _lr_row(self, step: int) -> list[float]:
        """Return the learning rates of a step as `StepBuffers` holds them: of the Gaussians, then of view modules."""
        own, lrs = self.lrs(step), self.learned.lrs(self.phases.progress(step), self.context.extent)
        return self.table.lr_row(own, step, self.config.optimizer.head_lrs) + self.learned.table.lr_row(lrs, step, {})

    def lrs(self, step: int) -> dict[str, float]:
        """Return the learning rate of each parameter of the Gaussians at a step."""
        c, phases = self.config, self.phases
        stable_start = phases.stable_start / phases.planned if c.phases.stable and phases.stable_start < phases.planned else 0.0
        return c.optimizer.lrs(self.phases.progress(step), self.context.extent, stable_start)

    def settings(self, step: int, slot: int | None = None) -> tuple[float, ...]:
        """Return the settings of a step (`Setting`), or of a slot, which has its own index for random numbers."""
        number = step if slot is None else (step - 1) * self.batch + slot + 1
        # else Gaussians of the background colour could cover empty areas
        shift = random_shift(self.config.seed, number, self.scene_background) if self.cutout else (0.0, 0.0, 0.0)
        means_lr = math.sqrt(self.batch) * self.lrs(step)["means"]
        return Setting.row(
            dropout=self.dropout * self.phases.progress(step), number=number, step=step, means_lr=means_lr, shift=shift
        )

    def is_due(self, step: int) -> bool:
        """Return whether the set of Gaussians changes, or left-out blocks are measured, after a step."""
        grows = self.stopping.ended is None and self.strategy.due(step)
        return self.stopping.due(step) or grows or self.strategy.prunes(step)

    def _update(self) -> None:
        """Change the set of Gaussians after the last step, if a change is due."""
        if not self.is_due(self.step):
            return
        if not self.table.settles:
            self.taker.clear()
        self.mean.restart()
        self.show_learned()
        stopping, step = self.stopping, self.step
        for change in stopping.changes(step, self.strategy, self.context, self.degree(step)):
            try:
                self.table.apply(change, self.context.capacity)
            except UsageError as e:
                raise UsageError(f"the strategy {type(self.strategy).__name__}, after step {step}: {e}") from e
            self.count_changed()
        if stopping.ended == step:
            self.set_views(stopping.whole)
            stopping.whole = self.views
            if self.steps < self.phases.planned:
                self.messages.append(f"early stopping: left-out pixels no longer improve; {self.steps:,} steps in all")
            words = f"stopping: growth ended at step {step} with {len(self.table):,} Gaussians, because {stopping.why}"
            self.messages.append(Detail(f"{words}; from now on, training uses all pixels"))
        self._hold()

    @property
    def by_rows(self) -> bool:
        """Whether Gaussians of opacity 0 change no bit of the others in a step: no part sums over all Gaussians."""
        ours = all(is_ours(type(part)) for part in (self.strategy, *self.terms))
        return ours and self.batch == 1 and type(self.strategy).regularisation is Strategy.regularisation

    def show_learned(self) -> None:
        """Write the current values of view modules into the views."""
        show_learned(self.views, self.stacks, self.places, self.learned)

    def set_views(self, views: list[TrainingView]) -> None:
        """Set the training views, and plan the memory of steps."""
        c = self.config
        self.taker.clear()
        shown = [*views, *(half_size(v) for v in views if self.half_resolution > 0)]
        shown, self.stacks, self.places = stack_views(shown, len(views))
        self.taker.stacks = self.stacks  # the old ones are freed
        self.context.views = shown[: len(views)]
        self.table.settles = self.taker.cuda and self.captured and self.memory_limit is None and self.by_rows
        self.layout = Layout(
            self.table, shown, self.terms, self.strategy, c.view_modules, kept=self.stopping.whole, captured=self.captured,
            sums=self.taker.kept_sums, averaged=self.mean.fraction > 0,
        )  # fmt: skip
        most = most_instances(self.gaussians, [v.camera for v in shown], self.context.render_options())
        return_freed_memory()  # that of reading
        self.memory = plan(
            self.layout, count=len(self.table), instances=most, most=c.max_gaussians, limit=self.memory_limit,
            available=available_bytes(self.device), capacity_factor=CAPACITY_FACTOR,
        )  # fmt: skip
        """Planned memory, for metrics.json."""
        self.context.capacity = min(c.max_gaussians, self.memory["cap"])
        self.count_changed()

    def count_changed(self) -> None:
        """Update the limit of (Gaussian, tile) instances, which depends on the number of Gaussians; None for no limit."""
        limit = self.memory_limit
        self.context.max_instances = None if limit is None else self.layout.most_instances(len(self.table), limit)

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Return tensors by name, of any shape [...], and plain values from which the fit continues with the same bits."""
        own = returned(self.strategy, "state", self.strategy.state(), tuple, "two dictionaries, tensors and plain values")
        (tensors, strategy), (errors, stopping) = own, self.stopping.state()
        views = {f"views.{n}": t for n, t in self.learned.table.state().items()}
        tensors = {**self.table.state(), **views, **self.mean.state(), **tensors, **errors}
        tensors["generator"] = self.generator.get_state()
        plain = {
            "step": self.step, "order": self.order, "extent": self.context.extent, "notes": self.notes, "strategy": strategy,
            "stopping": stopping, "config": self.config.to_json(), "steps": self.steps,
            "stable_start": self.phases.stable_start,
        }  # fmt: skip
        return tensors, plain

    def load(self, tensors: dict[str, torch.Tensor], plain: dict[str, Any]) -> None:
        """Load what `state` returned, ``tensors`` of shape [...] by name, or raise DataError."""
        check_state(tensors, plain, len(self.views), self.phases.planned, strategy=self.strategy.STATE, stopping=STATE)
        self.step, self.order = plain["step"], list(plain["order"])
        self.context.phases = replace(self.phases, stable_start=plain["stable_start"], steps=plain["steps"])
        self.context.extent = plain["extent"]
        self.notes = [*map(Detail, plain["notes"])]  # shown when the fit began
        self.table.load(tensors)
        self.learned.table.load({n.removeprefix("views."): t for n, t in tensors.items() if n.startswith("views.")})
        self.mean.load(tensors, self.taker.params)
        self.strategy.load(tensors, plain["strategy"])
        self.stopping.load(tensors, plain["stopping"])
        self.set_views(self.views if self.stopping.ended is None else self.stopping.whole)
        self.generator.set_state(tensors["generator"])


def train_views(scene: Scene, names: tuple[str, ...]) -> list[View]:
    """Return the named views of a scene, in the order of the names."""
    return [scene.view(n) for n in names]


def run(
    trainer: Trainer, on_step: Callable[[StepReport], None], save: Callable[[Trainer], None], stopped: Callable[[], bool],
    restore: Callable[[Trainer], bool] = lambda _: False,
) -> None:  # fmt: skip
    """Take all remaining steps; report each, and save at intervals and at the end.

    A step that runs out of memory is tried once more with less memory (`Trainer.spare_memory`). If the state is incomplete, for
    example during a change of the set of Gaussians, the fit continues from the last saved state, which ``restore`` loads; it
    returns False without one. With several processes there is no second try, because one process would be alone in that step.
    A state that is not finite is not saved. If ``stopped`` returns True after a step, KeyboardInterrupt is raised.
    """
    every, saved, ran_out = trainer.config.checkpoint_every, time.monotonic(), -1
    while trainer.step < trainer.steps:
        reports, failure, phase = [], None, f"steps (phase {trainer.phases.number(trainer.step)})"
        try:
            with section(phase):
                reports = trainer.advance(every - trainer.step % every)
        except OutOfMemoryError as e:
            failure = e.with_traceback(None)  # whose frames hold tensors
            failure.__cause__ = failure.__context__ = None
        if failure is not None:
            again, ran_out = trainer.step > ran_out and trainer.ranks.count == 1, trainer.step
            try:
                if not again or not (failure.intact or restore(trainer)):
                    raise failure
                trainer.spare_memory()
            except ResourceError:
                if failure.intact:
                    save(trainer)
                raise
            continue
        with section(phase):
            for report in reports:
                on_step(report)
        stop = trainer.taker.agreed(stopped())
        due = trainer.step % every == 0 and (every < ALL_SAVED or time.monotonic() - saved >= CHECKPOINT_SECONDS)
        if stop or due or trainer.step == trainer.steps:
            save(trainer)
            saved = time.monotonic()
        if stop:
            trainer.ranks.leave()
            raise KeyboardInterrupt


def complexity_figures(trainer: Trainer) -> dict:
    """Return the size of a model for metrics.json: its Gaussians, mean degree and bytes, and why growth ended."""
    degrees = stored_degrees(trainer.gaussians.sh)
    figures = {
        "count": len(degrees), "mean_degree": float(degrees.double().mean()), "bytes": model_bytes(degrees),
        "cap": trainer.config.max_gaussians, "held_out": False, "why": "growth ended by schedule", "marginal_db": None,
    }  # fmt: skip
    return {"complexity": figures | trainer.stopping.figures()}


def complexity_summary(figures: dict) -> str:
    """Return the values of `complexity_figures` as one line for the user."""
    f = figures["complexity"]
    text = f"{f['count']:,} Gaussians of mean SH degree {f['mean_degree']:.2f}, {format_bytes(f['bytes'])} uncompressed"
    return f"{text}; end of growth: {f['why']}"


# Warmup: a tiny fit during the preparation of the real fit, to load everything that the real fit uses on a CUDA device.
#
# Contexts, kernels, libraries and modules of Python are loaded at their first use, which took two to three seconds of a
# fit on an H200. Semantics and matches are found on the CPU at the same time.

STEPS = 3
"""Number of steps of the tiny fit, one for each phase."""
SIDE, POINTS, PLANES = 48, 200, 8
"""Side of the tiny fit's views [px], number of its points, and number of its sweep planes."""


def warm_up(config: FitConfig, device: torch.device, stopped: Callable[[], bool] = lambda: False) -> Trainer:
    """Fit noise in two small views with the settings of the real fit, including refinement and sampling; score one view.

    If the real fit sweeps on the device, these views are swept, too. Returns the trainer after its last step; if ``stopped``
    returns True after a step, KeyboardInterrupt is raised.
    """
    generator, views = np.random.default_rng(0), []
    K = np.array([[SIDE, 0, SIDE / 2], [0, SIDE, SIDE / 2], [0, 0, 1.0]])
    for x in (-0.2, 0.2):
        viewmat = np.eye(4)
        viewmat[0, 3] = x
        views.append(View(f"{x}", Camera(viewmat, K, SIDE, SIDE), generator.random((SIDE, SIDE, 3), np.float32)))
    cloud = PointCloud(generator.uniform([-1, -1, 2], [1, 1, 4], (POINTS, 3)), generator.random((POINTS, 3), np.float32))
    maps = [generator.random((SIDE, SIDE), np.float32) for _ in range(4)]
    small = replace(
        config, steps=STEPS, memory_limit=None, init=replace(config.init, source="points"),
        density=replace(config.density, every=1),
        strategy_config=find_strategy(config.strategy).warmup_config(config.strategy_config),
    )  # fmt: skip
    if sweeps(config.init, len(views)) and config.memory_limit is None:
        sweep_depths(views, [(2, 4)] * len(views), device, max_planes=PLANES)
    fit = Trainer(views, cloud, small, device, priors=[Prior(*maps, "noise", "noise") for _ in views])
    run(fit, lambda _: None, lambda _: None, stopped)
    score(views[0], render_view(fit.gaussians, views[0], fit.context.render_options())[0])
    fit.taker.clear()  # their memory is for the fit that follows
    return fit


@contextlib.contextmanager
def background_warmup(config: FitConfig, device: torch.device) -> Iterator[Callable[[], object]]:
    """Run `warm_up` in a thread within the block, if the device is a GPU that networks for priors do not use.

    Yields a function that waits for the end of the warmup and raises its errors. Until the function returns, nothing else may
    use the device, since steps may be captured at that time. The thread ends before the block does, also after an error.
    """
    if device.type != "cuda" or config.priors.onnx_provider == "cuda":
        yield lambda: None
        return
    stop = threading.Event()

    def on_device() -> None:
        with torch.cuda.device(device):
            warm_up(config, device, stop.is_set)

    with ThreadPoolExecutor(1, thread_name_prefix="warmup") as thread:
        done = thread.submit(on_device)
        try:
            yield done.result
        finally:
            stop.set()
