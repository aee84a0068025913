"""PSNR of Gaussians from files at the held-out views of a run, compared with that of the run's own model."""

from __future__ import annotations

from pathlib import Path

from warpgs.geometry import convert_gaussians
from warpgs.pipeline.metrics.scores import Renders
from warpgs.pipeline.run.commands import scene_of
from warpgs.pipeline.run.folder import StoredRun, open_run
from warpgs.pipeline.run.results import evaluate_run
from warpgs.scene import Gaussians


class Scorer:
    """The held-out views of a run, and the PSNR of its own model on them."""

    def __init__(self, folder: Path) -> None:
        self.run: StoredRun = open_run(folder, "cpu")
        _, train, test = scene_of(self.run)
        self.views = (train, test)
        self.own = self._psnr(self.run.gaussians())

    def _psnr(self, gaussians: Gaussians) -> float:
        metrics = evaluate_run(None, Renders(gaussians, self.run.options()), *self.views)
        return float(metrics["test"]["psnr"])

    def loss(self, gaussians: Gaussians) -> float:
        """Return the loss of PSNR of Gaussians in file units, compared with the run's own model [dB]."""
        return self.own - self._psnr(convert_gaussians(gaussians, self.run.normalization, "file", "scene"))
