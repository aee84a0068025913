"""One fit in progress: its inputs, its state, and its messages to the user."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import torch

from warpgs.io.splits import Split
from warpgs.lenses import CENTRAL
from warpgs.pipeline.metrics.lpips import Lpips
from warpgs.pipeline.model.model_file import FittedModel
from warpgs.pipeline.runs.request import SceneRequest
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.loop import train_views
from warpgs.pipeline.train.step_report import StepReport
from warpgs.priors.photo_checks import PhotoCheck
from warpgs.runtime.ranks import Ranks
from warpgs.runtime.terminal import Detail, say
from warpgs.scene import Scene, View


@dataclass
class FitJob:
    """One fit in progress: its inputs and its state."""

    scene: Scene
    request: SceneRequest
    split: Split
    config: FitConfig
    device: torch.device
    where: str
    out: Path | None
    lpips: Lpips | None
    notes: list[str]
    verbose: bool | Literal["progress"]
    on_step: Callable[[StepReport], object] | None
    began: float
    progress: Callable[[str], object]
    on_model: Callable[[FittedModel], object] | None
    ranks: Ranks
    compiled: list[float]
    photographs: list[PhotoCheck] = field(default_factory=list)

    @property
    def train(self) -> list[View]:
        """Views to fit."""
        return train_views(self.scene, self.split.train)

    @property
    def test(self) -> list[View]:
        """Views held out."""
        return train_views(self.scene, self.split.test)

    @property
    def other_models(self) -> list[str]:
        """Camera models that have no pinhole of the same K; views with these models cannot be compared."""
        return sorted({v.camera.model for v in self.scene.views} - {*CENTRAL})

    def say(self, line: str) -> None:
        """Print a line for the user, unless the fit is silent or prints only progress."""
        if self.verbose is True:
            say(line)

    def note(self, line: str) -> None:
        """Keep a line for the report, and print it unless it is a detail."""
        self.notes.append(line)
        if not isinstance(line, Detail):
            self.say(f"  {line}")

    def announce(self, notes: list[str]) -> None:
        """Print the scene and all automatic choices so far, ``notes`` last."""
        before, self.notes = self.notes, []
        camera = self.train[0].camera
        size = f"{camera.width} x {camera.height} px"
        counts = f"{len(self.train)} views to fit, {len(self.test)} held out"
        self.say(f"{self.scene.path}: {self.scene.format}, {counts}, {size}, {self.where}")
        for note in [*before, *notes]:
            self.note(note)
