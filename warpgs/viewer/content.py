"""Contents of the viewer: a model, with its known cameras, photographs and layers."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from warpgs.coordinates import convert_gaussians
from warpgs.errors import DataError, WarpgsError
from warpgs.export.formats import read_with_antialiasing
from warpgs.pipeline.model.model_file import FittedModel
from warpgs.pipeline.runs.checkpoint import TENSORS, load_checkpoint
from warpgs.pipeline.runs.commands import scene_of
from warpgs.pipeline.runs.folder import StoredRun, open_run
from warpgs.pipeline.runs.model_and_cameras import RULE
from warpgs.pipeline.train.strategies.sampling_event import FINE
from warpgs.scene import Normalization, View


@dataclass(frozen=True)
class Content:
    """A model and its description."""

    title: str
    """Name to show: the name of the folder or the file."""
    model: FittedModel
    """Gaussians, cameras by name, background and rule; without cameras where a file has none."""
    stem: Path
    """Beginning of the paths of files that are saved from the viewer: RUN for RUN/crop.json, x for x-crop.json beside x.ply."""
    fine: torch.Tensor | None = None
    """True for Gaussians of the fine layer, bool, shape [N]; None without layers."""
    views: Mapping[str, View] = field(default_factory=dict)
    """Views by name, with their photographs; empty if the scene cannot be read."""
    sheet: Path | None = None
    """PNG that shows where fine Gaussians were placed, or None."""

    def saved(self, name: str) -> Path:
        """Return the path of a file that is saved from the viewer."""
        return self.stem / name if self.stem.is_dir() else self.stem.with_name(f"{self.stem.name}-{name}")


def content_of_run(folder: Path, device: str = "cpu", views: Mapping[str, View] | None = None) -> Content:
    """Read a run, finished or still going.

    Args:
        folder: The run folder.
        device: auto, cpu or cuda.
        views: Views that were read before, by name.

    Raises:
        DataError: The folder is not a run, or it holds no checkpoint yet.
    """
    run = open_run(folder, device)
    level = load_checkpoint(folder)[0].get("columns.level")
    # a fit that continues may have written another checkpoint in between
    fine = level == FINE if level is not None and level.shape == (len(run.gaussians()),) else None
    sheets = sorted((folder / "sampling").glob("*.png"))
    return Content(
        folder.resolve().name, run, folder, None if fine is None else fine.to(run.gaussians().means.device), views or {},
        sheets[-1] if sheets else None,
    )  # fmt: skip


def views_of(content: Content, reader: str | None = None) -> tuple[dict[str, View], list[str]]:
    """Return the views of a run's scene by name, and notes for the user where they cannot be read."""
    if not isinstance(content.model, StoredRun):
        return {}, []
    try:
        _, train, test = scene_of(content.model, reader)
    except WarpgsError as e:
        return {}, [f"cameras are shown without photographs, since the scene cannot be read: {e}"]
    return {v.name: v for v in [*train, *test]}, []


def content_of_file(path: Path, device: str = "cpu") -> Content:
    """Read a file of Gaussians of any format; it is centred and scaled for the viewer.

    Raises:
        DataError: The file holds no Gaussians.
    """
    stored, antialiased = read_with_antialiasing(path, None, "file")
    if not len(stored):
        raise DataError(f"{path}: contains no Gaussians; export the model again")
    means = stored.means.double().numpy()
    low, high = np.percentile(means, [5, 95], axis=0)
    normalization = Normalization((low + high) / 2, 1 / max(0.5 * float(np.linalg.norm(high - low)), 1e-12))
    gaussians = convert_gaussians(stored, normalization, "file", "scene")
    gaussians = dataclasses.replace(gaussians, **{n: t.to(device) for n, t in gaussians.tensors().items()})
    model = FittedModel(gaussians, normalization, {}, (), (), RULE, (0.0, 0.0, 0.0), 0, antialiased=antialiased)
    return Content(path.name, model, path.with_suffix(""))


def modified(folder: Path) -> float | None:
    """Return when the last checkpoint of a run was written [s]; None without one."""
    try:
        return (folder / TENSORS).stat().st_mtime
    except OSError:
        return None
