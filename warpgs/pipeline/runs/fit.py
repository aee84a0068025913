"""One fit from scene to result: `warpgs.fit`, which the command line calls, too."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from warpgs.errors import DataError, UsageError
from warpgs.export.ply import write_ply
from warpgs.files import write_json
from warpgs.io.splits import Split, check_spec
from warpgs.pipeline.metrics.evaluate import render_view
from warpgs.pipeline.metrics.lpips import load_lpips
from warpgs.pipeline.metrics.moved import Rendered, moved_fractions, moved_notes
from warpgs.pipeline.model.compress import drop_unused_sh
from warpgs.pipeline.model.model_file import FittedModel
from warpgs.pipeline.model.scale_limits import shape_figures, shape_summary
from warpgs.pipeline.runs.batched import batched_notes, check_batched, check_equal
from warpgs.pipeline.runs.checkpoint import TENSORS, load_checkpoint
from warpgs.pipeline.runs.coverage_report import coverage_of_run
from warpgs.pipeline.runs.fit_steps import model_fields, take_steps, tell
from warpgs.pipeline.runs.folder import (
    CONFIG,
    METRICS_FILE,
    check_checkpoint,
    check_same,
    read_record,
    record_of,
    run_folder,
)
from warpgs.pipeline.runs.given_report import given_figures
from warpgs.pipeline.runs.job import FitJob
from warpgs.pipeline.runs.learned_views import cameras_of, learned_cameras, learned_figures, with_cameras
from warpgs.pipeline.runs.request import FitRequest, SceneRequest, check_overrides, choose_device, choose_split, read_scene
from warpgs.pipeline.runs.results import evaluate_run, overview_of, protocol_of, result_lines, write_report
from warpgs.pipeline.runs.rule_report import rule_report_of
from warpgs.pipeline.runs.sampling_report import event_figures, images_kept, sampling_report_of
from warpgs.pipeline.runs.with_poses import lost_lines, with_poses
from warpgs.pipeline.train.background import choose_background, over_background
from warpgs.pipeline.train.by_views import settings_by_views
from warpgs.pipeline.train.complexity import complexity_figures, complexity_summary
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.presets import chosen_settings
from warpgs.pipeline.train.slots import check_renders
from warpgs.pipeline.train.step_report import StepReport
from warpgs.pipeline.train.time_budget import within_budget
from warpgs.pipeline.train.trainer import Trainer
from warpgs.pipeline.train.warmup import background_warmup
from warpgs.priors.photo_checks import check_photos, photo_notes
from warpgs.report.image_names import image_names, renaming_notes
from warpgs.report.progress import Stages
from warpgs.runtime.load_module import told_of_compiling
from warpgs.runtime.ranks import ALONE, Ranks
from warpgs.runtime.terminal import Detail, counted
from warpgs.scene import Camera, Scene
from warpgs.scene_checks import checked_scene

COMPILING = "compiling kernels, once on this machine, for a minute or two"
"""Message while kernels are compiled."""
State = tuple[dict[str, torch.Tensor], dict[str, Any]]
"""Tensors and plain values of a checkpoint."""


@dataclass(frozen=True, repr=False)
class FitResult(FittedModel):
    """A finished fit."""

    config: FitConfig
    """All settings, including those that were chosen automatically."""
    metrics: dict[str, Any]
    """Scores, sizes and times, as in metrics.json."""
    notes: tuple[str, ...]
    """Automatic choices, assumptions and missing parts."""
    folder: Path | None
    """The run folder; None without ``out``."""


def fit(
    scene: Scene | SceneRequest | str | Path,
    preset: FitConfig | Mapping[str, Any] | str | Path | None = None,
    *,
    split: str | None = None,
    out: str | Path | None = None,
    device: str | torch.device = "auto",
    on_step: Callable[[StepReport], object] | None = None,
    resume: bool = False,
    lpips_weights: str | Path | None = None,
    time_budget: float | None = None,
    notes: tuple[str, ...] = (),
    verbose: bool | Literal["progress"] = True,
    on_model: Callable[[FittedModel], object] | None = None,
    ranks: Ranks = ALONE,
    **overrides: object,
) -> FitResult:
    """Fit Gaussians to a scene, as `warpgs fit` does.

    Prints automatic choices, progress and the location of the results, unless ``verbose`` is False.

    Args:
        scene: A scene, its folder, or a folder with options for reading.
        preset: Settings to start from: the name of a preset; the path of a .toml file; a `FitConfig` or a mapping, as an
            object, ``module:NAME`` or ``file.py:NAME`` (this runs the code of the module); None for the default preset.
        split: Views to fit and to hold out, as in `warpgs fit --split`; None to fit all.
        out: Run folder to fill with configuration, log, checkpoints, PLY, images, scores and report; None to write nothing.
        device: auto, cpu, cuda, or a torch device.
        on_step: Called after every step with its number, loss, PSNR, number of Gaussians and time.
        resume: Continue the run in ``out`` from its last checkpoint.
        lpips_weights: File of `warpgs convert-lpips`; None to leave LPIPS out.
        time_budget: Time that the fit may take [s], which determines the number of steps; None to use the number in the
            settings.
        notes: Earlier choices, which are printed and recorded with the choices of the fit.
        verbose: True to print everything, False to print nothing, "progress" to print progress only.
        on_model: Called after every step with the current model, for viewers: the next step overwrites its tensors.
        ranks: Processes that fit together, from `warpgs.train.join_ranks`, all with the same arguments. Only the first
            prints, writes and scores; the others return a result without metrics.
        **overrides: Settings that replace those of the preset, by the names of their flags with underscores, such as
            ``steps=300`` or ``init_opacity=0.2``; or a group as a mapping, ``init={"opacity": 0.2}``. `FitConfig` and `warpgs
            fit --help-all` list them.

    Raises:
        DataError: The file of a preset cannot be read, or a field of the scene is invalid; the message names view and field.
        UsageError: A setting is unknown, of the wrong type or out of range, a preset or a split is invalid, ``out`` is not
            empty, or ``resume`` is given without ``out``.
        WarpgsError: Any other error that a user can fix, before the first step if possible.
    """
    out = None if out is None else Path(out)
    if resume and out is None:
        raise UsageError("resume requires out, the run folder to continue")
    check_overrides(overrides)
    if isinstance(scene, Scene):
        scene = checked_scene(scene)
    elif not isinstance(scene, (SceneRequest, str, Path)):
        raise UsageError(
            f"scene must be a warpgs.Scene or a folder, not {type(scene).__name__}; give Scene(path, format, views)"
        )
    config, origin = chosen_settings(preset, overrides)
    spec = scene.split if split is None and isinstance(scene, SceneRequest) else split
    if spec is not None:
        check_spec(spec)
    check_batched(scene, config, ranks, time_budget, resume)
    verbose, own = ranks.first and verbose, out if ranks.first else None
    with _opened(own, resume, verbose) as (held, progress, compiled):
        resume = resume and out is not None and (out / CONFIG).is_file()  # else the folder holds only found poses
        if out is not None and resume:
            read_record(out)  # a run of another version is refused before anything takes time
        where = choose_device(device)
        began = time.perf_counter()
        lpips = None if lpips_weights is None else load_lpips(Path(lpips_weights), where[0])
        request, read, parts, found = _scene_of(scene, split, out, where[0].type, progress)
        renamed = [] if out is None else renaming_notes(image_names(v.name for v in read.views))
        own_notes = [*notes, *origin, *held, *found, *renamed]
        job = FitJob(
            read, request, parts, config, *where, own, lpips, own_notes, verbose, on_step, began, progress, on_model, ranks,
            compiled,
        )  # fmt: skip
        _settle(job, time_budget)
        trainer, state, record = _prepare(job, out if resume else None)
        result = _finish(job, trainer, state, record, resume)
    ranks.leave()
    return result


@contextlib.contextmanager
def _opened(
    out: Path | None, resume: bool, verbose: bool | Literal["progress"]
) -> Iterator[tuple[list[str], Callable[[str], object], list[float]]]:
    """Lock the run folder; yields notes on it, the function that shows progress, and the time spent on compiling [s]."""
    nothing: contextlib.AbstractContextManager[list[str]] = contextlib.nullcontext([])
    folder = nothing if out is None else run_folder(out, resume)
    stages = Stages() if verbose else Stages(lambda line: None)
    with folder as held, stages as progress, told_of_compiling(lambda name: progress(COMPILING)) as compiled:
        yield held, progress, compiled


def _settle(job: FitJob, time_budget: float | None) -> None:
    """Composite the scene over its background, and choose the automatic settings."""
    if time_budget is not None:
        job.config, note = within_budget(job.config, time_budget, job.train, job.device)
        job.notes.append(note)
    color, background = choose_background(job.config.background, job.scene, job.train)
    job.scene = over_background(job.scene, color)
    job.config, chosen = settings_by_views(job.config, job.train, job.device.type)
    job.notes += [*([background] if background else []), *chosen]
    if job.config.antialiased:
        job.notes.append("antialiased: other programs must use their antialiased mode to show exported files correctly")
    check_renders(job.config.batch, job.config.steps or 0)


def fit_request(request: FitRequest, **others: Any) -> FitResult:
    """Run `fit` for the command line, a study or a farm; ``others`` are on_model, on_step and ranks of `fit`.

    Raises:
        KeyboardInterrupt: A signal ended the fit; the message explains how to continue.
    """
    r = request
    try:
        return fit(
            r.scene, r.config, out=r.out, device=r.device, resume=r.resume, lpips_weights=r.lpips_weights,
            time_budget=r.time_budget, notes=r.notes, **others,
        )  # fmt: skip
    except KeyboardInterrupt as e:
        saved = r.out is not None and (r.out / TENSORS).is_file()
        again = "--resume continues from the last checkpoint" if saved else "no step was saved: run the same command again"
        raise KeyboardInterrupt(again) from e


def _scene_of(
    scene: Scene | SceneRequest | str | Path,
    spec: str | None,
    out: Path | None,
    device: str,
    progress: Callable[[str], object],
) -> tuple[SceneRequest, Scene, Split, list[str]]:
    """Read and split a scene that is given in one of four ways; returns request, scene, split and notes."""
    if isinstance(scene, Scene):
        split, notes = choose_split(scene, spec)
        return SceneRequest("", spec, 1).with_scale(device), scene, split, [*scene.notes, *notes]
    request = (scene if isinstance(scene, SceneRequest) else SceneRequest(str(scene))).with_scale(device)
    if spec is not None:
        request = replace(request, split=spec)
    request, found = with_poses(request, out, progress)
    progress(f"reading {request.path}")
    read, parts, notes = read_scene(request, progress)
    return request, read, parts, [*found, *notes]


def _prepare(job: FitJob, resumed: Path | None) -> tuple[Trainer, State | None, dict[str, Any]]:
    """Set up the trainer; returns it, the state to continue the run ``resumed`` from, if any, and the record of the run."""
    record, state = record_of(job.request, job.config, job.scene, job.split, job.notes, job.device), None
    if resumed is not None:
        stored = read_record(resumed)
        check_same(record, stored, resumed)
        if (resumed / TENSORS).is_file():
            state = load_checkpoint(resumed)
            check_checkpoint(state[1], stored, resumed)
            if state[1]["step"] == state[1].get("steps"):
                job.say(f"  all {state[1]['step']:,} steps are taken; only the images, scores and report are made again")
    check_equal(record, None if state is None else state[1].get("step"), job.ranks)
    c = job.config
    with background_warmup(c, job.device) as ready:
        if job.other_models:
            models = " and ".join(job.other_models)
            job.notes.append(f"camera model {models}: views cannot be compared, so blur, exposure and coverage are not checked")
        else:
            job.photographs = check_photos([*job.train, *job.test], job.progress)
        of = job.train, job.scene.points, c, job.device, job.scene.background
        trainer = Trainer(*of, ready=ready, progress=job.progress, ranks=job.ranks)
    if job.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(job.device)  # report the steps' memory, not that of the start or of an earlier fit
    return trainer, state, record


def _finish(job: FitJob, trainer: Trainer, state: State | None, record: dict[str, Any], resume: bool) -> FitResult:
    """Take the steps, score the model, and write the run folder, if any."""
    if job.out is not None and not resume:
        write_json(job.out / CONFIG, record)
    if state is not None:
        try:
            trainer.load(*state)
        except DataError as e:
            raise DataError(f"{job.out}/{TENSORS}: {e}") from e
        job.notes.append(f"continued from step {trainer.step}; this run's times count from there")
    shared = batched_notes(job.config, job.ranks)
    job.announce([*photo_notes(job.photographs), *trainer.notes, *shared, trainer.memory.summary()])
    setup = time.perf_counter() - job.began
    nothing = contextlib.nullcontext(lambda: None)
    with nothing if job.out is None else images_kept(trainer, list(job.split.train), job.out) as images_written:
        take_steps(job, trainer, images_written)
    tell(job, trainer)  # of images that were written last
    training = time.perf_counter() - job.began - setup
    job.ranks.part()
    if not job.ranks.first:
        return FitResult(*model_fields(job, trainer), job.config, {}, tuple(job.notes), None)
    given = cameras_of(job.scene)
    job.scene = with_cameras(job.scene, learned_cameras(job.scene, job.split, trainer.learned.views))
    if job.out is not None:
        write_ply(
            job.out / "point_cloud.ply",
            drop_unused_sh(trainer.gaussians),
            job.scene.normalization,
            antialiased=job.config.antialiased,
        )
    with ThreadPoolExecutor(1) as beside:
        # its process takes seconds; views are scored here meanwhile
        overview = beside.submit(overview_of(trainer.gaussians, job.train, job.test)) if job.out is not None else None
        metrics = _score(job, trainer, {"setup": setup, "training": training}, given)
        if job.out is not None and overview is not None:
            job.progress("making the report")
            write_json(job.out / METRICS_FILE, metrics)
            record["notes"] = job.notes
            write_report(
                job.out, job.scene, job.split, trainer.gaussians, trainer.context.render_options(), metrics, record,
                sampling=sampling_report_of(trainer, job.out), overview=overview.result(), tell=job.progress,
            )  # fmt: skip
    for line in [*lost_lines(job.out), *result_lines(metrics, job.out)]:
        job.say(line)
    return FitResult(
        *model_fields(job, trainer), job.config, metrics, tuple(job.notes), job.out,
        transparent=job.scene.transparent, antialiased=job.config.antialiased,
    )  # fmt: skip


def _score(job: FitJob, trainer: Trainer, seconds: dict[str, float], given: dict[str, Camera]) -> dict[str, Any]:
    """Score the finished fit, with the ``given`` cameras from before it; returns the contents of metrics.json."""
    c, scene, train, test, gaussians = job.config, job.scene, job.train, job.test, trainer.gaussians
    on_cuda = job.device.type == "cuda"
    peak = {"peak_torch_bytes": torch.cuda.max_memory_allocated(job.device)} if on_cuda else {}
    names = image_names(v.name for v in scene.views)
    options, tell = trainer.context.render_options(), job.progress
    scored = (job.out, gaussians, train, test, options)
    metrics = evaluate_run(*scored, job.lpips, names=names, tell=tell)
    if test and not job.other_models:
        metrics["coverage"] = coverage_of_run(*scored, names=names, tell=tell)
    tell("checking float32 accuracy")
    rule = rule_report_of(gaussians, train, options, seed=c.seed, half_resolution=trainer.half_resolution)
    shape = shape_figures(gaussians, c.limits, trainer.radius, trainer.context.extent, [v.camera for v in train])
    moved = {}
    if not job.other_models:
        shown = counted(train, job.progress, "checking for moving objects", "views")
        fractions = moved_fractions(train, (Rendered(*render_view(gaussians, v, options)) for v in shown))
        moved = {v.name: f for v, f in zip(train, fractions, strict=True)}
    complexity = complexity_figures(trainer)
    learned = learned_figures(trainer.learned.views, scene, job.split, given, test, gaussians, options)
    details = [rule["summary"], shape_summary(shape), complexity_summary(complexity)]
    mapped = given_figures(train, trainer.views, gaussians, options)
    summaries = [e["summary"] for of in (learned, mapped) for e in of.values()]
    for note in [*map(Detail, details), *moved_notes(moved), *summaries]:
        job.note(note)
    compiling = {"compiling": sum(job.compiled)} if job.compiled else {}
    return metrics | {
        "protocol": protocol_of(scene, job.request.split, job.request.downscale or 1, train, test),
        "steps": trainer.step, "batch": c.batch, "ranks": job.ranks.count,
        "gaussians": len(gaussians), "preset": c.preset, "seed": c.seed,
        "config_hash": c.fingerprint(), "fingerprint": scene.fingerprint, "device": job.where.removeprefix("on "),
        "seconds": {**seconds, **compiling, "total": time.perf_counter() - job.began}, **peak,
        "memory": trainer.memory.to_json(), "rule": rule, "shape": shape,
        **event_figures(trainer), **complexity, "view_modules": learned, "given": mapped,
        "photographs": [p.to_json() | {"moved": moved.get(p.name)} for p in job.photographs],
    }  # fmt: skip
