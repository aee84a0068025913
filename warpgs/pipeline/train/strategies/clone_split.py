"""Clone and split: Gaussians grow where their screen gradients are large."""

import math
from collections.abc import Hashable, Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

import torch

from warpgs import geometry, schema
from warpgs.pipeline.model.table import Column, DensityUpdate
from warpgs.pipeline.train.schedule import PhaseConfig
from warpgs.pipeline.train.strategies.base import Growth, Strategy, StrategyContext, register
from warpgs.scene import Gaussians, Tensors
from warpgs.schema import Checked, Within

# Growth by gradient: clone, split and prune (Kerbl et al. 2023, section 5.2), as a part of strategies.

RESET_FREE_STEPS = 500
"""No opacities are reset in this number of steps before the last event: transparent Gaussians would stay transparent."""


CLONE_SIZE = 0.01
"""Gaussians smaller than this fraction of the scene's extent are cloned, larger ones split (Kerbl et al. 2023)."""
PRUNE_OPACITY = 0.005
"""Gaussians below this opacity are removed (Kerbl et al. 2023)."""


@dataclass(frozen=True)
class DensityConfig(Checked, group="density."):
    """Thresholds and times of densification."""

    start: Annotated[int, Within(0)] = 500
    """Steps before Gaussians are first added and removed; at most a quarter of the fit."""
    every: Annotated[int, Within(1)] = 100
    """Steps between events that add and remove Gaussians."""
    stop_fraction: Annotated[float, Within(0, 1)] = 0.5
    """Fraction of the fit after which no Gaussians are added or removed. In a fit with phases, the start of phase 3 counts
    instead."""
    gradient: Annotated[float, Within(0)] = 2e-4
    """Mean norm of the gradient of a projected mean, in half image widths and heights, above which a Gaussian is cloned or
    split."""
    prune_size: Annotated[float, Within(0)] = 0.1
    """Size above which Gaussians are removed after the first opacity reset, as a fraction of the scene's extent; none are
    removed if more than half are larger. 0 to disable."""
    reset_every: Annotated[int, Within(0)] = 0
    """Steps between opacity resets, 3000 in Kerbl et al. 2023; 0 for no resets. With few views the fit does not recover from a
    reset (docs/decisions/002-no-opacity-reset.md)."""
    reset_opacity: Annotated[float, Within(0, 1, "()")] = 0.01
    """Largest opacity after a reset."""


def _exp(x: torch.Tensor) -> torch.Tensor:
    """Return e^x computed in float64, since rounding in float32 depends on the processor (MKL)."""
    return x.double().exp().to(x.dtype)


def _split(gaussians: dict[str, torch.Tensor], ids: torch.Tensor, generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Return two children of each Gaussian, sampled from its own distribution and 1.6 times smaller (Kerbl et al. 2023)."""
    pair = ids.repeat(2)
    rows = {n: t[pair] for n, t in gaussians.items()}
    noise = torch.randn(len(pair), 3, generator=generator, dtype=torch.float32, device="cpu")
    noise = noise.to(ids.device) * _exp(rows["log_scales"])
    w, *vector = (rows["quats"] / rows["quats"].norm(dim=1, keepdim=True)).unbind(1)
    axis = torch.stack(vector, 1)
    cross = 2 * torch.linalg.cross(axis, noise)
    rows["means"] = rows["means"] + noise + w[:, None] * cross + torch.linalg.cross(axis, cross)
    rows["log_scales"] = rows["log_scales"] - math.log(1.6)
    return rows


def refine(
    gaussians: Gaussians, pull: torch.Tensor, config: DensityConfig, *, extent: float, capacity: int, after_reset: bool,
    generator: torch.Generator, growing: torch.Tensor | None = None, protected: torch.Tensor | None = None,
) -> DensityUpdate:  # fmt: skip
    """Clone small Gaussians and split large ones where the gradient of the mean is large; prune transparent and huge ones.

    ``pull`` [N] is the mean norm of the gradient of each projected mean, in half image widths and heights. Only ``growing``
    Gaussians [N] grow, up to ``capacity`` in all; ``protected`` ones [N] are not pruned. Huge ones are pruned only once
    opacities were reset. If all would be pruned, the most opaque one is kept. ``generator`` is on the CPU.
    """
    with torch.no_grad():
        tensors = {n: t.detach() for n, t in gaussians.tensors().items()}
        scales = _exp(tensors["log_scales"].amax(1))
        logits = tensors["logit_opacities"]  # the rounding of torch's sigmoid depends on the number of threads
        grows = pull > config.gradient
        if growing is not None:
            grows &= growing
            pull = torch.where(growing, pull, 0)
        free = max(0, capacity - len(gaussians))
        if int(grows.sum()) > free:
            grows = torch.zeros_like(grows).index_fill(0, torch.topk(pull, free).indices, True) & grows
        small = scales <= CLONE_SIZE * extent
        faint = ~(logits >= geometry.logit(PRUNE_OPACITY))
        if after_reset and config.prune_size > 0:
            huge = scales > config.prune_size * extent
            if 2 * int(huge.sum()) <= len(gaussians):  # else the extent itself is small, since the cameras stand close together
                faint |= huge
        if protected is not None:
            faint &= ~protected
        if len(gaussians) > 0 and bool(faint.all()):
            faint[logits.argmax()] = False
        cloned = torch.nonzero(grows & small & ~faint).squeeze(1)
        split = torch.nonzero(grows & ~small & ~faint).squeeze(1)
        remove = faint.clone()
        remove[split] = True
        children = _split(tensors, split, generator)
        added = {n: torch.cat([t[cloned], children[n]]) for n, t in tensors.items()}
        return DensityUpdate(torch.nonzero(~remove).squeeze(1), added, torch.cat([cloned, split.repeat(2)]))


class GradientGrowth:
    """Growth and pruning by the gradients of projected means, which are gathered in columns of the table."""

    STATE: ClassVar = {"was_reset": schema.flag}
    """Schema of the plain values of `state`, by name."""

    def __init__(self, context: StrategyContext):
        """Begin without gradients, and before the first opacity reset."""
        self.context, self.config = context, context.settings[DensityConfig]
        self.was_reset = False
        """True once opacities were reset, after which huge Gaussians are pruned."""

    @staticmethod
    def columns() -> dict[str, Column]:
        """Return the columns for each projected mean: the sum of its gradient norms, and the number of renders that show it."""
        return {"grad_sum": Column(0.0, inherited=False), "seen_count": Column(0.0, inherited=False)}

    def growth(self) -> Growth:
        """Return the times of refinement by the current phases: until the third phase, in a fit with phases."""
        c, phases, lengths = self.config, self.context.phases, self.context.settings[PhaseConfig]
        fraction = 1.0 if lengths.coarse + lengths.stable > 0 else c.stop_fraction
        return Growth(min(c.start, phases.planned // 4), min(int(fraction * phases.planned), phases.stable_start))

    def gathers(self, step: int) -> bool:
        """Return whether gradients are gathered in a step."""
        return step <= self.growth().ends

    def statistics(self, v_projected: torch.Tensor, visible: torch.Tensor, size: tuple[int, int]) -> dict[str, torch.Tensor]:
        """Return the norm of each projected mean's gradient, and 1 for each mean that the view sees, else 0, shape [N] each.

        The unit is half image widths and heights; arguments are those of `Strategy.statistics`.
        """
        # a product with a tensor of the two sizes would copy them to the device, which a captured step must not
        norms = torch.hypot(v_projected[..., 0] * (0.5 * size[0]), v_projected[..., 1] * (0.5 * size[1]))
        # not times visible: 0 times NaN is NaN
        return {"grad_sum": torch.where(visible, norms, 0).sum(0), "seen_count": visible.sum(0)}

    def refines(self, step: int) -> bool:
        """Return whether the set is refined after a step."""
        return self.growth().due(step, self.config.every)

    def resets(self, step: int) -> bool:
        """Return whether opacities are reset after a step."""
        every = self.config.reset_every
        return every > 0 and step <= self.growth().ends - RESET_FREE_STEPS and step % every == 0

    def due(self, step: int) -> bool:
        """Return whether the set is refined or opacities are reset after a step."""
        return self.refines(step) or self.resets(step)

    def refine(self, growing: torch.Tensor | None = None, protected: torch.Tensor | None = None) -> Iterator[DensityUpdate]:
        """Yield the change by `refine`, then order the Gaussians and reset the statistics."""
        t, columns = self.context, self.context.table.columns
        pull = columns["grad_sum"] / columns["seen_count"].clamp_min(1)
        yield refine(
            t.gaussians, pull, self.config, extent=t.extent, capacity=t.capacity, after_reset=self.was_reset,
            generator=t.generator, growing=growing, protected=protected,
        )  # fmt: skip
        t.table.sort_along_curve()  # docs/decisions/009-morton-order.md
        for name in self.columns():
            t.table.columns[name].zero_()

    def reset_opacities(self) -> None:
        """Lower every opacity to at most ``reset_opacity``."""
        self.context.table.reset_opacities(self.config.reset_opacity)
        self.was_reset = True

    def state(self) -> dict[str, Any]:
        """Return whether opacities were reset."""
        return {"was_reset": self.was_reset}

    def load(self, plain: Mapping[str, Any]) -> None:
        """Load what `state` returned."""
        self.was_reset = plain["was_reset"]


# Clone, split and prune (Kerbl et al. 2023, section 5.2), without sampling.


@register("clone_split")
class CloneSplit(Strategy):
    """Cloning and splitting by the gradient of projected means, pruning of transparent and huge Gaussians."""

    STATE = staticmethod(schema.fields(GradientGrowth.STATE))

    def __init__(self, context: StrategyContext):
        """Begin without statistics, and before the first opacity reset."""
        super().__init__(context)
        self.gradients = GradientGrowth(context)

    def columns(self) -> Mapping[str, Column]:
        """Return the columns in which gradients are gathered."""
        return self.gradients.columns()

    def growth(self) -> Growth:
        """Return the times of refinement."""
        return self.gradients.growth()

    def phase(self, step: int) -> Hashable:
        """Return whether gradients are gathered in a step."""
        return self.gradients.gathers(step)

    def statistics(self, phase: Hashable, v_projected: torch.Tensor, visible: torch.Tensor, size: tuple[int, int]) -> Tensors:
        """Return statistics of gradients, [N] each; ``v_projected`` has shape [1, N, 12], ``visible`` [1, N]."""
        return self.gradients.statistics(v_projected, visible, size) if phase else {}

    def due(self, step: int) -> bool:
        """Return whether the set is refined or opacities are reset after a step."""
        return self.gradients.due(step)

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Refine, then reset opacities, each if it is due."""
        if self.gradients.refines(step):
            yield from self.gradients.refine()
        if self.gradients.resets(step):
            self.gradients.reset_opacities()

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Return no tensors [...], and whether opacities were reset."""
        return {}, self.gradients.state()

    def load(self, tensors: Tensors, plain: dict[str, Any]) -> None:
        """Load whether opacities were reset; ``tensors`` [...] are not read."""
        self.gradients.load(plain)
