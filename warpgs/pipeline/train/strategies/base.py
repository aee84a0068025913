"""Base class of density strategies, the one part of training that adds, moves and removes Gaussians."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping
from typing import Any, ClassVar

import torch

from warpgs.pipeline.model.table import Column, DensityUpdate
from warpgs.pipeline.train.context import Growth, Settings, StrategyContext
from warpgs.pipeline.train.views import TrainingView
from warpgs.plugins import Registry
from warpgs.runtime.step_sizes import Needs, StepSizes
from warpgs.scene import Gaussians
from warpgs.schema import anything


class Strategy:
    """Rules by which Gaussians are added, moved and removed.

    A strategy of your own is a class that derives from this one and overrides what it needs; nothing else has to change. The
    trainer calls, for each step: `phase` on the host; then, as part of the step, `statistics` for each of its views,
    `lr_factors` and `after_step`; then `due` and, where that is true, `update` on the host.

    What is part of a step is captured once as a CUDA graph and replayed, so it must not read back from the device, must write
    its results into tensors that are there already, and may depend on the host only by `phase`.
    """

    name: ClassVar[str] = ""
    """Name in the registry."""
    Config: ClassVar[type | None] = None
    """Frozen dataclass of its own settings, None for none. They become flags, grouped under the strategy's name."""
    STATE: ClassVar[staticmethod[[Any, str], None]] = staticmethod(anything)
    """Schema (`warpgs.schema`) of the plain values that `state` returns: `load` gets no others, whatever a file holds."""

    def __init__(self, context: StrategyContext):
        """Keep the context, which the strategy works with; nothing is trained yet.

        Args:
            context: Parts of the fit. Its table exists, without columns, its views do not: see `setup`.
        """
        self.context = context
        self.config: Any = self.Config() if context.own is None and self.Config is not None else context.own
        """The strategy's own settings."""

    @classmethod
    def samples(cls, settings: Settings) -> bool:
        """Return whether it places Gaussians behind pixels, for which depths of views are compared; settings are the fit's."""
        return False

    @classmethod
    def needs_priors(cls, settings: Settings) -> bool:
        """Return whether it reads scores that priors of the views give; settings are those of the fit."""
        return False

    @classmethod
    def warmup_config(cls, own: Any) -> Any:
        """Return the own settings for a warm-up of three steps, in which everything that a fit uses should come once."""
        return own

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes that the strategy takes at the moments of a step, or in an event; columns are counted apart."""
        return {}

    def columns(self) -> Mapping[str, Column]:
        """Return the columns that the strategy keeps of each Gaussian, by name; they are saved with every checkpoint."""
        return {}

    def setup(self) -> None:
        """Begin; the table, the training views and the memory plan exist by now."""

    def growth(self) -> Growth:
        """Return when Gaussians are added, by which early stopping measures; up to phase 3 if not overridden."""
        return Growth(self.context.phases.refine, self.context.phases.stable_start)

    def phase(self, step: int) -> Hashable:
        """Return a value for what the strategy does in a step; steps of equal phases share a CUDA graph."""
        return None

    def regularisation(self, phase: Hashable, gaussians: Gaussians) -> torch.Tensor | None:
        """Return a term that is added to the loss of every step, shape []; None for none.

        Args:
            phase: Result of `phase`.
            gaussians: The current Gaussians, which require gradients.
        """
        return None

    def lr_factors(self, phase: Hashable) -> torch.Tensor | None:
        """Return the fraction of its step that each mean takes, shape [N]; None for all of it."""
        return None

    def after_step(self, phase: Hashable, settings: torch.Tensor, going: torch.Tensor) -> None:
        """Change parameters or columns after the update of the parameters, within a step.

        Args:
            phase: Value of `phase` for the step.
            settings: Settings of the step, by the columns of `warpgs.kernels.step_buffers.Setting`, float32, shape [7].
            going: Whether the step is taken, bool, shape [1]; where it is not, nothing may change.
        """

    def statistics(
        self, phase: Hashable, v_projected: torch.Tensor, visible: torch.Tensor, size: tuple[int, int]
    ) -> Mapping[str, torch.Tensor]:
        """Return what a view of a step adds to columns, by name of the column, shape [N] each.

        It depends on this view alone, as a step may have several, in other processes too, and it must be 0 where ``visible`` is
        False: gradients of a step that is not taken may be no numbers.

        Args:
            phase: Value of `phase` for the step.
            v_projected: Gradient of the projected Gaussians, shape [1, N, 12]; the first two are of the mean [1/px].
            visible: Gaussians that touch a tile, bool, shape [1, N]; none where the step is not taken.
            size: Width and height of the view [px].
        """
        return {}

    def due(self, step: int) -> bool:
        """Return whether `update` has anything to do after a step; not asked once early stopping has ended growth."""
        return False

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Yield changes of the set of Gaussians after a step; each has been applied to the table when the next is asked for."""
        return iter(())

    def catch_up(self, step: int, views: list[TrainingView], held: int) -> Iterator[DensityUpdate]:
        """Yield changes for pixels that early stopping has held out so far, when it ends growth.

        Args:
            step: Steps done.
            views: Training views, masked so that nothing but those pixels counts.
            held: Number of those pixels, over all views.
        """
        return iter(())

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Return tensors by name, of any shape [...], and plain values from which the strategy continues with the same bits.

        The table is saved by the trainer.
        """
        return {}, {}

    def load(self, tensors: Mapping[str, torch.Tensor], plain: dict[str, Any]) -> None:
        """Load what `state` returned."""


STRATEGIES: Registry[Strategy] = Registry("strategy", Strategy, __package__)
"""Strategies by name; the modules of this folder are ours."""
register = STRATEGIES.register
find_strategy = STRATEGIES.find
