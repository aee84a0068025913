"""One job from beginning to end, called by every engine in the processes that the engine starts."""

from __future__ import annotations

import contextlib
import gc
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.errors import FolderHeldError, ResourceError, UsageError, WarpgsError
from warpgs.files import appending, make_folder, read_file, remove_file, remove_leftovers, write_bytes, writing_into
from warpgs.io.decoding import decode
from warpgs.io.splits import Split
from warpgs.pipeline.farm.ensure_run import Outcome, ensure_run
from warpgs.pipeline.farm.job import FarmJob, job_of
from warpgs.pipeline.farm.record import (
    CHECKED,
    LOG,
    PLY,
    THUMBNAIL,
    JobRecord,
    file_digest,
    is_whole,
    read_record,
    source_stamp,
    write_record,
)
from warpgs.pipeline.metrics.lpips import load_lpips
from warpgs.pipeline.runs.folder import CONFIG
from warpgs.pipeline.runs.request import FitRequest, choose_device, read_scene
from warpgs.pipeline.runs.with_poses import with_poses
from warpgs.pipeline.train.by_views import settings_by_views
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.loop import train_views
from warpgs.pipeline.train.step_report import StepReport
from warpgs.runtime.device_memory import is_out_of_memory, no_memory_message
from warpgs.runtime.interop import set_threads
from warpgs.runtime.native_output import output_to
from warpgs.runtime.terminal import say

THUMBNAIL_SIDE = 480
"""Longest side of a thumbnail, which shows a render beside the photograph [px]."""


def run_job(text: str, threads: int = 0, on_step: Callable[[StepReport], object] | None = None) -> str:
    """Run a job from its text; the job's output goes to its log.

    Args:
        text: Result of `job_text`.
        threads: CPU threads; 0 for as many as there are.
        on_step: As in `fit`.

    Returns:
        The state: done, failed, or held if another farm works on the job. The job's record has all other results.
    """
    if threads:
        set_threads(threads)
    job = job_of(text)
    above = job.folder if job.results is None else job.results
    with writing_into(above):
        make_folder(job.folder)
        with _logged(job.folder / LOG):
            return fit_job(job, on_step)


@contextlib.contextmanager
def _logged(path: Path) -> Iterator[None]:
    """Append all output of the block to a log, including that of native libraries."""
    try:
        file = appending(path)
    except OSError as e:
        raise ResourceError(f"{path}: cannot be written ({e.strerror or e}); write elsewhere, or free some disk space") from e
    with file, output_to(file.fileno()):
        yield


def fit_job(job: FarmJob, on_step: Callable[[StepReport], object] | None = None) -> str:
    """Fit or continue a job, or keep a finished one, and write its record; returns the state as `run_job` does.

    Raises:
        ResourceError: The record cannot be written.
    """
    began, again, message = time.perf_counter(), False, ""
    source = source_stamp(Path(job.request.scene.path))
    try:
        outcome = _ensure(job, on_step)
        error: Exception | None = outcome.error
    except Exception as e:  # whatever a fit raises is a result of this one job: the others go on
        outcome, error = Outcome("failed", None, str(e)), e
    if isinstance(error, FolderHeldError):
        say(str(error))
        return "held"
    if error is not None:
        again = is_out_of_memory(error) or not isinstance(error, WarpgsError)
        message = str(error)
        if is_out_of_memory(error) and not isinstance(error, WarpgsError):
            message = no_memory_message(error)
        elif not isinstance(error, WarpgsError):
            message = f"internal error, {type(error).__name__}: {error}"
        for line in "".join(traceback.format_exception(error)).splitlines():
            say(line)
    record = JobRecord(
        job.name, job.identity(), "done" if error is None else "failed", outcome.state, message or outcome.note, again, source,
        time.perf_counter() - began,
    )  # fmt: skip
    if error is None:
        record = _with_results(job, record, outcome.metrics or {})
    write_record(job.folder, record)
    gc.collect()  # a fit and its recorded steps refer to each other: without this their device memory is not freed
    return record.state


def _ensure(job: FarmJob, on_step: Callable[[StepReport], object] | None) -> Outcome:
    """Return the outcome of the fit; the scene is read here only if an existing run may match."""
    request = job.request
    device, _ = choose_device(request.device)
    lpips = {} if request.lpips_weights is None else load_lpips(request.lpips_weights, device).variants()
    remove_leftovers(job.folder)
    before = read_record(job.folder)
    if before is not None and before.state == "done" and not is_whole(request.out, before):
        remove_file(request.out / "metrics.json")  # continued from its checkpoint, it writes all files again
    fingerprint, split, resolved = "", None, request.config
    if (request.out / CONFIG).is_file():
        fingerprint, split, resolved = _wanted(request, device.type)
    return ensure_run(request, fingerprint, split, device.type, lpips, resolved, on_step=on_step)


def _wanted(request: FitRequest, device: str) -> tuple[str, Split | None, FitConfig]:
    """Return the fingerprint of a scene as it is now, its split, and the settings, with automatic ones chosen."""
    try:
        found, _ = with_poses(request.scene.with_scale(device), request.out, say)
    except UsageError as e:  # the stored poses are of other photographs
        return str(e), None, request.config
    scene, split, _ = read_scene(found)
    return scene.fingerprint, split, settings_by_views(request.config, train_views(scene, split.train), device)[0]


def _with_results(job: FarmJob, record: JobRecord, metrics: dict[str, Any]) -> JobRecord:
    """Write the thumbnail of a finished run; return a record with its figures and checksums."""
    out, test = job.request.out, metrics["test"]
    write_thumbnail(out / "renders", job.folder / THUMBNAIL)
    return replace(
        record, psnr=test.get("psnr"), ssim=test.get("ssim"), gaussians=metrics.get("gaussians", 0), steps=metrics["steps"],
        ply_bytes=(out / PLY).stat().st_size, files={n: file_digest(out / n) for n in CHECKED},
    )  # fmt: skip


def write_thumbnail(renders: Path, path: Path) -> None:
    """Write the first render of a run, if any, beside its photograph, as a small JPEG."""
    import cv2

    first = min(renders.glob("*.png"), default=None)
    if first is None:
        return
    image = np.round(255 * decode(first, data=read_file(first, renders.parent))[0][..., ::-1]).astype(np.uint8)
    pair = image[:, : image.shape[1] * 2 // 3]  # render, photograph, error
    scale = min(1.0, THUMBNAIL_SIDE / max(pair.shape[:2]))
    size = max(1, round(pair.shape[1] * scale)), max(1, round(pair.shape[0] * scale))
    done, data = cv2.imencode(".jpg", cv2.resize(pair, size, interpolation=cv2.INTER_AREA), [cv2.IMWRITE_JPEG_QUALITY, 85])
    if done:
        write_bytes(path, data.tobytes())
