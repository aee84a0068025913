"""Plots of a run: its cameras with its Gaussians or the reconstruction's points, in their own colours or by coverage."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from warpgs.colors import base_colors
from warpgs.errors import DataError, UsageError
from warpgs.files import write_bytes
from warpgs.geometry import rotation_matrices
from warpgs.pipeline.films.plan import depth_and_coverage
from warpgs.pipeline.films.rig import Rig, rig_of
from warpgs.pipeline.model.coverage import coverage
from warpgs.pipeline.runs.commands import scene_of
from warpgs.pipeline.runs.folder import StoredRun, open_run
from warpgs.report.progress import waiting
from warpgs.report.scene_plot import ScenePlot, render_plot
from warpgs.runtime.folder_lock import hold_file
from warpgs.scene import Camera

PLOT = "plot.png"
POINTS, COLORS, BACKGROUNDS = ("gaussians", "start"), ("own", "coverage"), ("white", "black")
SIZES = (64, 8192)
"""Smallest and largest side of a plot [px]."""
MIN_OPACITY = 0.1
"""Least opacity of a Gaussian that is shown: fainter ones are invisible."""
MAX_POINTS = {"gaussians": 50_000, "start": 300_000}
"""Largest number of Gaussians and of points shown; larger sets are sampled at random."""
CLASSES = (
    (0, "seen by no training view", "#d6219c"), (1, "by 1", "#f0a020"), (2, "by 2", "#a6bf3a"), (3, "by 3 to 5", "#2fa37c"),
    (6, "by 6 and more", "#2878b5"),
)  # fmt: skip
"""Least number of training views, description and colour of each class of coverage."""


@dataclass(frozen=True)
class PlotSettings:
    """Settings of a plot."""

    points: str = "gaussians"
    """Points shown: gaussians, or start (the points of the scene's reconstruction)."""
    color: str = "own"
    """Colour of the points: own, or coverage (how many training views see a Gaussian)."""
    background: str = "white"
    """Background: white or black."""
    size: tuple[int, int] = (1600, 1000)
    """Width and height [px]."""
    cameras: bool = True
    """True to show cameras."""

    def __post_init__(self) -> None:
        """Check what can be checked before any work.

        Raises:
            UsageError: A value is not one of the choices.
        """
        for flag, value, known in (
            ("--points", self.points, POINTS), ("--color", self.color, COLORS), ("--background", self.background, BACKGROUNDS),
        ):  # fmt: skip
            if value not in known:
                raise UsageError(f"{flag} {value}: give one of {', '.join(known)}")
        if not all(SIZES[0] <= s <= SIZES[1] for s in self.size):
            raise UsageError(f"--size {self.size[0]} {self.size[1]}: each side must have {SIZES[0]} to {SIZES[1]} px")
        if self.points == "start" and self.color == "coverage":
            raise UsageError("--color coverage needs Gaussians; leave out --points start")


def _gaussians(stored: StoredRun, train: list[Camera], by_coverage: bool) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return positions [N, 3], colours [N, 3] and axes [N, 3, 3] of the Gaussians that can be seen."""
    gaussians = stored.gaussians()
    shown = (torch.sigmoid(gaussians.logit_opacities) >= MIN_OPACITY).cpu()
    if not by_coverage:
        colors = np.clip(base_colors(gaussians.sh[:, :1].cpu().numpy()), 0, 1)
    else:
        tensors = [replace(c, viewmat=gaussians.means.new_tensor(c.viewmat), K=gaussians.means.new_tensor(c.K)) for c in train]
        views = coverage(gaussians, tensors, stored.options()).views.cpu().numpy()
        lowest, palette = np.array([c[0] for c in CLASSES]), [c[2] for c in CLASSES]
        values = np.array([[int(c[i : i + 2], 16) / 255 for i in (1, 3, 5)] for c in palette])
        colors = values[np.searchsorted(lowest, views, side="right") - 1]
    means, quats, log_scales = (t.detach().cpu().double() for t in (gaussians.means, gaussians.quats, gaussians.log_scales))
    rotations = rotation_matrices(torch.nn.functional.normalize(quats[shown], dim=1).numpy())
    return means[shown].numpy(), colors[shown.numpy()], rotations * np.exp(log_scales[shown].numpy())[:, None]


def _start(stored: StoredRun) -> tuple[np.ndarray, np.ndarray, None]:
    """Return positions [N, 3] and colours [N, 3] of the points of the scene's reconstruction."""
    scene, _, _ = scene_of(stored)
    if scene.points is None or not len(scene.points):
        raise DataError(f"{scene.path}: its format ({scene.format}) has no points; leave out --points start")
    return scene.points.points, scene.points.colors, None


def _eye(rig: Rig) -> np.ndarray:
    """Return the direction [3] from the scene to the viewer: from above at an angle, behind cameras that look to one side."""
    azimuth = 0.0 if rig.span is None else 0.5 * (rig.span[0] + rig.span[1])
    return rig.direction(azimuth + 0.7, max(rig.elevation + 0.35, 0.5))


def plot(folder: Path, out: Path | None, settings: PlotSettings, device_name: str = "auto") -> list[str]:
    """Write a plot of a run as PNG; returns lines for the user.

    Args:
        folder: The run folder.
        out: File to write, .png; None for plot.png in the run folder.
        settings: Settings of the plot.
        device_name: auto, cpu or cuda.

    Raises:
        DataError: The folder is not a run, or the scene has no points to show.
        ResourceError: This machine cannot render, or the file cannot be written.
        UsageError: The file is not a .png file.
    """
    out = folder / PLOT if out is None else out
    if out.suffix.lower() != ".png":
        raise UsageError(f"{out}: a plot is a .png file; give a name that ends in .png")
    stored, tell = open_run(folder, device_name), waiting()
    tell("rendering depth")
    cameras = stored.cameras()
    train, test = ([cameras[n] for n in names] for names in (stored.train, stored.test))
    depth, _ = depth_and_coverage(stored.gaussians(), train, stored.options())
    rig = rig_of(train, depth)
    by_coverage = settings.color == "coverage"
    points, colors, axes = _start(stored) if settings.points == "start" else _gaussians(stored, train, by_coverage)
    if not len(points):
        raise DataError(f"{folder}: no Gaussian has an opacity of {MIN_OPACITY} or more; there is nothing to show")
    most = MAX_POINTS[settings.points]
    notes = stored.notes() + ([] if len(points) <= most else [f"showing a random sample of {most:,} of {len(points):,}"])
    chosen = np.sort(np.random.default_rng(0).permutation(len(points))[:most])
    shown = (train, test) if settings.cameras else ([], [])
    legend = [(words, color) for _, words, color in CLASSES] if by_coverage else []
    axes = None if axes is None else axes[chosen]
    contents = ScenePlot(points[chosen], colors[chosen], axes, *shown, rig.up, _eye(rig), legend)
    with hold_file(out) as held:
        tell("rendering the plot")
        write_bytes(out, render_plot(contents, settings.size, settings.background))
    faint = f"Gaussians of opacity {MIN_OPACITY:g} or more"
    what = "points of the reconstruction" if settings.points == "start" else faint
    return [*held, *notes, f"{len(points):,} {what}, {len(train)} training and {len(test)} held-out cameras in {out}"]
