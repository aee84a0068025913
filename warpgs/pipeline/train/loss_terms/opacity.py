"""The opacity term, for images with an alpha channel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import torch

from warpgs.errors import UsageError
from warpgs.pipeline.train.loss import LossInputs, LossTerm, register, total
from warpgs.runtime.step_sizes import FLOAT, LOSS, Needs, StepSizes


@register("alpha")
@dataclass(frozen=True)
class AlphaDifference(LossTerm):
    """The weighted mean absolute difference of rendered and true opacity, 0 in views without an alpha channel."""

    needs_outputs: ClassVar[tuple[str, ...]] = ("alpha",)
    weight: float = 0.1
    """Weight of the term, in [0, 1000]."""

    def __post_init__(self) -> None:
        if not 0 <= self.weight <= 1000:
            raise UsageError(f"alpha: `weight` must be between 0 and 1000, not {self.weight}")

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes of the difference, its magnitude and its gradient."""
        return {LOSS: 3 * FLOAT * sizes.pixels}

    def __call__(self, inputs: LossInputs) -> torch.Tensor:
        """Compute ``weight`` times the mean absolute difference of opacities over the unmasked pixels, shape []."""
        alpha, target = inputs.outputs["alpha"], inputs.target
        if target.alpha is None:
            return alpha.new_zeros(())
        difference = (alpha - target.alpha).abs()
        if target.mask is None:
            return total(difference) * (self.weight / target.alpha.numel())
        return total(difference * target.mask) / target.mask.sum().clamp_min(1) * self.weight
