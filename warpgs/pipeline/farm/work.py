"""The work of a job: a run that is there already is kept, a missing one is made."""

import contextlib
import gc
import os
import time
import traceback
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

from warpgs import files, schema
from warpgs.device import is_out_of_memory, no_memory_message
from warpgs.errors import DataError, FolderHeldError, UsageError, WarpgsError
from warpgs.files import input_digest
from warpgs.io.image_files import decode
from warpgs.io.load import Split
from warpgs.kernels.launch import set_threads
from warpgs.locks import hold_folder
from warpgs.pipeline.farm import job as jobs
from warpgs.pipeline.metrics.lpips import Lpips
from warpgs.pipeline.run.commands import evaluate
from warpgs.pipeline.run.fit import fit_request, with_poses
from warpgs.pipeline.run.folder import CONFIG, METRICS, read_record
from warpgs.pipeline.run.request import FitRequest, choose_device, read_scene
from warpgs.pipeline.train.schedule import StepReport
from warpgs.pipeline.train.settings import FitConfig, settings_by_views
from warpgs.pipeline.train.trainer import train_views
from warpgs.process import output_to, say, say_lines
from warpgs.report.images import webp
from warpgs.version import __version__

Outcome = tuple[str, dict[str, Any] | None, str]
"""State of one run: kept, continued, fitted, redone or failed; contents of its metrics.json, or of eval.json if LPIPS was
measured later, None if it failed; and a note for readers of the results, empty if there is none."""


def _scores(path: Path) -> dict[str, Any] | None:
    """Read metrics.json or eval.json; None if it is missing or incomplete."""
    try:
        return schema.read(path, path.parent, METRICS)
    except (OSError, schema.SchemaError):
        return None


def _difference(record: dict[str, Any], config: FitConfig, fingerprint: str, split: Split | None, device: str) -> str:
    """Name the properties in which a stored run differs from the requested one; empty if it does not differ."""
    wanted = {
        "configuration": (record.get("config_hash"), config.fingerprint()),
        "user code": (record.get("own_code", {}), config.own_code()),
        "data": (record.get("fingerprint"), fingerprint),
        "training views": (record.get("train"), split and list(split.train)),
        "held-out views": (record.get("test"), split and list(split.test)),
        "device": (record.get("device"), device),
        "version of warpgs": ((record.get("versions") or {}).get("warpgs"), __version__),
    }
    return ", ".join(name for name, (then, now) in wanted.items() if then != now)


def _set_aside(folder: Path) -> Path:
    """Rename the folder of a run that cannot be used; no result is deleted."""
    with hold_folder(folder):
        pass  # no process writes there; the lock is released first, since Windows moves no folder with an open file
    number = 1
    while os.path.lexists(target := folder.with_name(f"{folder.name}.old{number}")):
        number += 1
    with files.writable(folder, "move it by hand", f"moved to {target.name}"):
        return files.move_folder(folder, target.name)


def _with_lpips(metrics: dict[str, Any], folder: Path, request: FitRequest, variants: dict[str, str]) -> dict[str, Any]:
    """Return the scores of a finished run with LPIPS for the requested weights; LPIPS is measured now if it is missing."""
    there = [m for m in (metrics, _scores(folder / "eval.json")) if m and m["config_hash"] == metrics["config_hash"]]
    found = next((m for m in there if variants.items() <= m["variants"].items()), None)
    if found is None:
        evaluate(folder, request.device, request.lpips_weights)
        found = schema.read(folder / "eval.json", folder)
    return metrics | {k: found[k] for k in ("test", "views", "variants")}


def ensure_run(
    request: FitRequest,
    fingerprint: str,
    split: Split | None,
    device: str,
    variants: dict[str, str],
    resolved: FitConfig | None = None,
    **others: Any,
) -> Outcome:
    """Ensure that a run folder holds the finished run that is requested; ``others`` are arguments of `fit_request`."""
    # A finished run with the same configuration, user code, data, views, kind of device and version is kept. An
    # interrupted run is continued from its checkpoint. Any other folder is moved aside, and the run is repeated.
    out, state, note, record, why = request.out, "fitted", "", None, "old results: not a run folder"

    def redo(why: str) -> tuple[str, str]:
        return "redone", f"{why}; moved to {_set_aside(out).name}, and the scene was fitted again"

    try:
        try:
            record = read_record(out) if (out / CONFIG).exists() else None
        except DataError as e:
            why = f"old results: unusable ({e})"
        if record is None:
            if os.path.exists(out) and not files.is_empty(out):
                state, note = redo(why)
        elif gap := _difference(record, resolved or request.config, fingerprint, split, device):
            state, note = redo(f"the old run differs in {gap}")
        elif (out / "report.html").is_file() and (metrics := _scores(out / "metrics.json")):  # the report is written last
            if (out / files.LOCK).exists():  # left by a fit that was killed after its last file, like other leftovers
                with contextlib.suppress(FolderHeldError), hold_folder(out):
                    pass
            note = "the finished run was to be scored"
            return "kept", _with_lpips(metrics, out, request, variants) if variants else metrics, ""
        else:
            state, note = "continued", "was interrupted; continued from the last checkpoint"
            try:
                return state, fit_request(replace(request, resume=True), **others).metrics, note
            except (DataError, UsageError) as e:
                state, note = redo(f"could not be continued ({e})")
        return state, fit_request(replace(request, resume=False), **others).metrics, note
    except WarpgsError as e:
        if note:
            e.add_note(note)
        raise


THUMBNAIL_WIDTH = 480
"""Width of a thumbnail, which shows a render beside the photograph [px]."""


def run_job(text: str, threads: int = 0, on_step: Callable[[StepReport], object] | None = None) -> str:
    """Run a job from its text; the job's output goes to its log."""
    if threads:
        set_threads(threads)
    job = jobs.job_of(text)
    with files.writing_into(job.results):
        files.make_folder(job.folder)
        with files.writable(job.folder / jobs.LOG):
            file = files.appending(job.folder / jobs.LOG)
        with file, output_to(file.fileno()):  # of native libraries, too
            return fit_job(job, on_step)


def fit_job(job: jobs.FarmJob, on_step: Callable[[StepReport], object] | None = None) -> str:
    """Fit or continue a job, or keep a finished one, and write its record; returns the state as `run_job` does."""
    began, source, out = time.perf_counter(), jobs.source_stamp(Path(job.request.scene.path)), job.request.out
    again = False
    try:
        how, metrics, message = _ensure(job, on_step)
    except FolderHeldError as e:
        say(str(e))
        return "held"
    except Exception as e:  # whatever a fit raises is a result of this one job: the others go on
        ours, full = isinstance(e, WarpgsError), is_out_of_memory(e)
        how, metrics, message, again = "failed", None, str(e), full or not ours
        if not ours:
            message = no_memory_message(e) if full else f"internal error, {type(e).__name__}: {e}"
        say_lines("".join(traceback.format_exception(e)).splitlines())
    state, took = "failed" if how == "failed" else "done", time.perf_counter() - began
    record = jobs.JobRecord(job.name, job.identity(), state, how, message, again, source, took)
    if metrics is not None:
        write_thumbnail(out / "renders", job.folder / jobs.THUMBNAIL)
        record = replace(
            record, psnr=metrics["test"].get("psnr"), ssim=metrics["test"].get("ssim"), steps=metrics["steps"],
            gaussians=metrics.get("gaussians", 0), ply_bytes=(out / jobs.PLY).stat().st_size,
            files={n: input_digest(out / n, out) for n in jobs.CHECKED},
        )  # fmt: skip
    jobs.write_record(job.folder, record)
    gc.collect()  # a fit and its recorded steps refer to each other: without this their device memory is not freed
    return record.state


def _ensure(job: jobs.FarmJob, on_step: Callable[[StepReport], object] | None) -> Outcome:
    """Return the outcome of the fit; the scene is read here only if an existing run may match."""
    request = job.request
    device, _ = choose_device(request.device)
    lpips = {} if request.lpips_weights is None else Lpips(request.lpips_weights, device).variants()
    files.remove_leftovers(job.folder)
    before = jobs.read_job_record(job.folder)
    if before is not None and before.state == "done" and not jobs.is_whole(request.out, before):
        files.remove_file(request.out / "metrics.json")  # continued from its checkpoint, it writes all files again
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


def write_thumbnail(renders: Path, path: Path) -> None:
    """Write the first render of a run, if any, beside its photograph, as a small image."""
    if (first := min(renders.glob("*.png"), default=None)) is not None:
        image, *_ = decode(first, data=files.read_file(first, renders.parent))
        files.write_bytes(path, webp(image[:, : image.shape[1] * 2 // 3], THUMBNAIL_WIDTH))  # render, photograph, error
