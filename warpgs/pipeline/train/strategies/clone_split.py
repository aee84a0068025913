"""Clone, split and prune (Kerbl et al. 2023, section 5.2), without sampling."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from typing import Any

import torch

from warpgs import schema
from warpgs.pipeline.model.table import Column, DensityUpdate
from warpgs.pipeline.train.context import Growth, StrategyContext
from warpgs.pipeline.train.strategies.base import Strategy, register
from warpgs.pipeline.train.strategies.gradient_growth import GradientGrowth


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
        return Growth(self.gradients.times.after, self.gradients.times.until)

    def phase(self, step: int) -> Hashable:
        """Return whether gradients are gathered in a step."""
        return self.gradients.gathers(step)

    def statistics(
        self, phase: Hashable, v_projected: torch.Tensor, visible: torch.Tensor, size: tuple[int, int]
    ) -> Mapping[str, torch.Tensor]:
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

    def load(self, tensors: Mapping[str, torch.Tensor], plain: dict[str, Any]) -> None:
        """Load whether opacities were reset; ``tensors`` [...] are not read."""
        self.gradients.load(plain)
