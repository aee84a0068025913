"""The trainer for benches; no other module of bench sets up a fit or takes its steps."""

from __future__ import annotations

from collections.abc import Callable

import torch

from warpgs.kernels.update import Setting
from warpgs.pipeline.model.table import DensityUpdate, Table, model_bytes as bytes_of
from warpgs.pipeline.train.loss import LossConfig, built_in_terms
from warpgs.pipeline.train.schedule import OptimizerConfig, plan_phases
from warpgs.pipeline.train.settings import FitConfig, settings_by_views
from warpgs.pipeline.train.step import MAX_STEPS, StepPlan, StepTaker, eager_renderer
from warpgs.pipeline.train.strategies.base import Strategy, StrategyContext
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.views import LearnedViews, ViewStack
from warpgs.ranks import ALONE
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Camera, Gaussians, PointCloud, View

BLACK = (0.0, 0.0, 0.0)
KIND = "image"
"""Name of the only kind of view of `Steps`."""


def make_trainer(
    views: list[View], points: PointCloud | None, config: FitConfig, device: torch.device, background=BLACK, ranks=ALONE
) -> Trainer:
    """Return a trainer at step 0."""
    return Trainer(views, points, settings_by_views(config, views, device.type)[0], device, background, ranks=ranks)


def set_gaussians(trainer: Trainer, gaussians: Gaussians) -> None:
    """Replace the Gaussians of a trainer; moments start at zero."""
    new = {n: t.detach().to(trainer.device) for n, t in gaussians.tensors().items()}
    nobody = torch.empty(0, dtype=torch.int64, device=trainer.device)
    parents = torch.full((len(gaussians),), -1, dtype=torch.int64, device=trainer.device)
    trainer.table.apply(DensityUpdate(nobody, new, parents))
    trainer.set_views(trainer.views)


def state_tensors(trainer: Trainer) -> list[torch.Tensor]:
    """Return parameters, moments and columns of the Gaussians, in a fixed order."""
    return [t for _, t in sorted(trainer.table.state().items())]


def one_step(trainer: Trainer) -> None:
    """Take one step as a fit does: on CUDA a graph, elsewhere from Python."""
    trainer.advance()


def full_bytes(count: int, degree: int = 3) -> int:
    """Return the bytes of a model of so many Gaussians, all of one degree."""
    return bytes_of(torch.full((count,), degree))


def step_parts(trainer: Trainer) -> tuple[View, dict[str, torch.Tensor], Callable[[], None]]:
    """Return the first training view, the parameters as `project` takes them, and Adam over all with gradients of zero."""
    table, device = trainer.table, trainer.device
    row = table.lr_row(trainer.lrs(trainer.step + 1), trainer.step + 1, trainer.config.optimizer.head_lrs)
    lrs, going = torch.tensor(row, device=device), torch.zeros(1, dtype=torch.int32, device=device)
    gradients = {name: torch.zeros_like(p) for name, p in table.params.items()}
    # leaves of their own: a live graph of the table's parameters would tie a captured step to this stream
    parameters = {name: p.detach().requires_grad_() for name, p in table.gaussians.tensors().items()}
    return trainer.views[0], parameters, lambda: table.adam_step(gradients, lrs, going)


class Steps:
    """Training steps of given Gaussians on one image: image, L1 and SSIM, backward pass, Adam, as a fit takes them."""

    def __init__(self, gaussians: Gaussians, camera: Camera, target: torch.Tensor, rule: str, lr: float | None = None):
        device = target.device
        self.lr, self.options = lr, RasterizeOptions(rule=rule, background=torch.zeros(3, device=device))
        self.table = Table.of_gaussians(gaussians, {})
        config = FitConfig()
        context = StrategyContext(
            config.groups(),
            None,
            self.table,
            torch.Generator(),
            0,
            plan_phases(config.phases, MAX_STEPS),
            1.0,
            rule,
            self.options.background,
        )
        strategy = Strategy(context)  # of the base class: it changes nothing
        cameras = torch.zeros(1, 3, device=device), torch.zeros(1, 9, device=device)
        self.taker = StepTaker(self.table, LearnedViews((), (), device), strategy, cameras, self.options)
        self.buffers = self.taker.buffers
        self.views = ViewStack(camera, target[None], None, {}, torch.zeros(1, dtype=torch.int64, device=device))
        self.taker.stacks, self.taker.captured = {KIND: self.views}, True
        self.plan = StepPlan(gaussians.sh_degree, False, tuple(built_in_terms(LossConfig())), None)
        self._load(range(1, (MAX_STEPS if device.type == "cuda" else 1) + 1))

    def _load(self, steps: range) -> None:
        config = OptimizerConfig()
        fixed = None if self.lr is None else dict.fromkeys(self.table.params, self.lr)
        lrs, heads = (config.lrs(0.0, 1.0), config.head_lrs) if fixed is None else (fixed, {})
        rows = [self.table.lr_row(lrs, k, heads) for k in steps]
        settings = [Setting.row(dropout=0.0, number=k, step=k, means_lr=lrs["means"], shift=(0.0, 0.0, 0.0)) for k in steps]
        self.buffers.load([0] * len(steps), rows, settings)

    def eager(self) -> None:
        """Take the first step of a batch from Python, again and again: the same work each time."""
        self.buffers.counter.zero_()
        self.taker.step(self.views, self.buffers, self.plan, eager_renderer(self.options, None))

    def replay(self) -> None:
        """Take the first step of a batch as a CUDA graph, again and again; captured at the first call."""
        replay = self.taker.works(self.taker.step, [KIND], self.buffers, self.plan)[0]
        self.buffers.counter.zero_()
        replay()
