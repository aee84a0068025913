"""The interface of a strategy, and what a strategy sees of a step."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, NamedTuple, TypeVar

import torch

from warpgs.device import Needs, StepSizes
from warpgs.pipeline.model.table import Column, DensityUpdate, Table
from warpgs.pipeline.train.schedule import Phases
from warpgs.pipeline.train.views import TrainingView
from warpgs.plugins import Registry, returned
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Gaussians, Prior, Tensors
from warpgs.schema import anything

T = TypeVar("T")


class Settings:
    """Groups of the settings of a fit, indexed by their class."""

    def __init__(self, groups: Iterable[object]):
        """Keep the groups, one of each class."""
        self._groups: dict[type, Any] = {type(group): group for group in groups}

    def __getitem__(self, kind: type[T]) -> T:
        """Return the group of a class."""
        group: T = self._groups[kind]
        return group


class Growth(NamedTuple):
    """Times at which a strategy adds Gaussians, in steps done."""

    begins: int
    """Step before which no Gaussians are added."""
    ends: int
    """Step after which no Gaussians are added."""
    events: tuple[int, ...] = ()
    """Steps, ascending, at which many Gaussians are added at once. Early stopping measures the model right before them. Empty
    if early stopping may measure at any step."""

    def due(self, step: int, every: int) -> bool:
        """Return whether growth at all multiples of ``every`` adds Gaussians after a step."""
        return self.begins < step <= self.ends and step % every == 0


@dataclass
class StrategyContext:
    """Parts of a fit for a strategy. The trainer keeps them up to date.

    A strategy may write to columns of the table and take random numbers from the generator. All else is read-only.
    """

    settings: Settings
    """Settings of the fit by group."""
    own: Any
    """Settings of the strategy (its ``Config``); None for the defaults."""
    table: Table
    """The Gaussians, with the strategy's columns."""
    generator: torch.Generator
    """Generator of the fit, on the CPU, so that random numbers are the same on every device."""
    seed: int
    """Seed of the fit."""
    phases: Phases
    """Current phases of the fit; early stopping may change them."""
    extent: float
    """Size of the scene [u]."""
    rule: str
    """Cut-offs of the rasterizer."""
    background: torch.Tensor
    """Colour behind the scene, shape [3]."""
    priors: list[Prior] = field(default_factory=list)
    """Prior of each training view; empty if the fit needs none (`Strategy.needs_priors`)."""
    views: list[TrainingView] = field(default_factory=list)
    """Training views; empty before `Strategy.setup`."""
    capacity: int = 0
    """Number of Gaussians that settings and memory limit allow, which no update may exceed; 0 before `Strategy.setup`."""
    max_instances: int | None = None
    """Largest number of (Gaussian, tile) instances of a render at a time; None for no limit."""
    antialiased: bool = False
    """True in an antialiased fit (`RasterizeOptions.antialiased`)."""

    @property
    def gaussians(self) -> Gaussians:
        """The current Gaussians, detached."""
        return Gaussians(**{n: t.detach() for n, t in self.table.params.items()})

    @property
    def device(self) -> torch.device:
        """Device of the fit."""
        return self.table.device

    @property
    def steps(self) -> int:
        """Steps of the fit."""
        return self.phases.steps

    def render_options(self) -> RasterizeOptions:
        """Return the settings for rendering whole training views with all harmonics."""
        return RasterizeOptions(
            rule=self.rule, background=self.background, max_instances=self.max_instances, antialiased=self.antialiased
        )


class Strategy:
    """Rules by which Gaussians are added, moved and removed.

    To write a strategy, derive a class and override the methods that it needs. For each step the trainer calls `phase` on the
    host. As part of the step it then calls `statistics` for each view, `lr_factors` and `after_step`. After the step it calls
    `due` on the host and, if the result is True, `update`.

    The methods that are part of a step are captured once as a CUDA graph and replayed. So they must not read back from the
    device, must write their results into existing tensors, and may depend on the host only through `phase`.
    """

    name: ClassVar[str] = ""
    """Name in the registry."""
    Config: ClassVar[type | None] = None
    """Frozen dataclass of the strategy's settings; None without settings. They become flags, grouped under the strategy's
    name."""
    samples: ClassVar[bool] = False
    """True for a strategy that places Gaussians behind pixels, which needs consistent depth."""
    STATE: ClassVar[staticmethod[[Any, str], None]] = staticmethod(anything)
    """Schema (`warpgs.train.state_schema`) of the plain values that `state` returns; checked before `load`."""

    def __init__(self, context: StrategyContext):
        """Keep the context, which the strategy works with; nothing is trained yet.

        Args:
            context: Parts of the fit. The table exists, without columns; the views do not exist yet (see `setup`).
        """
        self.context = context
        self.config: Any = self.Config() if context.own is None and self.Config is not None else context.own
        """The strategy's own settings."""

    @classmethod
    def needs_priors(cls, own: Any) -> bool:
        """Return whether the strategy reads the priors of the views, by its own settings (its ``Config``)."""
        return False

    @classmethod
    def warmup_config(cls, own: Any) -> Any:
        """Return the strategy's settings for a warmup of three steps, which should run each part of a fit once."""
        return own

    def bytes(self, sizes: StepSizes) -> Needs:
        """Return the bytes that the strategy needs at the moments of a step, or in an event; columns are not included."""
        return {}

    def columns(self) -> Mapping[str, Column]:
        """Return the columns that the strategy adds to the table, by name; checkpoints save them."""
        return {}

    def setup(self) -> None:
        """Set up the strategy; the table, the training views and the memory plan exist already."""

    def growth(self) -> Growth:
        """Return the times at which Gaussians are added, for early stopping; by default until phase 3 begins."""
        return Growth(self.context.phases.refine, self.context.phases.stable_start)

    def phase(self, step: int) -> Hashable:
        """Return a value that determines what the strategy does in a step; steps with equal values share a CUDA graph."""
        return None

    def regularisation(self, phase: Hashable, gaussians: Gaussians) -> torch.Tensor | None:
        """Return a term that is added to the loss of every step, shape []; None for no term.

        Args:
            phase: Result of `phase`.
            gaussians: The current Gaussians, which require gradients.
        """
        return None

    def lr_factors(self, phase: Hashable) -> torch.Tensor | None:
        """Return the fraction of its Adam step that each mean takes, shape [N]; None for 1."""
        return None

    def after_step(self, phase: Hashable, settings: torch.Tensor, going: torch.Tensor) -> None:
        """Change parameters or columns after the update of the parameters, within a step.

        Args:
            phase: Value of `phase` for the step.
            settings: Settings of the step, by the columns of `warpgs.train.Setting`, float32, shape [7].
            going: True if the step is taken, bool, shape [1]; if False, nothing may change.
        """

    def statistics(self, phase: Hashable, v_projected: torch.Tensor, visible: torch.Tensor, size: tuple[int, int]) -> Tensors:
        """Return the values that a view of a step adds to columns, by name of the column, shape [N] each.

        The values must depend on this view only, because other views of the step may be in other processes. They must be 0
        where ``visible`` is False, because gradients of a skipped step may be NaN.

        Args:
            phase: Value of `phase` for the step.
            v_projected: Gradient of the projected Gaussians, shape [1, N, 12]; the first two values belong to the mean [1/px].
            visible: Gaussians that touch a tile, bool, shape [1, N]; all False if the step is skipped.
            size: Width and height of the view [px].
        """
        return {}

    def before_steps(self, last: int) -> None:
        """Begin, on the host, what an update after the step ``last`` needs, while the device takes the steps up to it."""

    def due(self, step: int) -> bool:
        """Return whether `update` changes anything after a step; not called after early stopping has ended growth."""
        return False

    def update(self, step: int) -> Iterator[DensityUpdate]:
        """Yield changes of the Gaussians after a step; each is applied to the table before the next is requested."""
        return iter(())

    def prunes(self, step: int) -> bool:
        """Return whether `prune` removes Gaussians after a step, before or after the end of growth."""
        return False

    def prune(self, step: int) -> Iterator[DensityUpdate]:
        """Yield changes that only remove Gaussians, after those of `update` and `catch_up`."""
        return iter(())

    def catch_up(self, step: int, views: list[TrainingView], held: int) -> Iterator[DensityUpdate]:
        """Yield changes, when early stopping ends growth, for the pixels that early stopping held out.

        Args:
            step: Steps done.
            views: Training views, masked to these pixels.
            held: Number of these pixels, over all views.
        """
        return iter(())

    def state(self) -> tuple[dict[str, torch.Tensor], dict[str, Any]]:
        """Return tensors by name, of any shape [...], and plain values, with which the strategy resumes with the same bits.

        The table is saved by the trainer.
        """
        return {}, {}

    def load(self, tensors: Tensors, plain: dict[str, Any]) -> None:
        """Load what `state` returned."""


def changes_of(strategy: Strategy, method: str, changes: Any) -> Iterator[DensityUpdate]:
    """Yield the changes that a method of a strategy returned, each of them checked."""
    what = "an iterator of DensityUpdate, which yield makes"
    for change in returned(strategy, method, changes, Iterable, what):
        yield returned(strategy, method, change, DensityUpdate, what)


STRATEGIES: Registry[Strategy] = Registry("strategy", Strategy, __package__, "warpgs.pipeline.paper")
"""Strategies by name; those in the modules of this folder and of the paper's are built in."""
register = register_strategy = STRATEGIES.register
find_strategy = STRATEGIES.find
