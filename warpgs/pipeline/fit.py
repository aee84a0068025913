"""The fit: from views and points to Gaussians, one step a view."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from warpgs import geometry
from warpgs.errors import DataError, WarpgsError
from warpgs.pipeline.config import FitConfig
from warpgs.pipeline.density import DensityStats, refine
from warpgs.pipeline.graph import BURST, NOT_FINITE, Burst, StepGraph, Views
from warpgs.pipeline.init import initial_gaussians, initial_points
from warpgs.pipeline.loss import masked_mse, photometric_loss
from warpgs.pipeline.optimizer import Optimizer
from warpgs.pipeline.schedule import sh_degree
from warpgs.rasterizer import RasterizeOptions, rasterize
from warpgs.scene import Camera, Gaussians, PointCloud, Scene, View


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


class NotFiniteError(WarpgsError):
    """The loss stopped being a number."""


class Fit:
    """The state of one fit: everything that changes from step to step, and nothing else."""

    def __init__(
        self,
        train: list[View],
        points: PointCloud | None,
        config: FitConfig,
        device: torch.device,
        background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    ):
        """Set up the first Gaussians.

        Args:
            train: The views to fit, at least one.
            points: The reconstruction's points, or None.
            config: Settings.
            device: Where to work.
            background: Colour behind the scene.

        Raises:
            DataError: There is nothing to start from.
        """
        if not train:
            raise DataError("there is no training view; name at least one in --split")
        self.config, self.device = config, device
        self.background = torch.tensor(background, dtype=torch.float32, device=device)
        self.generator = torch.Generator().manual_seed(config.seed)
        cloud, self.start = initial_points(train, points, config.init, np.random.default_rng(config.seed))
        self.extent = self._extent([v.camera for v in train], cloud)
        self.optimizer = Optimizer(initial_gaussians(cloud, config.init, self.extent, device), config.optimizer, self.extent)
        self.stats = DensityStats(len(cloud), device)
        self.step, self.reset_done = 0, False
        self.order: list[int] = []
        self.graphs: dict[tuple, StepGraph] = {}
        self.views = [self._on_device(v) for v in train]
        if device.type == "cuda" and config.cuda_graph:
            self._stack()

    @staticmethod
    def _extent(cameras: list[Camera], cloud: PointCloud) -> float:
        """Size of the scene [u]: that of the camera set; where all cameras stand together, a tenth of the cloud's."""
        extent = geometry.camera_extent(cameras)
        spread = float(np.linalg.norm(np.std(cloud.points, axis=0)))
        return max(extent, 0.1 * spread if extent < 1e-3 * spread else 0.0, 1e-6)

    def _on_device(self, view: View) -> tuple[Camera, torch.Tensor, torch.Tensor | None]:
        camera = Camera(
            torch.as_tensor(view.camera.viewmat, dtype=torch.float32, device=self.device),
            torch.as_tensor(view.camera.K, dtype=torch.float32, device=self.device),
            view.camera.width, view.camera.height,
        )  # fmt: skip
        mask = None
        if view.mask is not None:
            mask = torch.as_tensor(view.mask, dtype=torch.float32, device=self.device)
        return camera, torch.as_tensor(view.image, dtype=torch.float32, device=self.device), mask

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
        """Render a view, compare it, update the Gaussians, and refine the set when it is time.

        Raises:
            NotFiniteError: The loss is not finite; the Gaussians are as before the step.
        """
        begin = time.perf_counter()
        self.step += 1
        c = self.config
        camera, target, mask = self.views[self.next_view()]
        degree = sh_degree(self.step, c.sh_every, c.init.max_sh_degree)
        options = RasterizeOptions(rule=c.rule, sh_degree=degree, background=self.background)
        render = rasterize(self.optimizer.gaussians, camera, options)
        render.splats.retain_grad()
        loss, _ = photometric_loss(render.rgb, target, mask, c.loss)
        loss.backward()
        value = loss.item()
        if not math.isfinite(value):
            raise NotFiniteError(f"the loss became {value} at step {self.step}; the last checkpoint is the state before")

        densifying = self.step <= c.density.times(c.steps)[2]
        if densifying:
            self.stats.add(render)
        self.optimizer.step((self.step - 1) / max(1, c.steps - 1))
        if densifying:
            self._refine()
        with torch.no_grad():
            psnr = -10 * math.log10(max(masked_mse(render.rgb, target, mask).item(), 1e-12))
        return StepReport(self.step, value, psnr, len(self.optimizer.gaussians), time.perf_counter() - begin)

    def burst(self, limit: int) -> list[StepReport]:
        """Take several steps: on CUDA as recorded graphs, which read nothing back in between; elsewhere one as `advance` does.

        Ends before anything that needs the host: a change of the set of Gaussians or of the degree, or ``limit`` steps.

        Raises:
            NotFiniteError: A loss is not finite; the Gaussians are as before that step.
            ResourceError: The instances would not fit into memory.
        """
        if self.device.type != "cuda" or not self.config.cuda_graph:
            return [self.advance()]
        begin = time.perf_counter()
        c, first = self.config, self.step + 1
        degree, densifying = self._phase(first)
        start, every, _ = c.density.times(c.steps)
        count = 1
        while count < min(limit, BURST, c.steps - self.step) and self._phase(first + count) == (degree, densifying):
            last = first + count - 1
            if densifying and (
                (last > start and last % every == 0) or (c.density.reset_every and last % c.density.reset_every == 0)
            ):
                break
            count += 1
        chosen = [self.next_view() for _ in range(count)]
        graphs = [self._graph(self.places[i][0], degree, densifying) for i in chosen]
        rates = [self.optimizer.schedule((s - 1) / max(1, c.steps - 1), s) for s in range(first, first + count)]
        self.work.load([self.places[i][1] for i in chosen], rates)
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
        if densifying and done == count:
            self._refine()
            counts[-1] = len(self.optimizer.gaussians)
        seconds = (time.perf_counter() - begin) / max(1, done)
        return [
            StepReport(first + k, loss, -10 * math.log10(max(mse, 1e-12)), counts[k], seconds)
            for k, (loss, mse) in enumerate(history[:done])
        ]

    def _phase(self, step: int) -> tuple[int, bool]:
        """Degree in use at a step, and whether its gradients count for densification."""
        c = self.config
        return sh_degree(step, c.sh_every, c.init.max_sh_degree), step <= c.density.times(c.steps)[2]

    def _graph(self, kind: tuple[int, int, bool], degree: int, densifying: bool) -> StepGraph:
        key = (kind, degree, densifying)
        if key not in self.graphs:
            self.graphs = {k: g for k, g in self.graphs.items() if k[1:] == key[1:]}
            self.graphs[key] = StepGraph(
                self.stacks[kind], self.optimizer, self.stats if densifying else None, self.work,
                degree=degree, rule=self.config.rule, loss=self.config.loss, background=self.background,
            )  # fmt: skip
        return self.graphs[key]

    def _stack(self) -> None:
        """Views by size and by whether they have a mask, as recorded steps take them."""
        self.work, self.stacks = Burst(self.device), {}
        kinds = [(camera.width, camera.height, mask is not None) for camera, _, mask in self.views]
        for kind in dict.fromkeys(kinds):
            cameras, targets, masks = zip(*(v for v, k in zip(self.views, kinds) if k == kind))
            self.stacks[kind] = Views(
                torch.stack([c.viewmat for c in cameras]), torch.stack([c.K for c in cameras]), torch.stack(targets),
                torch.stack(masks) if kind[2] else None,
            )  # fmt: skip
        self.places = [(k, kinds[:i].count(k)) for i, k in enumerate(kinds)]

    def _refine(self) -> None:
        c = self.config.density
        start, every, _ = c.times(self.config.steps)
        if self.step > start and self.step % every == 0:
            change = refine(
                self.gaussians, self.stats, c, extent=self.extent, after_reset=self.reset_done, generator=self.generator
            )
            self.graphs.clear()
            self.optimizer.apply(change)
            self.stats = DensityStats(len(self.optimizer.gaussians), self.device)
        if c.reset_every and self.step % c.reset_every == 0:
            self.graphs.clear()
            self.optimizer.cap_opacity(c.reset_opacity)
            self.reset_done = True

    def state(self) -> tuple[dict[str, torch.Tensor], dict]:
        """Tensors and plain values from which the fit goes on as if it had never stopped."""
        tensors = {**self.optimizer.state(), **self.stats.state(), "generator": self.generator.get_state()}
        plain = {
            "step": self.step, "order": self.order, "reset_done": self.reset_done, "extent": self.extent,
            "start": self.start, "config": self.config.to_json(),
        }  # fmt: skip
        return tensors, plain

    def load(self, tensors: dict[str, torch.Tensor], plain: dict) -> None:
        """Take over what `state` gave."""
        self.step, self.order, self.reset_done = plain["step"], list(plain["order"]), plain["reset_done"]
        self.extent, self.start = plain["extent"], plain["start"]
        self.optimizer.extent = self.extent
        self.optimizer.load(tensors, self.step)
        self.stats = DensityStats(len(self.optimizer.gaussians), self.device)
        self.stats.load(tensors)
        self.graphs.clear()
        self.generator.set_state(tensors["generator"])


def train_views(scene: Scene, names: tuple[str, ...]) -> list[View]:
    """The named views of a scene, in the order named."""
    return [scene.view(n) for n in names]


def run(fit: Fit, on_step: Callable[[StepReport], None], save: Callable[[Fit], None], stopped: Callable[[], bool]) -> None:
    """Take all remaining steps, reporting each and saving now and then and at the end.

    Raises:
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
