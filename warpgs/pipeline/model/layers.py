"""The two layers of the hierarchy: which Gaussians are coarse and which fine, how old they are, and what protects them.

Paper, sections "Hierarchical Gaussian Representation" and "Geometric-Aware Sampling" (protection mechanism).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch

from warpgs.errors import UsageError
from warpgs.pipeline.train.strategies.clone_split import DensityUpdate

COARSE, FINE = 0, 1
NOT_SAMPLED = -(2**30)
"""Step of birth of what was never new: the coarse layer."""


@dataclass(frozen=True)
class ProtectConfig:
    """How long and how well new Gaussians are protected."""

    steps: int = 500
    """Age [steps] up to which a sampled Gaussian is protected (T_protect, which the paper leaves open): five refinements."""
    opacity: float = 0.05
    """Its opacity does not fall below this meanwhile (alpha_minimum): ten times what is pruned."""

    def __post_init__(self):
        if self.steps < 0 or not 0 < self.opacity < 1:
            raise UsageError("protect: steps must be at least 0 and opacity lie in (0, 1)")

    @property
    def logit(self) -> float:
        """The least opacity as it is stored."""
        return math.log(self.opacity / (1 - self.opacity))


class Layers:
    """Layer and birth of every Gaussian, row by row in step with the optimizer."""

    def __init__(self, count: int, device: torch.device):
        self.level = torch.zeros(count, dtype=torch.int32, device=device)
        """COARSE or FINE, shape [N]."""
        self.created_step = torch.full((count,), NOT_SAMPLED, dtype=torch.int32, device=device)
        """Step after which a sampled Gaussian was added; what grew from it has the same. Shape [N]."""

    @property
    def fine(self) -> torch.Tensor:
        """True for fine Gaussians, shape [N]."""
        return self.level == FINE

    def is_protected(self, step: int | torch.Tensor, config: ProtectConfig) -> torch.Tensor:
        """True for Gaussians that are protected at a step, shape [N]."""
        return step - self.created_step <= config.steps

    def clamp_min_opacity(
        self, logits: torch.Tensor, step: int | torch.Tensor, config: ProtectConfig, going: torch.Tensor | bool = True
    ) -> None:
        """Raise the opacity logits [N] of the young to the least value, in place: alpha = max(alpha, alpha_minimum).

        Nothing changes where ``going`` (bool, shape [1]) is False.
        """
        logits.copy_(torch.where(self.is_protected(step, config) & going, logits.clamp_min(config.logit), logits))

    def apply(self, change: DensityUpdate, *, level: int = COARSE, created_step: int = NOT_SAMPLED) -> None:
        """Follow a change of the set: rows that grew from another are as it is, others as named."""
        for name, fresh in (("level", level), ("created_step", created_step)):
            old = getattr(self, name)
            grown = (
                torch.where(change.parents >= 0, old[change.parents.clamp_min(0)], fresh) if len(change.parents) else old[:0]
            )
            setattr(self, name, torch.cat([old[change.keep], grown.to(old.dtype)]))

    def reorder(self, order: torch.Tensor) -> None:
        """Row i becomes what row ``order[i]`` was."""
        self.level, self.created_step = self.level[order], self.created_step[order]

    def state(self) -> dict[str, torch.Tensor]:
        """Both by name, for the checkpoint."""
        return {"layers.level": self.level, "layers.created_step": self.created_step}

    def load(self, state: dict[str, torch.Tensor]) -> None:
        """Take over what `state` gave."""
        self.level = state["layers.level"].to(self.level.device)
        self.created_step = state["layers.created_step"].to(self.created_step.device)
