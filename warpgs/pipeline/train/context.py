"""Parts of a fit that a density strategy works with, and the times at which it adds Gaussians."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypeVar

import torch

from warpgs.pipeline.model.table import Table
from warpgs.pipeline.train.schedule import Phases
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.options import RasterizeOptions
from warpgs.scene import Gaussians

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
    views: list[TrainingView] = field(default_factory=list)
    """Training views; empty before `Strategy.setup`."""
    capacity: int = 0
    """Number of Gaussians that settings and memory limit allow; 0 before `Strategy.setup`."""
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
