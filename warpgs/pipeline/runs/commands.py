"""Commands on an existing run: score it again, render it, export it."""

from __future__ import annotations

import contextlib
import math
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from warpgs.errors import DataError, UsageError, WarpgsError
from warpgs.files import write_json, writing_into
from warpgs.io.splits import Split
from warpgs.pipeline.films.film import COVERAGE, FILM, SHEET_FRAMES, render_film, sheet_path
from warpgs.pipeline.films.plan import FilmSettings, plan_film
from warpgs.pipeline.metrics.lpips import load_lpips
from warpgs.pipeline.model.model_file import FittedModel
from warpgs.pipeline.runs.coverage_report import coverage_lines, coverage_of_run
from warpgs.pipeline.runs.failed_step import findings, read_failed_step
from warpgs.pipeline.runs.folder import IMAGE_FOLDERS, StoredRun, open_run
from warpgs.pipeline.runs.learned_views import with_cameras
from warpgs.pipeline.runs.model_and_cameras import open_file
from warpgs.pipeline.runs.request import choose_device, read_scene
from warpgs.pipeline.runs.results import evaluate_run, protocol_of, score_line
from warpgs.pipeline.train.background import color_of, over_background
from warpgs.pipeline.train.loop import train_views
from warpgs.report.coverage_image import LEGEND
from warpgs.report.image_names import image_names, renaming_notes
from warpgs.report.progress import Stages, waiting
from warpgs.runtime.folder_lock import hold_folder
from warpgs.scene import Scene, View

VP9 = (
    "the film is VP9, which browsers and VLC play; convert it for other players: "
    "ffmpeg -i {} -c:v libx264 -pix_fmt yuv420p film-h264.mp4"
)
"""Note on a film in .mp4; {} stands for its path."""
ALPHAS = {"alpha_empty": "where empty", "alpha_object": "in the object"}
"""Scores of the rendered alpha, with their names in the line of a view."""


def scene_of(
    stored: StoredRun, reader: str | None = None, tell: Callable[[str], object] | None = None
) -> tuple[Scene, list[View], list[View]]:
    """Read the scene that a run was fitted to; returns it with its training and its held-out views.

    Args:
        stored: The run.
        reader: User-defined reader, as given to `warpgs fit --reader`.
        tell: Called with a line for each image before it is read.

    Raises:
        DataError: The scene is gone, or its images or cameras have changed since the fit.
    """
    scene, _, _ = read_scene(stored.scene_request(reader), tell)
    if scene.fingerprint != stored.record["fingerprint"]:
        raise DataError(f"{scene.path}: images or cameras have changed since the fit of {stored.folder}; restore them")
    if stored.record["config"]["view_modules"]:
        scene = with_cameras(scene, stored.scene_cameras)
    scene, split = over_background(scene, stored.background), Split(stored.train, stored.test)
    return scene, train_views(scene, split.train), train_views(scene, split.test)


def evaluate(
    folder: Path,
    device_name: str,
    lpips_weights: Path | None = None,
    reader: str | None = None,
    by_coverage: bool = False,
) -> list[str]:
    """Score a run on its held-out views and render them again; returns lines for the user.

    The scores are written to eval.json; metrics.json, which the fit wrote, is not changed.

    Args:
        folder: The run folder.
        device_name: auto, cpu or cuda.
        lpips_weights: File of `warpgs convert-lpips`; None to leave LPIPS out.
        reader: User-defined reader, as given to `warpgs fit --reader`.
        by_coverage: Whether to split the scores by the number of training views that see the point at each pixel.

    Raises:
        DataError: The folder is not a run, its scene is gone, the scene's data have changed since the fit, or the file of
            weights is invalid.
        ResourceError: Another process writes into the folder, or it cannot be written.
    """
    device, _ = choose_device(device_name)
    lpips = None if lpips_weights is None else load_lpips(lpips_weights, device)
    stored, tell = open_run(folder, device), waiting()
    scene, train, test = scene_of(stored, reader, tell)
    request = stored.scene_request(reader)
    with hold_folder(folder, *IMAGE_FOLDERS) as notes:
        names = image_names(v.name for v in scene.views)
        metrics = evaluate_run(folder, stored.gaussians(), train, test, stored.options(), lpips, names=names, tell=tell)
        if by_coverage and test:
            metrics["coverage"] = coverage_of_run(
                folder, stored.gaussians(), train, test, stored.options(), names=names, tell=tell
            )
        metrics |= {
            "protocol": protocol_of(scene, request.split, request.downscale, train, test),
            "config_hash": stored.record["config_hash"], "steps": stored.step,
        }  # fmt: skip
        write_json(folder / "eval.json", metrics)
    notes = [*stored.notes(), *notes, *renaming_notes(names)]
    if not test:
        return [*notes, f"no view is held out; training PSNR {metrics['train']['psnr']:.2f} dB"]
    lines = [_view_line(r) for r in metrics["views"]]
    lines += coverage_lines(metrics["coverage"]) if by_coverage else []
    return [*notes, *lines, f"mean of {len(test)} held-out views: {score_line(metrics['test'])}"]


def _view_line(row: dict[str, Any]) -> str:
    """Return the scores of a view as a line for the user."""
    alphas = [f", alpha {row[k]:.3f} {words}" for k, words in ALPHAS.items() if not math.isnan(row.get(k, math.nan))]
    region = "" if row["region"] == "all" else f" (over {row['region']})"
    return f"{row['name']}: PSNR {row['psnr']:.2f} dB, SSIM {row['ssim']:.3f}{''.join(alphas)}{region}"


def render(
    folder: Path, path: str, out: Path | None, settings: FilmSettings, device_name: str, *,
    background: str = "auto", coverage: bool = False, sheet: bool = False,
    file_of: tuple[Path | None, str | None] | None = None,
    antialiased: bool = False,
) -> list[str]:  # fmt: skip
    """Render a run or a file of Gaussians along a path to PNG files and a film, or only to a film; returns lines for the user.

    Args:
        folder: The run folder; or the file, if ``file_of`` is given.
        path: One of `PATHS`, or a JSON file of keyframes.
        out: Folder or film to write; None for `path-PATH` in the run folder, or beside the file.
        settings: Settings of the film; their background is ignored.
        device_name: auto, cpu or cuda.
        background: Colour behind the scene; auto for the fit's colour, or for transparent images if the scene's images have an
            alpha channel.
        coverage: True to also write images of the coverage by training views.
        sheet: Whether to write six frames in one image, too.
        file_of: Cameras and rule of a file of Gaussians, as `open_file` takes them; None for a run.
        antialiased: Whether the Gaussians of that file were trained with antialiasing.

    Raises:
        DataError: The folder is not a run, or the file, its cameras or the keyframes cannot be read.
        ResourceError: A file cannot be written.
        UsageError: The path is unknown, the background is not a colour, or a number is out of its range.
    """
    color = color_of(background)
    if color is None and background != "auto":
        raise UsageError(f"--background {background}: expected auto, black, white, #rrggbb or r,g,b")
    home, named = folder if file_of is None else folder.parent, out is not None
    out = home / f"path-{Path(path).stem.replace('.', '-')}" if out is None else out
    notes: list[str] = []
    stored: FittedModel
    if file_of is None:
        stored = open_run(folder, device_name)
        notes = stored.notes()
    else:
        stored, notes = open_file(folder, *file_of, device_name, antialiased)
        notes += ["the background is black; choose another colour with --background"] if color is None else []
    tell = Stages()
    settings = replace(settings, background=color)
    plan = plan_film(stored, path, settings)
    training: list[View] | bool = False
    if coverage:
        try:
            training = scene_of(stored)[1] if isinstance(stored, StoredRun) else True
        except WarpgsError as e:
            training = True
            notes.append(f"masked-out regions are shown as seen, since the scene cannot be read: {e}")
        notes.append(f"images in {out / COVERAGE}: {LEGEND}")
    with contextlib.nullcontext() if named else writing_into(home):
        done = render_film(stored, plan, out, settings, coverage=training, sheet=sheet, tell=tell)
    *files, last = done.files
    if last.suffix.lower() == ".mp4":
        notes.append(VP9.format(shlex.quote(str(last))))
    notes += done.notes + ([f"sheet of {min(SHEET_FRAMES, len(plan.cameras))} frames in {sheet_path(out)}"] if sheet else [])
    if last == out:
        return [*notes, f"{len(plan.cameras)} frames in {out}"]
    if last.name == FILM:
        return [*notes, f"{len(files)} images and {FILM} in {out}"]
    return [*notes, f"{len(files) + 1} images in {out}; no film, since the views differ in size"]


def repeat_failed_step(path: Path, device_name: str) -> list[str]:
    """Repeat a step with a non-finite loss; returns lines for the user on its inputs and results.

    Raises:
        DataError: The file holds no such step.
        ResourceError: The device is missing.
    """
    device, where = choose_device(device_name)
    return [f"{path}, repeated {where}:", *findings(read_failed_step(path, device))]
