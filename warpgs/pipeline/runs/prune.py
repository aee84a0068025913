"""Pruning of a finished model: Gaussians and harmonics that its training views do not need are removed (docs/decisions/020)."""

from __future__ import annotations

import dataclasses
import itertools
import math
import os
import shlex
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgs.errors import DataError, UsageError
from warpgs.export.ply import write_ply
from warpgs.files import filling, write_json
from warpgs.pipeline.metrics.evaluate import render_view, to_8_bit
from warpgs.pipeline.metrics.psnr import psnr
from warpgs.pipeline.metrics.region import scored_region
from warpgs.pipeline.model import compress
from warpgs.pipeline.model.sh_degrees import model_bytes, pack
from warpgs.pipeline.runs.checkpoint import save_checkpoint
from warpgs.pipeline.runs.commands import scene_of
from warpgs.pipeline.runs.folder import CONFIG, StoredRun, camera_values, open_run
from warpgs.pipeline.runs.request import choose_device
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.options import RasterizeOptions
from warpgs.runtime.byte_units import format_bytes
from warpgs.runtime.folder_lock import hold_folder
from warpgs.scene import Gaussians, Normalization, View


def mean_psnr(gaussians: Gaussians, views: list[View], options: RasterizeOptions) -> float:
    """Return the mean PSNR [dB] over views as in `warpgs eval`: rounded to 8 bits, over scored pixels; NaN without views."""
    if not views:
        return math.nan
    scores = []
    for v in views:
        image = to_8_bit(render_view(gaussians, v, options)[0])
        scores.append(psnr(image, to_8_bit(v.image), scored_region(v)[0]))
    return float(np.mean(scores))


def _new_folder(folder: Path, out: Path | None) -> Path:
    """Return the folder to write; UsageError if it exists already or cannot be made."""
    out = folder.resolve().with_name(f"{folder.resolve().name}-pruned") if out is None else out
    if os.path.exists(out):
        raise UsageError(f"{out} exists already; choose another --out")
    if not os.path.isdir(out.parent):
        raise UsageError(f"{out.parent} is not a folder; create it, or choose another --out")
    return out


def _write(out: Path, record: dict[str, Any], made: compress.Pruned, step: int, normalization: Normalization) -> list[str]:
    """Write the new run folder atomically; returns notes for the user."""
    tensors = {f"params.{n}": t for n, t in made.gaussians.tensors().items() if n != "sh"}
    tensors |= {"params.sh_packed": pack(made.gaussians.sh, made.degrees), "degrees": made.degrees}
    with hold_folder(out.parent) as notes:
        _new_folder(out, out)  # another process may have made it before this one held the folder above
        with filling(out) as temporary:
            write_json(temporary / CONFIG, record)
            save_checkpoint(temporary, tensors, {"step": step})
            antialiased = record["config"].get("antialiased", False)
            write_ply(temporary / "point_cloud.ply", made.gaussians, normalization, antialiased=antialiased)
    return notes


def prune(
    folder: Path, keep_psnr: float, out: Path | None, device_name: str, reader: str | None = None,
    tell: Callable[[str], object] = lambda line: None,
) -> list[str]:  # fmt: skip
    """Shrink a run's model so that the mean PSNR over its training views falls by no more than ``keep_psnr`` [dB].

    The new folder has config.json, a checkpoint with each Gaussian's own degree, and the PLY file; `warpgs eval`, `render` and
    `export` accept the new folder like the original run.

    Args:
        folder: The run folder, which is not changed.
        keep_psnr: Allowed loss [dB], above 0.
        out: Folder to write; None for the run's name with ``-pruned``.
        device_name: auto, cpu or cuda.
        reader: User-defined reader, as given to `warpgs fit --reader`.
        tell: Called with a line for the user about the current work.

    Returns:
        Lines for the user.

    Raises:
        DataError: The folder is not a run, its scene is gone, the scene's data have changed since the fit, or the training PSNR
            is not finite.
        ResourceError: The new folder cannot be written, or the device is missing.
        UsageError: ``keep_psnr`` is not above 0, or the new folder exists.
    """
    if not 0 < keep_psnr < math.inf:
        raise UsageError(f"--keep-psnr must be above 0 dB, not {keep_psnr}; a loss of 0.1 dB is invisible")
    device, _ = choose_device(device_name)
    stored = open_run(folder, device)
    out = _new_folder(folder, out)
    _, train, test = scene_of(stored, reader, tell)
    before, options = stored.gaussians(), stored.options()
    tell("ranking Gaussians")
    made = _pruned(stored, train, options, keep_psnr, tell)
    tell("scoring the smaller model")

    degrees = compress.stored_degrees(before.sh)
    sizes = [model_bytes(d) for d in (degrees, made.degrees)]
    scores = [(mean_psnr(before, v, options), mean_psnr(made.gaussians, v, options)) for v in (train, test)]
    figures: dict[str, Any] = {
        "source": str(folder.resolve()), "keep_psnr": keep_psnr, "count": [len(before), len(made.degrees)], "bytes": sizes,
        "mean_degree": [float(d.double().mean()) for d in (degrees, made.degrees)],
        "train_psnr": scores[0], "test_psnr": scores[1] if test else None,
    }  # fmt: skip
    # the new checkpoint has no increments of poses: its record holds the cameras after them
    record = stored.record | {"pruned": figures, "cameras": {n: camera_values(c) for n, c in stored.scene_cameras.items()}}
    notes = _write(out, record, made, stored.step, stored.normalization)
    lines = [
        *stored.notes(),
        *notes,
        f"{len(before):,} -> {len(made.degrees):,} Gaussians, mean SH degree {figures['mean_degree'][0]:.2f} -> "
        f"{figures['mean_degree'][1]:.2f}",
        f"{format_bytes(sizes[0])} -> {format_bytes(sizes[1])} uncompressed, {sizes[0] / sizes[1]:.2f} times smaller",
        f"training PSNR {scores[0][0]:.2f} -> {scores[0][1]:.2f} dB over {len(train)} views",
    ]
    if test:
        lines.append(f"held-out PSNR {scores[1][0]:.2f} -> {scores[1][1]:.2f} dB over {len(test)} views")
    run = shlex.quote(str(out))
    return [*lines, f"in {out}: checkpoint, PLY; `warpgs eval {run}` scores it, `warpgs render {run}` renders it"]


def _pruned(
    stored: StoredRun, train: list[View], options: RasterizeOptions, keep_psnr: float, tell: Callable[[str], object]
) -> compress.Pruned:
    """Prune the model of a run; DataError if its PSNR on the training views is not finite."""
    before = stored.gaussians()
    device = before.means.device
    whole = mean_psnr(before, train, options)
    if not math.isfinite(whole):
        raise DataError(f"{stored.folder}: training PSNR is {whole} dB, so its loss cannot be limited; fit again")
    kinds = torch.zeros(len(before), dtype=torch.int64, device=device)
    view_set = compress.ViewSet([TrainingView.of(v, device).camera for v in train], options, stored.record["config"]["seed"])
    tried = itertools.count(1)

    def accepted(gaussians: Gaussians, fraction: float) -> bool:
        tell(f"trying smaller models: number {next(tried)}, {len(gaussians):,} Gaussians")
        return mean_psnr(gaussians, train, options) >= whole - fraction * keep_psnr

    made = compress.prune_model(before, kinds, view_set, accepted)
    return dataclasses.replace(made, gaussians=compress.drop_unused_sh(made.gaussians))
