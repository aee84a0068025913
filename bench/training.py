"""The trainer as benches use it: no other module of the benches knows how a fit is set up and stepped."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch

from warpgs import rasterize
from warpgs.pipeline.model.table import Optimizer, OptimizerConfig
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.loss import LossConfig, photometric_loss
from warpgs.pipeline.train.step import STEPS_PER_BATCH, StepBuffers, StepGraph, Views
from warpgs.pipeline.train.strategies.holdout import complexity_figures, fit_class
from warpgs.pipeline.train.trainer import Fit as Trainer
from warpgs.pipeline.train.trainer import run
from warpgs.scene import Camera, Gaussians, PointCloud, View

BLACK = (0.0, 0.0, 0.0)


def make_trainer(
    views: list[View], points: PointCloud | None, config: FitConfig, device: torch.device, background=BLACK
) -> Trainer:
    """Return a trainer at step 0."""
    return fit_class(config)(views, points, config, device, background)


def finish(trainer: Trainer) -> None:
    """Take all remaining steps, save nothing, and wait for the device."""
    run(trainer, lambda _: None, lambda _: None, lambda: False)
    if trainer.device.type == "cuda":
        torch.cuda.synchronize(trainer.device)


def take_steps(trainer: Trainer, count: int) -> int:
    """Take at least ``count`` steps as a fit does, and return how many were taken."""
    done = 0
    while done < count:
        done += len(trainer.buffers(count - done))
    return done


def one_step(trainer: Trainer) -> None:
    """Take one step from Python, nothing recorded."""
    trainer.advance()


def sort_along_curve(trainer: Trainer) -> None:
    """Put the Gaussians in Morton order."""
    trainer.optimizer.sort_along_curve()


def model_bytes(trainer: Trainer) -> int:
    """Return the bytes of the model, each Gaussian with the coefficients of its own degree."""
    return complexity_figures(trainer)["complexity"]["bytes"]


def with_cap(config: FitConfig, most: int) -> FitConfig:
    """Return the settings with at most so many Gaussians."""
    return dataclasses.replace(config, density=dataclasses.replace(config.density, max_gaussians=most))


def with_strategy(config: FitConfig, name: str) -> FitConfig:
    """Return the settings with another density strategy."""
    return dataclasses.replace(config, strategy=name)


def adaptive(config: FitConfig, on: bool) -> FitConfig:
    """Return the settings with the size of the model judged on held-out blocks, or not."""
    return dataclasses.replace(config, adaptive=on)


def without_density(config: FitConfig) -> FitConfig:
    """Return the settings with the set of Gaussians left as it starts."""
    return dataclasses.replace(config, density=dataclasses.replace(config.density, start=config.steps))


@dataclass(frozen=True)
class StepParts:
    """Inputs of the stages of a trainer's step."""

    camera: Camera
    target: torch.Tensor
    """Image of the first training view, shape [H, W, 3]."""
    parameters: dict[str, torch.Tensor]
    """Parameters by name, in the order in which `project` takes them."""
    background: torch.Tensor
    """Colour, shape [3]."""
    rule: str
    optimize: Callable[[], None]
    """Adam over all parameters, with gradients of zero."""


def step_parts(trainer: Trainer) -> StepParts:
    """Return the inputs of a step on the first training view."""
    view, parameters = trainer.views[0], trainer.optimizer.params

    def optimize():
        for p in parameters.values():
            p.grad = torch.zeros_like(p)
        trainer.optimizer.step(0.5)

    ordered = trainer.optimizer.gaussians.tensors()
    return StepParts(view.camera, view.image, ordered, trainer.background, trainer.config.rule, optimize)


class GraphedSteps:
    """Training steps of given Gaussians on one image, recorded once and replayed as in a fit; CUDA only.

    Args:
        gaussians: The start; trained in place of a copy.
        camera: A batch of one camera.
        target: Image, shape [H, W, 3].
        rule: Cut-offs of the rasterizer.
    """

    def __init__(self, gaussians: Gaussians, camera: Camera, target: torch.Tensor, rule: str):
        device = target.device
        self.optimizer, self.buffers = Optimizer(gaussians, OptimizerConfig(), 1.0), StepBuffers(device)
        views = Views(camera.viewmat, camera.K, target[None], None)
        self.graph = StepGraph(
            views, self.optimizer, None, self.buffers, degree=gaussians.sh_degree, rule=rule, loss=LossConfig(),
            background=torch.zeros(3, device=device),
        )  # fmt: skip
        self._load(range(1, STEPS_PER_BATCH + 1))

    @property
    def capacity(self) -> int:
        """Instances that a step may have."""
        return self.graph.capacity

    def _load(self, steps: range) -> None:
        lrs, settings = [self.optimizer.schedule(0.0, k) for k in steps], [(0.0, k) for k in steps]
        self.buffers.load([0] * len(steps), lrs, settings)

    def replay(self) -> None:
        """Take the first step of a batch, again and again: the same work each time."""
        self.buffers.counter.zero_()
        self.graph.replay()

    def train(self, steps: int) -> list[float]:
        """Take steps one after the other and return their losses.

        Raises:
            RuntimeError: A loss is not finite, or the instances outgrew the capacity.
        """
        losses: list[float] = []
        while len(losses) < steps:
            count = min(STEPS_PER_BATCH, steps - len(losses))
            self._load(range(len(losses) + 1, len(losses) + count + 1))
            for _ in range(count):
                self.graph.replay()
            done, stop, history = self.buffers.result()
            if stop:
                raise RuntimeError(f"training stopped after {len(losses) + done} steps with code {stop}; use fewer Gaussians")
            losses += [loss for loss, _ in history[:done]]
        return losses


def eager_step(gaussians: Gaussians, camera: Camera, target: torch.Tensor, lr: float) -> Callable[[], None]:
    """Return a training step from Python with the same learning rate for all parameters: image, loss, backward pass, Adam."""
    lrs = {f"{n}_lr": lr for n in ("means", "quats", "scales", "opacities", "sh")}
    optimizer, loss = Optimizer(gaussians, OptimizerConfig(means_lr_final=lr, **lrs), extent=1.0), LossConfig()

    def step():
        image = rasterize(optimizer.gaussians, camera).rgb
        photometric_loss(image, target, None, loss).backward()
        optimizer.step(0.5)

    return step
