"""The fit: from views and points to Gaussians, one step a view."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from warpgs.errors import DataError, NotFiniteError
from warpgs.kernels.dropout import opacity_dropout
from warpgs.pipeline.config import FitConfig
from warpgs.pipeline.density import DensityStats, Refinement, refine
from warpgs.pipeline.graph import BURST, NOT_FINITE, ROOM, Burst, OverLimitError, StepGraph, stack_views
from warpgs.pipeline.init import initial_gaussians, scene_extent
from warpgs.pipeline.layers import COARSE, FINE, LONG_AGO, Layers
from warpgs.pipeline.loss import masked_mse, training_loss
from warpgs.pipeline.memory import layout_of, most_instances, plan
from warpgs.pipeline.method import Event, TrainingView, guided_views, sampling_event
from warpgs.pipeline.optimizer import Optimizer
from warpgs.pipeline.preparation import prepare
from warpgs.pipeline.resolution import halved
from warpgs.pipeline.schedule import Phase, plan_phases, sh_degree
from warpgs.rasterizer import RasterizeOptions, rasterize
from warpgs.runtime.device_memory import available_bytes
from warpgs.scene import Gaussians, PointCloud, Prior, Scene, View


@dataclass(frozen=True)
class StepReport:
    """What one step has to tell."""

    step: int
    """Steps done, from 1."""
    loss: float
    """Loss on the step's view."""
    psnr: float
    """PSNR on the step's view before the update [dB]."""
    count: int
    """Number of Gaussians."""
    seconds: float
    """Wall time of the step [s]."""


class Fit:
    """The state of one fit: everything that changes from step to step, and nothing else."""

    def __init__(
        self, train: list[View], points: PointCloud | None, config: FitConfig, device: torch.device,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0), priors: list[Prior] | None = None,
        ready: Callable[[], object] = lambda: None,
    ):  # fmt: skip
        """Set up the first Gaussians.

        Args:
            train: The views to fit, at least one.
            points: The reconstruction's points, or None.
            config: Settings.
            device: Where to work.
            background: Colour behind the scene.
            priors: What is believed of each view; None to find out where sampling or the depth term asks for it.
            ready: Called before the device is used.

        Raises:
            DataError: There is nothing to start from.
            UsageError: The memory limit is below what the smallest step needs.
        """
        if not train:
            raise DataError("there is no training view; name at least one in --split")
        self.config, self.device = config, device
        self.generator = torch.Generator().manual_seed(config.seed)
        random = np.random.default_rng(config.seed)
        made = prepare(train, points, config, random, device, priors, ready)
        cloud, self.notes = made.start.cloud, made.notes
        self.extent = scene_extent([v.camera for v in train], cloud)
        self.background = torch.tensor(background, dtype=torch.float32, device=device)
        self.phases = plan_phases(config.phases, config.steps)
        settle = self.phases.settle / config.steps if self.phases.settle < config.steps else 0.0
        gaussians = initial_gaussians(cloud, config.init, self.extent, device)
        self.optimizer = Optimizer(gaussians, config.optimizer, self.extent, settle)
        self.stats, self.layers = DensityStats(len(cloud), device), Layers(len(cloud), device)
        self.dropout = config.dropout * min(1.0, config.dropout_views / len(train))
        self.events: list[dict] = []
        self.step, self.reset_done, self.order = 0, False, []
        self.on_event: Callable[[int, Event], None] | None = None
        self.graphs: dict[tuple, StepGraph] = {}
        self.views = [TrainingView.of(v, device) for v in train]
        if config.method.events:
            self.disparities = [p.disparity for p in made.priors]
            """Relative inverse depth of each view in [0, 1], [H, W]: only pictures of events show it."""
            depths = made.start.depths or [None] * len(train)
            self.views = [v.scored(p, d, config.method) for v, p, d in zip(self.views, made.priors, depths, strict=True)]
        if config.loss.depth_weight > 0:
            self.views, note = guided_views(self.views, made.priors)
            self.notes.append(note)
        self.news: list[str] = []
        """What the user must know of and was not told yet."""
        self._plan()

    @property
    def gaussians(self) -> Gaussians:
        """The current Gaussians, detached."""
        return Gaussians(**{n: t.detach() for n, t in self.optimizer.params.items()})

    def next_view(self) -> int:
        """Views come in random order, each once before any comes again."""
        if not self.order:
            self.order = torch.randperm(len(self.views), generator=self.generator).tolist()
        return self.order.pop()

    def advance(self) -> StepReport:
        """Render a view, compare it, update the Gaussians, and change the set when it is time.

        Raises:
            NotFiniteError: The loss is not finite; the Gaussians are as before the step.
        """
        begin = time.perf_counter()
        self.step += 1
        c, phase = self.config, self._phase(self.step)
        view = self.shown[self.next_view() + phase.halved * len(self.views)]
        factors = None
        if self.dropout > 0:
            settings = torch.tensor(self._settings(self.step), dtype=torch.float32, device=self.device)
            factors = opacity_dropout(len(self.optimizer.gaussians), settings, c.seed)
        options = RasterizeOptions(
            rule=c.rule,
            sh_degree=phase.degree,
            background=self.background,
            opacity_factors=factors,
            max_instances=self.most,
            record=False,  # it would make room for more than was planned
        )
        render = rasterize(self.optimizer.gaussians, view.camera, options)
        render.splats.retain_grad()
        disparity = view.disparity if phase.guided else None
        loss = training_loss((render.rgb, render.alpha, render.depth), view.photo, view.mask, disparity, c.loss)
        loss.backward()
        value = loss.item()
        if not math.isfinite(value):
            raise NotFiniteError(f"the loss became {value} at step {self.step}; the last checkpoint is the state before")

        if phase.densifying:
            self.stats.add(render)
        self.optimizer.step(self._progress(self.step), self._share(phase))
        if self._protects:
            self.layers.hold_up(self.optimizer.params["logit_opacities"].detach(), self.step, c.method.protect)
        with torch.no_grad():
            psnr = -10 * math.log10(max(masked_mse(render.rgb, view.photo, view.mask).item(), 1e-12))
        del render, loss  # their graph holds the parameters, which are about to be replaced
        self._change_set(phase)
        return StepReport(self.step, value, psnr, len(self.optimizer.gaussians), time.perf_counter() - begin)

    def burst(self, limit: int) -> list[StepReport]:
        """Take several steps: on CUDA as recorded graphs, which read nothing back in between; elsewhere one as `advance` does.

        Ends before anything that needs the host: a change of the set of Gaussians or of the degree, or ``limit`` steps.

        Raises:
            NotFiniteError: A loss is not finite; the Gaussians are as before that step.
            ResourceError: The instances would not fit into memory.
        """
        if not self.layout.recordings:
            return [self.advance()]
        begin = time.perf_counter()
        c, first = self.config, self.step + 1
        phase, count = self._phase(first), 1
        while (
            count < min(limit, BURST, c.steps - self.step)
            and self._phase(first + count) == phase
            and not self._changes_after(first + count - 1)
        ):
            count += 1
        chosen = [self.next_view() for _ in range(count)]
        places = [self.places[i + phase.halved * len(self.views)] for i in chosen]
        try:
            graphs = [self._graph(kind, phase) for kind, _ in places]
        except OverLimitError as e:
            self.order += reversed(chosen)
            self.graphs.clear()
            self.layout = dataclasses.replace(self.layout, recordings=0)
            self._count_changed()
            self.news.append(f"memory: steps are taken one by one from here on, because {e}")
            return [self.advance()]
        steps = range(first, first + count)
        rates = [self.optimizer.schedule(self._progress(s), s) for s in steps]
        self.work.load([row for _, row in places], rates, [self._settings(s) for s in steps])
        for graph in graphs:
            graph.replay()
        done, stop, history = self.work.result()
        self.order += reversed(chosen[done:])  # views of steps that were not taken come again
        self.step += done
        self.optimizer.step_count += done
        if stop == NOT_FINITE:
            raise NotFiniteError(
                f"the loss became {history[done][0]} at step {self.step + 1}; the last checkpoint is the state before"
            )
        if stop:
            self.graphs.clear()  # recorded anew with more room
        counts = [len(self.optimizer.gaussians)] * done
        if done == count:
            self._change_set(phase)
            counts[-1] = len(self.optimizer.gaussians)
        seconds = (time.perf_counter() - begin) / max(1, done)
        return [
            StepReport(first + k, loss, -10 * math.log10(max(mse, 1e-12)), counts[k], seconds)
            for k, (loss, mse) in enumerate(history[:done])
        ]

    def _progress(self, step: int) -> float:
        return (step - 1) / max(1, self.config.steps - 1)

    def _settings(self, step: int) -> tuple[float, int]:
        """Dropout probability and number of a step."""
        return self.dropout * self._progress(step), step

    def _phase(self, step: int) -> Phase:
        c = self.config
        layered = c.method.hier and c.method.events and step > self.phases.refine
        half = step <= c.half_resolution * c.steps
        guided = c.loss.depth_weight > 0 and step <= c.loss.depth_until * c.steps
        return Phase(sh_degree(step, c.sh_every, c.init.max_sh_degree), step <= self._densify_until, layered, half, guided)

    @property
    def _densify_until(self) -> int:
        c = self.config
        return self.phases.settle if c.phases.coarse + c.phases.stable > 0 else c.density.times(c.steps)[2]

    @property
    def _room_for(self) -> int:
        """Number of Gaussians that the settings and the memory limit allow."""
        return min(self.config.density.max_gaussians, self.memory.cap)

    @property
    def _protects(self) -> bool:
        return self.config.method.events and self.config.method.pm

    def _share(self, phase: Phase) -> torch.Tensor | None:
        """Part of its step that each mean takes."""
        if not phase.layered:
            return None
        return torch.where(self.layers.fine, 1.0, self.config.method.coarse_rate)

    def _graph(self, kind: tuple[int, int, bool], phase: Phase) -> StepGraph:
        key = (kind, phase)
        if key not in self.graphs:
            c, views = self.config, self.stacks[kind]
            views = views if phase.guided else dataclasses.replace(views, disparities=None)
            self.graphs = {k: g for k, g in self.graphs.items() if k[1:] == key[1:]}
            self.graphs[key] = StepGraph(
                views, self.optimizer, self.stats if phase.densifying else None, self.work,
                degree=phase.degree, rule=c.rule, loss=c.loss, background=self.background,
                dropout_seed=c.seed if self.dropout > 0 else None, share=self._share(phase),
                protected=(self.layers, c.method.protect) if self._protects else None, most=self.most,
                fused=c.fused_adam,
            )  # fmt: skip
        return self.graphs[key]

    def _plan(self) -> None:
        """Foretell the memory that steps need, and decide how they are taken."""
        c = self.config
        self.shown = self.views + [halved(v) for v in self.views if c.half_resolution > 0]
        cameras, masked = [v.camera for v in self.shown], [v.mask is not None for v in self.shown]
        layout = layout_of(
            self.gaussians, cameras, masked, scored=c.method.events, recorded=c.cuda_graph,
            guided=c.loss.depth_weight > 0, fused=c.fused_adam,
        )  # fmt: skip
        self.memory, self.layout = plan(
            layout, count=len(self.optimizer.gaussians), instances=most_instances(self.gaussians, cameras, c.rule),
            most=c.density.max_gaussians, limit=c.memory_limit, available=available_bytes(self.device), room=ROOM,
        )  # fmt: skip
        self._count_changed()
        if self.layout.recordings:
            self.work, (self.stacks, self.places) = Burst(self.device), stack_views(self.shown)

    def _count_changed(self) -> None:
        """Set how many instances a step may have at a time: None where there is no limit."""
        limit = self.config.memory_limit
        self.most = None if limit is None else self.layout.most_instances(len(self.optimizer.gaussians), limit)

    def _samples_after(self, step: int) -> bool:
        return self.config.method.events and step in self.phases.events

    def _changes_after(self, step: int) -> bool:
        return any(self.config.density.due(step, self.config.steps, self._densify_until)) or self._samples_after(step)

    def _change_set(self, phase: Phase) -> None:
        """Whatever changes the set of Gaussians after the step that was just taken: refinement, reset, sampling."""
        refines, resets = self.config.density.due(self.step, self.config.steps, self._densify_until)
        if refines:
            self._refine(phase)
        if resets:
            self.graphs.clear()
            self.optimizer.cap_opacity(self.config.density.reset_opacity)
            self.reset_done = True
        if self._samples_after(self.step):
            self._sample()

    def _refine(self, phase: Phase) -> None:
        c = self.config
        density = dataclasses.replace(c.density, max_gaussians=self._room_for)
        change = refine(
            self.gaussians, self.stats, density, extent=self.extent, after_reset=self.reset_done, generator=self.generator,
            growing=self.layers.fine if phase.layered else None,
            protected=self.layers.young(self.step, c.method.protect) if self._protects else None,
        )  # fmt: skip
        self._apply(change, COARSE, LONG_AGO)
        if c.density.morton_order:
            self.layers.reorder(self.optimizer.sort_along_curve())
        self.stats = DensityStats(len(self.optimizer.gaussians), self.device)

    def _sample(self) -> None:
        """Add fine Gaussians (docs/decisions/008-method.md)."""
        c = self.config
        event = sampling_event(
            self.gaussians, self.layers, self.views, c.method, step=self.step, rule=c.rule, background=self.background,
            room=self._room_for - len(self.optimizer.gaussians), generator=self.generator, max_instances=self.most,
        )  # fmt: skip
        self._apply(event.change, FINE, self.step)
        self.events.append({
            "step": self.step, "added": len(event.change.parents), "freed": event.freed,
            "quantiles": [v.quantile for v in event.views],
        })  # fmt: skip
        if self.on_event is not None:
            self.on_event(self.step, event)

    def _apply(self, change: Refinement, level: int, birth: int) -> None:
        """Follow a change of the set with all that goes by row."""
        self.graphs.clear()
        self.optimizer.apply(change)
        self.layers.apply(change, level=level, birth=birth)
        self.stats.apply(change)
        self._count_changed()

    def state(self) -> tuple[dict[str, torch.Tensor], dict]:
        """Tensors and plain values from which the fit goes on as if it had never stopped."""
        tensors = {
            **self.optimizer.state(),
            **self.stats.state(),
            **self.layers.state(),
            "generator": self.generator.get_state(),
        }
        plain = {
            "step": self.step, "order": self.order, "reset_done": self.reset_done, "extent": self.extent,
            "notes": self.notes, "events": self.events, "config": self.config.to_json(),
        }  # fmt: skip
        return tensors, plain

    def load(self, tensors: dict[str, torch.Tensor], plain: dict) -> None:
        """Take over what `state` gave."""
        self.step, self.order, self.reset_done = plain["step"], list(plain["order"]), plain["reset_done"]
        self.extent, self.notes = plain["extent"], plain["notes"]
        self.optimizer.extent = self.extent
        self.optimizer.load(tensors, self.step)
        self.stats = DensityStats(len(self.optimizer.gaussians), self.device)
        self.stats.load(tensors)
        self.layers.load(tensors)
        self.events = plain["events"]
        self.graphs.clear()
        self._plan()
        self.generator.set_state(tensors["generator"])


def train_views(scene: Scene, names: tuple[str, ...]) -> list[View]:
    """The named views of a scene, in the order named."""
    return [scene.view(n) for n in names]


def run(fit: Fit, on_step: Callable[[StepReport], None], save: Callable[[Fit], None], stopped: Callable[[], bool]) -> None:
    """Take all remaining steps, reporting each and saving now and then and at the end.

    Raises:
        NotFiniteError: The loss or, when it is to be saved, a number of the state is not finite; nothing of it is saved.
        KeyboardInterrupt: ``stopped`` said so after a step; the state after it is saved.
    """
    every, saved = fit.config.checkpoint_every, time.monotonic()
    while fit.step < fit.config.steps:
        for report in fit.burst(every - fit.step % every):
            on_step(report)
        stop = stopped()
        due = fit.step % every == 0 and time.monotonic() - saved >= fit.config.checkpoint_seconds
        if stop or due or fit.step == fit.config.steps:
            save(fit)
            saved = time.monotonic()
        if stop:
            raise KeyboardInterrupt
