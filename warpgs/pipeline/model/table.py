"""Parameters of a fit with their Adam moments, kept row by row in step when Gaussians come and go."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from warpgs.errors import UsageError
from warpgs.kernels.adam import adam_scheduled, adam_step, scheduled_lrs
from warpgs.kernels.knn import morton_codes
from warpgs.pipeline.model.parameter_bounds import ParameterBounds
from warpgs.pipeline.train.schedule import log_linear
from warpgs.pipeline.train.strategies.clone_split import DensityUpdate
from warpgs.scene import Gaussians

MAX_LR = 1e6
"""No rate is higher: far above what trains, far below what overflows within a fit."""


@dataclass(frozen=True)
class OptimizerConfig:
    """Learning rates of the reference implementation of Kerbl et al. 2023, but for the scales."""

    means_lr: float = 1.6e-4
    """Of positions, times the scene's extent, at the start."""
    means_lr_final: float = 1.6e-6
    """The same at the last step; log-linear between."""
    quats_lr: float = 1e-3
    """Of rotations."""
    scales_lr: float = 0.01
    """Of log scales; 0.005 in the reference (docs/decisions/004-scale-rate.md)."""
    scales_decay: float = 1.0
    """Share of that rate which is left at the last step; log-linear from the beginning of phase 3, or of a fit without phases.
    1 keeps it as it is."""
    opacities_lr: float = 0.05
    """Of opacity logits."""
    sh_lr: float = 2.5e-3
    """Of the constant colour coefficient."""
    sh_rest_factor: float = 0.05
    """Share of that for the other coefficients."""

    def __post_init__(self):
        for name, value in vars(self).items():
            if not 0 < value <= MAX_LR:
                raise UsageError(f"optimizer {name} must be positive and at most {MAX_LR:g}, not {value}")


class Optimizer:
    """Adam over the five tensors of a set of Gaussians."""

    def __init__(self, gaussians: Gaussians, config: OptimizerConfig, extent: float, stable_start: float = 0.0):
        """Begin with zero moments; ``stable_start`` in [0, 1) is the share of the fit after which the rate of scales falls."""
        self.config, self.extent, self.stable_start = config, extent, stable_start
        self.params = {n: t.detach().clone().contiguous().requires_grad_() for n, t in gaussians.tensors().items()}
        self.means = {n: torch.zeros_like(t) for n, t in self.params.items()}
        self.squares = {n: torch.zeros_like(t) for n, t in self.params.items()}
        self.step_count = 0
        self.bounds: ParameterBounds | None = None
        """What parameters are held to after every step; None for nothing."""

    @property
    def gaussians(self) -> Gaussians:
        """The current parameters; they require gradients."""
        return Gaussians(**self.params)

    def lrs(self, progress: float) -> dict[str, float]:
        """Learning rate of each tensor at a share [0, 1] of the fit."""
        c = self.config
        settled = (progress - self.stable_start) / (1 - self.stable_start)
        return {
            "means": self.extent * log_linear(c.means_lr, c.means_lr_final, progress),
            "quats": c.quats_lr,
            "log_scales": log_linear(c.scales_lr, c.scales_lr * c.scales_decay, settled),
            "logit_opacities": c.opacities_lr,
            "sh": c.sh_lr * c.sh_rest_factor,
        }

    def step(self, progress: float, fraction: torch.Tensor | None = None) -> None:
        """Update all parameters from their gradients, which are then cleared.

        ``fraction`` [N]: the part of its step that each mean takes; None for all of it.
        """
        self.step_count += 1
        before = None if fraction is None else self.params["means"].detach().clone()
        for name, lr in self.lrs(progress).items():
            param = self.params[name]
            if param.grad is None:
                continue
            head = {"head": 3, "head_lr": self.config.sh_lr} if name == "sh" else {}
            state = (param.detach(), param.grad, self.means[name], self.squares[name])
            adam_step(*state, lr=lr, step=self.step_count, **head)
            param.grad = None
        self._hold_back(before, fraction)

    def _hold_back(self, before: torch.Tensor | None, fraction: torch.Tensor | None) -> None:
        """Take back a part of the last step of the means, whose size Adam makes independent of the gradient's; keep limits."""
        if fraction is not None:
            means = self.params["means"].detach()
            means.copy_(torch.where(fraction[:, None] == 1, means, before + fraction[:, None] * (means - before)))
        if self.bounds is not None:
            self.bounds.enforce(self.params)

    def schedule(self, progress: float, step: int) -> list[float]:
        """Numbers that `step_scheduled` reads from memory: three for each tensor, in order."""
        row = []
        for name, lr in self.lrs(progress).items():
            row += scheduled_lrs(lr, step, head_lr=self.config.sh_lr if name == "sh" else None)
        return row

    def step_scheduled(
        self, gradients: dict[str, torch.Tensor], lrs: torch.Tensor, skip: torch.Tensor, fraction: torch.Tensor | None = None
    ) -> None:
        """`step` on CUDA with a row [15] of `schedule` in memory; nothing changes where ``skip`` [1] is not 0."""
        before = None if fraction is None else self.params["means"].detach().clone()
        for i, (name, gradient) in enumerate(gradients.items()):
            state = (self.params[name].detach(), gradient, self.means[name], self.squares[name])
            adam_scheduled(*state, lrs[3 * i : 3 * i + 3], skip, head=3 if name == "sh" else 0)
        self._hold_back(before, fraction)

    def apply(self, change: DensityUpdate) -> None:
        """Keep the named rows with their moments and append new rows with zero moments."""
        for name in self.params:  # each old tensor is given up before the next is made
            added = change.added[name].to(self.params[name].dtype)
            self.params[name] = torch.cat([self.params[name].detach()[change.keep], added]).requires_grad_()
            for moments in (self.means, self.squares):
                moments[name] = torch.cat([moments[name][change.keep], torch.zeros_like(added)])
        if self.bounds is not None:
            self.bounds.apply(change)

    @torch.no_grad()
    def regroup(self, rows: Gaussians, into: torch.Tensor) -> None:
        """Replace the set by one whose Gaussians each stand for some of the old; what moves with them moves on as they did.

        First moments add up as the gradients do, second ones as if the gradients had all had one sign: a step is then rather
        too short than too long. Summed in float64 on the CPU, where the order is the same every time. Limits are the caller's.

        Args:
            rows: The new set, M rows.
            into: Row of the new set that each old one went into, -1 for none, int64, shape [N].
        """
        into = into.cpu()
        old = torch.nonzero(into >= 0).squeeze(1)
        for name, new in rows.tensors().items():
            for moments, power in ((self.means, 1.0), (self.squares, 0.5)):
                each = moments[name].double().cpu()[old] ** power
                total = each.new_zeros(new.shape).index_add_(0, into[old], each)
                moments[name] = (total ** (1 / power)).to(moments[name])
            self.params[name] = new.detach().to(self.params[name].dtype).contiguous().requires_grad_()

    @torch.no_grad()
    def sort_along_curve(self) -> torch.Tensor:
        """Put the Gaussians in Morton order, each with its moments, so that neighbours in space are neighbours in memory.

        Returns:
            The number that each row had before, int64, shape [N].
        """
        order = torch.argsort(morton_codes(self.params["means"].detach()), stable=True)
        self.reorder(order)
        return order

    @torch.no_grad()
    def reorder(self, order: torch.Tensor) -> None:
        """Row i becomes what row ``order[i]`` was, with its moments and limits."""
        for group in (self.params, self.means, self.squares):
            for name in group:
                group[name] = group[name].detach()[order]
        for param in self.params.values():
            param.requires_grad_()
        if self.bounds is not None:
            self.bounds.reorder(order)

    def cap_opacity(self, opacity: float) -> None:
        """Lower every opacity to at most this and forget the moments of all opacities (the classic reset)."""
        limit = math.log(opacity / (1 - opacity))  # in float64: the smallest float32 opacity would be 0
        self.params["logit_opacities"] = self.params["logit_opacities"].detach().clamp(max=limit).requires_grad_()
        self.means["logit_opacities"].zero_()
        self.squares["logit_opacities"].zero_()

    def state(self) -> dict[str, torch.Tensor]:
        """Everything that a continued fit needs, by flat names."""
        groups = (("param", self.params), ("mean", self.means), ("square", self.squares))
        tensors = {f"{kind}.{n}": t.detach() for kind, group in groups for n, t in group.items()}
        return tensors if self.bounds is None else tensors | self.bounds.state()

    def load(self, state: dict[str, torch.Tensor], step_count: int) -> None:
        """Take over what `state` gave."""
        device = next(iter(self.params.values())).device
        for kind, group in (("param", self.params), ("mean", self.means), ("square", self.squares)):
            for name in group:
                group[name] = state[f"{kind}.{name}"].to(device).contiguous()
        for name, t in self.params.items():
            self.params[name] = t.requires_grad_()
        self.step_count = step_count
        if self.bounds is not None:
            self.bounds.load(state)
