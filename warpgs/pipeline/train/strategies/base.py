"""Base class of density strategies, the one part of training that adds, moves and removes Gaussians."""

from __future__ import annotations

import weakref
from collections.abc import Hashable, Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import torch

from warpgs.pipeline.model.table import Column, DensityUpdate
from warpgs.pipeline.train.schedule import sh_degree
from warpgs.plugins import Registry
from warpgs.schema import anything

if TYPE_CHECKING:
    from warpgs.pipeline.train.config import FitConfig
    from warpgs.pipeline.train.trainer import Trainer
    from warpgs.pipeline.train.views import TrainingView
    from warpgs.scene import Gaussians


class Strategy:
    """Rules by which Gaussians are added, moved and removed.

    A strategy of your own is a class that derives from this one and overrides what it needs; nothing else has to change. The
    trainer calls, for each step: `phase` on the host; then, as part of the step, `statistics` for each of its views,
    `lr_factors` and `after_step`; then `due` and, where that is true, `update` on the host.

    What is part of a step is captured once as a CUDA graph and replayed, so it must not read back from the device, must write
    its results into tensors that are there already, and may depend on the host only by `phase`.
    """

    name: ClassVar[str] = ""
    """Name that it is registered by."""
    Config: ClassVar[type | None] = None
    """Frozen dataclass of its own settings, None for none. They become flags, grouped under the strategy's name."""
    STATE: ClassVar[staticmethod[[Any, str], None]] = staticmethod(anything)
    """Schema (`warpgs.schema`) of the plain values that `state` returns: `load` gets no others, whatever a file holds."""

    def __init__(self, trainer: Trainer):
        """Keep the trainer, whose table, views and settings the strategy works with; nothing is trained yet.

        Args:
            trainer: The trainer. Its table exists, its views do not: see `setup`.
        """
        # by proxy: with a cycle, a finished fit would keep its memory until Python looks for garbage
        self.trainer: Trainer = weakref.proxy(trainer)
        own = trainer.config.strategy_config
        self.config: Any = self.Config() if own is None and self.Config is not None else own
        """The strategy's own settings."""

    @classmethod
    def samples(cls, config: FitConfig) -> bool:
        """Return whether it samples by importance, for which views need priors and scores."""
        return False

    @classmethod
    def shrinks(cls, config: FitConfig) -> bool:
        """Return whether the model is made smaller by tries, for which the memory plan counts copies of it."""
        return False

    @classmethod
    def warmup_config(cls, own: Any) -> Any:
        """Return the own settings for a warm-up of three steps, in which everything that a fit uses should come once."""
        return own

    def columns(self) -> Mapping[str, Column]:
        """Return the columns that the strategy keeps of each Gaussian, by name; they are saved with every checkpoint."""
        return {}

    def setup(self) -> None:
        """Begin; the table, the training views and the memory plan exist by now."""

    def kept_views(self) -> Sequence[TrainingView]:
        """Return views that the strategy keeps beside those in training, whose memory counts."""
        return ()

    def phase(self, step: int) -> Hashable:
        """Return a value for what the strategy does in a step; steps of equal phases share a CUDA graph."""
        return None

    def sh_degree(self, step: int) -> int:
        """Return the spherical-harmonics degree in use at a step."""
        highest = self.trainer.config.init.max_sh_degree
        assert highest is not None  # `settings_by_views` has chosen
        return sh_degree(step, self.trainer.config.sh_every, highest)

    def dropout(self, step: int) -> float:
        """Return the probability that a Gaussian is hidden in a step, in [0, 1); asked only if `FitConfig.dropout` is not 0."""
        return self.trainer.dropout * self.trainer.progress(step)

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
            settings: Settings of the step, by the columns of `warpgs.kernels.step_buffers.Setting`, float32, shape [6].
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
        """Return whether `update` has anything to do after a step."""
        return False

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Yield changes of the set of Gaussians after a step; each has been applied to the table when the next is asked for."""
        return iter(())

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Return tensors by name, of any shape [...], and plain values from which the strategy continues with the same bits.

        The table is saved by the trainer.
        """
        return {}, {}

    def load(self, tensors: Mapping[str, torch.Tensor], plain: dict[str, Any]) -> None:
        """Load what `state` returned."""

    def figures(self) -> dict[str, Any]:
        """Return what the report says of the strategy, plain values for metrics.json."""
        return {}


STRATEGIES: Registry[Strategy] = Registry("strategy", Strategy, __package__)
"""Strategies by name; the modules of this folder are ours."""
register = STRATEGIES.register
find_strategy = STRATEGIES.find
