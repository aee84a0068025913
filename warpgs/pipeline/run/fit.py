"""`fit`: a scene becomes a run."""

import contextlib
import itertools
import json
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch

from warpgs.clock import Clock, section, timed
from warpgs.errors import DataError, NotFiniteError, UsageError, listed
from warpgs.export.ply import write_ply
from warpgs.files import write_json
from warpgs.geometry import CENTRAL
from warpgs.io.images import without_masked
from warpgs.io.load import Split, check_spec, fingerprint, split_names
from warpgs.kernels.native import told_of_compiling
from warpgs.pipeline.metrics.coverage import coverage_of_run
from warpgs.pipeline.metrics.lpips import Lpips
from warpgs.pipeline.metrics.scores import Renders, moved_fractions, moved_notes
from warpgs.pipeline.model.edit import drop_unused_sh
from warpgs.pipeline.model.limits import shape_figures, shape_summary
from warpgs.pipeline.model.table import FittedModel, similarity_of
from warpgs.pipeline.run import folder as folders, results
from warpgs.pipeline.run.folder import CONFIG, METRICS_FILE, POSED_SCENE, TENSORS
from warpgs.pipeline.run.precompile import compiled_ahead
from warpgs.pipeline.run.request import FitRequest, SceneRequest, check_overrides, choose_device, choose_split, read_scene
from warpgs.pipeline.train.batch import check_ranks
from warpgs.pipeline.train.loss import term_values
from warpgs.pipeline.train.memory import plan_summary
from warpgs.pipeline.train.presets import chosen_settings
from warpgs.pipeline.train.schedule import StepReport, choose_background, over_background
from warpgs.pipeline.train.settings import WHOLE_FIT, FitConfig, settings_by_views, step_times, steps_by_views, within_budget
from warpgs.pipeline.train.step import StepBuffers, eager_renderer
from warpgs.pipeline.train.strategies.base import find_strategy
from warpgs.pipeline.train.trainer import Trainer, background_warmup, complexity_figures, complexity_summary, run, train_views
from warpgs.pipeline.train.view_modules import FittedViews
from warpgs.plugins import is_ours
from warpgs.poses.find import JSON, TEXT, find_poses, needs_poses, read_poses_record, source_digest
from warpgs.poses.photographs import find_photographs, image_root, is_video
from warpgs.priors.networks import in_threads
from warpgs.priors.photo_checks import PhotoCheck, check_photos, photo_notes
from warpgs.process import Detail, Say, Task, counted, noted_signals, say, silent
from warpgs.ranks import ALONE, Ranks
from warpgs.report.page import image_names, renaming_notes
from warpgs.report.progress import EventLog, Progress, Stages, duration
from warpgs.scene import Camera, Scene, View, checked_scene


@dataclass(kw_only=True)
class FitJob:
    """One fit in progress: its inputs and its state."""

    scene: Scene
    request: SceneRequest
    split: Split
    config: FitConfig
    device: torch.device
    where: str
    """The device, as text."""
    out: Path | None
    lpips: Lpips | None
    notes: list[str]
    verbose: bool | Literal["progress"]
    on_step: Callable[[StepReport], object] | None
    on_model: Callable[[FittedModel], object] | None
    ranks: Ranks
    began: float
    clock: Clock
    progress: Say
    compiled: list[float]
    """Time of each compilation so far [s]."""

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

    def note(self, *lines: str) -> None:
        """Keep lines for the report, and print those that are no details."""
        for line in lines:
            self.notes.append(line)
            if not isinstance(line, Detail):
                self.say(f"  {line}")

    def tell(self, trainer: Trainer) -> None:
        """Print the messages of the trainer, and keep them for the report, that of a continued run, too."""
        while trainer.messages:
            trainer.notes.append(trainer.messages.pop(0))
            self.note(trainer.notes[-1])

    def cameras(self, trainer: Trainer) -> Mapping[str, Camera]:
        """Return the cameras of all views after the view modules, by name."""
        return trainer.learned.cameras(folders.cameras_of(self.scene), self.split.train, self.split.test)

    def model(self, trainer: Trainer) -> dict[str, Any]:
        """Return the fields of the current `FittedModel`, by name."""
        return {
            "scene_gaussians": trainer.gaussians, "normalization": self.scene.normalization,
            "scene_cameras": folders.cameras_of(self.scene), "train": self.split.train, "test": self.split.test,
            "rule": self.config.rule, "background": self.scene.background, "step": trainer.step,
            "transparent": self.scene.transparent, "antialiased": self.config.antialiased,
        }  # fmt: skip


def take_steps(job: FitJob, trainer: Trainer) -> None:
    """Take all remaining steps, with log, images of events and checkpoints if there is a run folder."""
    out = job.out
    log = None if out is None else EventLog(out / "metrics.jsonl", trainer.step)
    slow = compiled = -1  # the last step that was slow because it compiled kernels; the number of kernels compiled by then

    def save(trainer: Trainer) -> None:
        if out is None or log is None:
            return
        with section("writing"):
            log.flush()
            images_written()  # a fit that continues from the checkpoint does not write them
            tensors, state = trainer.state()
            if trainer.config.view_modules:  # by which a run is opened without their code
                state["cameras"] = {n: folders.camera_values(c) for n, c in job.cameras(trainer).items()}
            folders.save_checkpoint(out, tensors, state | {"fingerprint": job.scene.fingerprint, "train": job.split.train})

    def restore(trainer: Trainer) -> bool:
        if out is None or log is None or not (out / TENSORS).is_file():
            return False
        trainer.load(*folders.load_checkpoint(out))
        log.rewind(trainer.step)
        return True

    def report(r: StepReport) -> None:
        nonlocal slow, compiled
        if len(job.compiled) > compiled:
            slow, compiled = trainer.step, len(job.compiled)
        if progress is not None:
            progress.total = trainer.steps  # fewer, once the fit is known to end earlier
            progress.update(step=r.step, loss=r.loss, psnr=r.psnr, count=r.count, seconds=None if r.step <= slow else r.seconds)
        if log is not None:
            log.write(step=r.step, loss=r.loss, psnr=r.psnr, count=r.count, seconds=round(r.seconds, 6))
        job.tell(trainer)
        if job.on_step is not None:
            job.on_step(r)
        if job.on_model is not None:
            job.on_model(FittedModel(**job.model(trainer)))

    with contextlib.ExitStack() as stack:
        if out is not None and log is not None:
            images_written = stack.enter_context(results.images_kept(trainer, list(job.split.train), out))
            stack.callback(log.close)
        planned = planned_times(job, trainer)[0]
        progress = stack.enter_context(Progress(trainer.steps, trainer.step, planned=planned)) if job.verbose else None
        try:
            run(trainer, report, save, stack.enter_context(noted_signals()), restore)
        except NotFiniteError as e:
            if e.view is None:
                raise
            if not job.ranks.first:
                job.ranks.leave()  # all ranks have this loss; the first reports it
                raise
            explained = _explained(job, trainer, e, e.view)
            save(trainer)
            raise explained from e
    job.tell(trainer)  # of images that were written last


def planned_times(job: FitJob, trainer: Trainer) -> tuple[Sequence[float] | None, list[str]]:
    """Return the expected time of each step on two cores, and a sentence on it; elsewhere None, since steps are alike."""
    if job.device.type != "cpu" or not find_strategy(job.config.strategy).samples:
        return None, []
    pixels, config = max(v.camera.width * v.camera.height for v in job.train), job.config
    config = replace(config, max_gaussians=min(config.max_gaussians, trainer.context.capacity))
    times, counts = step_times(config, len(job.train), pixels, trainer.first_count, growing=True)
    left, last = times[trainer.step : trainer.steps], counts[trainer.steps - 1]
    took = f"{len(left):,} steps take about {duration(WHOLE_FIT * left.sum())} on two idle cores, besides start and report"
    took += f"; they end with about {float(f'{last:.2g}'):,.0f} Gaussians"
    if trainer.step < (half := int(trainer.half_resolution * trainer.phases.planned)):
        took += f"; PSNR falls after step {half:,}, where photographs have full size"
    return times.tolist(), [took] * (len(left) > 0)


def _explained(job: FitJob, trainer: Trainer, error: NotFiniteError, view: int) -> NotFiniteError:
    """Return the error for the user on a step with a non-finite loss: view, loss terms, tensors, and what to do."""
    broken, tensors = non_finite_parts(trainer, view, error.slot)
    own = [t.name for t in trainer.terms if f"the loss term {t.name}" in broken and not is_ours(type(t))]
    text = f"{error}, on {job.split.train[view]}{', in ' if broken else ''}{' and '.join(broken)}; "
    text += f"not finite: {', '.join(tensors)}" if tensors else "all of its inputs and renders are finite"
    if job.out is not None:
        text += f". The state before the step is saved in {job.out}, and --resume would fail at the same step"
    fix = f"correct {' and '.join(own)}, and fit again" if own else "fit again with lower learning rates"
    report = "" if own else f"; if that fails, report this message and the run's {CONFIG}"
    return NotFiniteError(f"{text}. To fix it, {fix} into a new --out{report}")


def non_finite_parts(trainer: Trainer, view: int, slot: int) -> tuple[list[str], list[str]]:
    """Repeat the forward pass of the next step on ``view``; returns the non-finite loss terms and tensors (inputs, renders)."""
    number = trainer.step + 1
    plan = trainer.plan_of(number)
    kind, row = trainer.places[view + plan.half_size * len(trainer.views)]
    buffers = StepBuffers(trainer.device, 1, 1)
    buffers.load([row], [[0.0]], [trainer.settings(number, slot)])
    render = eager_renderer(trainer.context.render_options(), None)
    with torch.no_grad():
        _, inputs, of_views, _, _ = trainer.taker.forward(trainer.stacks[kind], buffers, plan, render)
        values = {f"the loss term {t.name}": v for t, v in zip(plan.terms, term_values(plan.terms, inputs), strict=True)}
        values |= {f"the view module {n}": v for n, v in of_views.items()}
        extra = trainer.strategy.regularisation(plan.phase, inputs.gaussians)
        values |= {} if extra is None else {f"the strategy {trainer.config.strategy}": extra}
    tensors = {"image": inputs.target.image} | {f"map {n}": t for n, t in inputs.target.maps.items()}
    tensors |= trainer.taker.params | {f"rendered {n}": t for n, t in inputs.outputs.items()}
    wrong = {n: int((~torch.isfinite(t)).sum()) for n, t in tensors.items()}
    broken = [n for n, v in values.items() if not bool(torch.isfinite(v).all())]
    return broken, [f"{n} ({count:,} of {tensors[n].numel():,} values)" for n, count in wrong.items() if count]


def check_equal(record: dict[str, Any], step: int | None, ranks: Ranks) -> None:
    """Refuse, in every process, ranks whose scene, settings, code or checkpoint (``step``) differ from those of rank 0."""
    if ranks.count == 1:
        return
    own = {
        "the version of warpgs": record["versions"]["warpgs"],
        "the scene": record["fingerprint"],
        "the split": [record["train"], record["test"]],
        "the settings or the code": [record["config"], record["own_code"]],
        "the checkpoint": step,
    }
    first, *others = map(json.loads, ranks.texts(json.dumps(own)))
    for rank, other in enumerate(others, 1):
        if names := [name for name in own if other.get(name) != first.get(name)]:
            fix = "give all ranks the same version, files, flags, code and --out, on a file system that all machines share"
            raise UsageError(f"rank {rank} differs from rank 0 in {names[0]}: {fix}")


def batched_notes(config: FitConfig, ranks: Ranks) -> list[str]:
    """Return sentences on views and processes of a step; empty if a step has one view."""
    rates = f"learning rates are {config.batch**0.5:.3g} times those for one view"
    views = f"batch: each of the {config.steps:,} steps renders {config.batch} views and averages their gradients; {rates}"
    processes = f"ranks: {ranks.count} processes ({ranks.backend}) share the views; the model has the same bits for any number"
    return [views] * (config.batch > 1) + [processes] * (ranks.count > 1)


def with_poses(request: SceneRequest, out: Path | None, progress: Say, ranks: int = 1) -> tuple[SceneRequest, list[str]]:
    """Find the poses of photographs without cameras, or read them from the run folder ``out``; returns request and notes."""
    source = Path(request.path)
    if request.reader is not None or request.reconstruction is not None or not request.path or not needs_poses(source):
        if request.matcher is not None:
            raise UsageError(f"--matcher requires a folder of photographs without cameras; leave it out for {source}")
        return request, []
    if out is None:
        raise UsageError(f"{source}: has no cameras, and finding poses needs a run folder; give out=")
    scene = out / POSED_SCENE
    if (scene / JSON).is_file():
        record = read_poses_record(scene)
        if record["source_sha256"] != source_digest(source, request.allow_outside):
            raise UsageError(f"{scene} holds poses of other photographs than {source}; give another --out")
    elif ranks > 1:
        fix = f"run `warpgs poses {source} --out SCENE` first, and fit SCENE"
        raise UsageError(f"{source}: has no cameras, and each of {ranks} ranks would find its own poses; {fix}")
    else:
        if "=" not in (spec := request.split or "all") and not is_video(source):  # refuse what all photographs are too few for
            root = image_root(source)
            split_names([p.relative_to(root).as_posix() for p in find_photographs(source)[0]], spec)
        progress(f"{source} has no cameras: finding the poses of its photographs, to store them in {scene}")
        record = find_poses(
            source, scene, threads=torch.get_num_threads(), max_pixels=request.max_pixels, allow_outside=request.allow_outside,
            matcher=request.matcher, progress=progress,
        )  # fmt: skip
    lost = [f"{p['name']} {p['reason']}" for p in record["photographs"] if not p["registered"]]
    notes = [*record["notes"], *([f"no pose: {listed(lost, 5)}"] if lost else [])]
    return replace(request, path=str(scene), matcher=None), notes


SHOWN_ADVICE = 3
"""Largest number of pieces of advice on further photographs that a fit prints."""


def title_of(scene: Path, out: Path) -> str:
    """Return the name of a scene's folder; of the photographs, if their poses were found in the run folder ``out``."""
    folder = scene.resolve()
    if folder.parent != out.resolve() or not (folder / JSON).is_file():
        return folder.name
    return str(read_poses_record(folder).get("source") or out.resolve().name)


def pose_tasks(out: Path | None) -> list[str]:
    """Return what to photograph next, and how many photographs a run leaves out; empty if its poses need nothing more."""
    if out is None or not (out / POSED_SCENE / JSON).is_file():
        return []
    record, why = read_poses_record(out / POSED_SCENE), f"{POSED_SCENE}/{TEXT} in the run folder lists reasons and remedies"
    lost, advice = sum(not p["registered"] for p in record["photographs"]), record["advice"][:SHOWN_ADVICE]
    left_out = f"{lost} of {len(record['photographs'])} photographs have no pose and were not used: {why}"
    return [*map(Task, [left_out] * bool(lost) + [f"to photograph next: {a}" for a in advice])]


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
        UsageError: A setting is unknown, of the wrong type or out of range; a preset or a split is invalid; ``out`` is not
            empty; or ``resume`` is given without ``out``.
        WarpgsError: Any other error that a user can fix, before the first step if possible.
    """
    out = None if out is None else Path(out)
    if resume and out is None:
        raise UsageError("resume requires out, the run folder to continue")
    check_overrides(overrides)
    config, origin = chosen_settings(preset, overrides)
    check_ranks(config.batch, ranks)
    if time_budget is not None and ranks.count > 1:
        raise UsageError(f"--time-budget: each of {ranks.count} ranks would choose its own number of steps; give --steps")
    scene = _checked_source(scene, split)
    verbose, own = ranks.first and verbose, out if ranks.first else None
    folder = contextlib.nullcontext(list[str]()) if own is None else folders.run_folder(own, resume)
    stages = Stages() if verbose else Stages(silent)
    with (
        torch.inference_mode(False),  # a caller's own mode would end the first step
        torch.enable_grad(),
        timed() as clock,
        folder as held,
        stages as progress,
        told_of_compiling(lambda name: progress("compiling kernels, once on this machine, for up to a minute")) as compiled,
        contextlib.ExitStack() as beside,
    ):
        resume = resume and out is not None and (out / CONFIG).is_file()  # else the folder holds only found poses
        if out is not None and resume:
            folders.read_record(out)  # a run of another version is refused before anything takes time
        with clock("kernels"):
            chosen, where = choose_device(device)
            if ranks.first:
                beside.enter_context(compiled_ahead(chosen))
        began = time.perf_counter()
        lpips = None
        if lpips_weights is not None:
            with section("scoring"):
                lpips = Lpips(Path(lpips_weights), chosen)
        read, request, parts, found = _read(scene, split, chosen, out, progress, ranks)
        job = FitJob(
            scene=read, request=request, split=parts, config=config, device=chosen, where=where, out=own, lpips=lpips,
            notes=[*notes, *origin, *held, *found], verbose=verbose, on_step=on_step, on_model=on_model, ranks=ranks,
            began=began, clock=clock, progress=progress, compiled=compiled,
        )  # fmt: skip
        with section("set-up"):
            _settle(job, time_budget)
        threads, stopped = beside.enter_context(ThreadPoolExecutor(2)), threading.Event()
        beside.callback(stopped.set)
        views = itertools.takewhile(lambda _: not stopped.is_set(), read.views)
        # only now: a time budget is measured without another thread
        hashed = threads.submit(lambda: read.fingerprint if isinstance(scene, Scene) else fingerprint(views))
        compared = threads.submit(
            lambda: (
                [] if job.other_models else check_photos(in_threads(without_masked, (*job.train, *job.test)), stopped.is_set)
            )
        )
        trainer, record = _prepare(job, out if resume else None, hashed.result)
        with section("photo checks"):
            if not compared.done():
                progress("comparing photographs")
            checks = compared.result()
        if own is not None and not resume:
            with section("writing"):
                write_json(own / CONFIG, record)
        result = _finish(job, trainer, record, checks)
    ranks.leave()
    return result


def _checked_source(scene: Scene | SceneRequest | str | Path, split: str | None) -> Scene | SceneRequest:
    """Return a checked scene, or the request to read one, with its split."""
    if isinstance(scene, (str, Path)):
        scene = SceneRequest(str(scene))
    if not isinstance(scene, (Scene, SceneRequest)):
        raise UsageError(f"scene must be a Scene or a folder, not {type(scene).__name__}; give Scene(path, format, views)")
    if isinstance(scene, SceneRequest):
        scene = replace(scene, split=scene.split if split is None else split)
        split = scene.split
    if split is not None:
        check_spec(split)
    return checked_scene(scene) if isinstance(scene, Scene) else scene


def _read(
    scene: Scene | SceneRequest, split: str | None, device: torch.device, out: Path | None, progress: Say, ranks: Ranks
) -> tuple[Scene, SceneRequest, Split, list[str]]:
    """Read a scene, without its fingerprint, and find its poses where it has none; return it with request, split and notes."""
    if isinstance(scene, Scene):
        parts, notes = choose_split(scene, split)
        read, request, notes = scene, SceneRequest("", split, downscale=1).with_scale(device.type), [*scene.notes, *notes]
    else:
        with section("poses"):
            request, poses = with_poses(scene.with_scale(device.type), out, progress, ranks.count)
        progress(f"reading {request.path}")
        with section("reading"):
            read, parts, notes = read_scene(request, progress, hashed=False)
        notes = [*poses, *notes]
    return read, request, parts, notes + ([] if out is None else renaming_notes(image_names(v.name for v in read.views)))


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


def fit_request(request: FitRequest, **others: Any) -> FitResult:
    """Run `fit` for the command line, a study or a farm; ``others`` are on_model, on_step and ranks of `fit`."""
    r = request
    try:
        return fit(
            r.scene, r.config, out=r.out, device=r.device, resume=r.resume, lpips_weights=r.lpips_weights,
            time_budget=r.time_budget, notes=r.notes, **others,
        )  # fmt: skip
    except KeyboardInterrupt as e:
        saved = r.out is not None and (r.out / TENSORS).is_file()
        again = "the fit is saved, --resume continues it" if saved else "no step was saved: run the same command again"
        raise KeyboardInterrupt(again) from e


def _prepare(job: FitJob, resumed: Path | None, hashed: Callable[[], str]) -> tuple[Trainer, dict[str, Any]]:
    """Return the trainer, which continues the run ``resumed``, and the record of the run."""

    def recorded() -> dict[str, Any]:
        job.scene = replace(job.scene, fingerprint=hashed())  # of the scene as it was read
        return folders.record_of(job.request, job.config, job.scene, job.split, job.notes, job.device)

    record, state = recorded() if resumed is not None or job.ranks.count > 1 else None, None
    if record is not None and resumed is not None:
        stored = folders.read_record(resumed)
        folders.check_same(record, stored, resumed)
        if job.out is not None and record["scene"]["path"] != stored["scene"]["path"]:  # the scene was moved
            write_json(job.out / CONFIG, stored | {"scene": record["scene"]})
        job.scene = replace(job.scene, normalization=similarity_of(stored["normalization"], str(resumed / CONFIG)))
        if (resumed / TENSORS).is_file():
            state = folders.load_checkpoint(resumed)
            folders.check_checkpoint(state[1], stored, resumed)
            if state[1]["step"] == state[1].get("steps"):
                job.say(f"  all {state[1]['step']:,} steps are taken; only the images, scores and report are made again")
    if record is not None:
        check_equal(record, None if state is None else state[1].get("step"), job.ranks)
    with background_warmup(job.config, job.device) as ready:
        if job.other_models:
            models = " and ".join(job.other_models)
            job.notes.append(f"camera model {models}: views cannot be compared, so blur, exposure and coverage are not checked")
        of = job.train, job.scene.points, job.config, job.device, job.scene.background
        with section("set-up"):
            trainer = Trainer(*of, ready=ready, progress=job.progress, ranks=job.ranks)
    if job.device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(job.device)  # report the steps' memory, not that of the start or of an earlier fit
    if state is not None:
        try:
            trainer.load(*state)
        except DataError as e:
            raise DataError(f"{resumed}/{TENSORS}: {e}") from e
        job.notes.append(f"continued from step {trainer.step}; this run's times count from there")
    return trainer, record or recorded()


def _finish(job: FitJob, trainer: Trainer, record: dict[str, Any], checks: list[PhotoCheck]) -> FitResult:
    """Print the scene and all automatic choices, take the steps, score the model, and write the run folder, if any."""
    chosen, camera = [*job.notes, *photo_notes(checks), *trainer.notes], job.train[0].camera
    counts = f"{len(job.train)} views to fit, {len(job.test)} held out"
    job.say(f"{job.scene.path}: {job.scene.format}, {counts}, {camera.width} x {camera.height} px, {job.where}")
    job.notes = []
    job.note(*chosen, *batched_notes(job.config, job.ranks), plan_summary(trainer.memory), *planned_times(job, trainer)[1])
    setup = time.perf_counter() - job.began
    take_steps(job, trainer)
    seconds = {"setup": setup, "training": time.perf_counter() - job.began - setup}
    job.ranks.part()
    metrics: dict[str, Any] = {}
    if job.ranks.first:
        given = folders.cameras_of(job.scene)
        job.scene = folders.with_cameras(job.scene, job.cameras(trainer))
        if job.out is not None:
            model, path = drop_unused_sh(trainer.gaussians), job.out / "point_cloud.ply"
            with section("writing"):
                write_ply(path, model, job.scene.normalization, antialiased=job.config.antialiased)
            job.say(f"model: {path}; scores and report follow")
        renders = Renders(trainer.gaussians, trainer.context.render_options())
        with section("checks"), ThreadPoolExecutor(1) as thread:
            # for the report, of which it takes the longest
            sampled = thread.submit(lambda: None if job.out is None else results.sampling_report_of(trainer, job.out))
            metrics = _score(job, trainer, seconds, given, checks, renders)
        metrics["wall_seconds"] = job.clock.seconds()
        job.notes += pose_tasks(job.out)
        if job.out is not None:
            with section("writing"):
                write_json(job.out / METRICS_FILE, metrics)
            record["notes"] = job.notes
            with section("report"):
                results.write_report(
                    job.out, job.scene, job.split, renders, metrics, record, title=title_of(Path(job.scene.path), job.out),
                    sampling=sampled.result, times=job.clock.seconds, tell=job.progress,
                )  # fmt: skip
            metrics["wall_seconds"] = job.clock.seconds()
            write_json(job.out / METRICS_FILE, metrics)  # again, with the time of the report
        for line in results.result_lines(metrics, job.out, [n for n in job.notes if isinstance(n, Task)]):
            job.say(line)
    return FitResult(**job.model(trainer), config=job.config, metrics=metrics, notes=tuple(job.notes), folder=job.out)


SHARP = 0.1
"""Least part of `steps_by_views` after which views are compared for moving objects. In static scenes, blurred edges were
reported at .01 and .05 of them."""


def _score(
    job: FitJob,
    trainer: Trainer,
    seconds: dict[str, float],
    given: dict[str, Camera],
    checks: list[PhotoCheck],
    renders: Renders,
) -> dict[str, Any]:
    """Score the finished fit, with the ``given`` cameras from before it; returns the contents of metrics.json."""
    c, scene, train, test, gaussians, options = job.config, job.scene, job.train, job.test, renders.gaussians, renders.options
    peak = {"peak_torch_bytes": torch.cuda.max_memory_allocated(job.device)} if job.device.type == "cuda" else {}
    names, learned = image_names(v.name for v in scene.views), trainer.learned
    tell, compare, scored = job.progress, not job.other_models, (job.out, renders, train, test)
    with ThreadPoolExecutor(1) as thread:
        covered = test and compare and thread.submit(coverage_of_run, *scored, names=names)
        try:
            with section("scoring"):
                metrics = results.evaluate_run(*scored, job.lpips, names=names, tell=tell)
            if covered:
                tell("checking coverage")
                with section("coverage"):
                    metrics["coverage"] = covered.result()
        except BaseException:  # an interrupt does not wait for all of the coverage
            renders.ended = True
            raise
    tell("checking float32 accuracy")
    rule = results.rule_report_of(gaussians, train, options, seed=c.seed, half_resolution=trainer.half_resolution)
    shape = shape_figures(gaussians, c.limits, trainer.radius, trainer.context.extent, [v.camera for v in train])
    moved: dict[str, float] = {}
    if compare and trainer.step * c.batch >= SHARP * steps_by_views(len(train), not scene.transparent, trainer.cutout):
        shown = counted(train, tell, "checking for moving objects", "views")
        moved = {v.name: f for v, f in zip(train, moved_fractions(train, (renders(v.camera) for v in shown)), strict=True)}
    complexity, cameras, scale = complexity_figures(trainer), folders.cameras_of(scene), scene.normalization.scale
    modules = {
        m.name: m.figures(FittedViews(learned.params_of(m), job.split.train, test, given, cameras, scale, gaussians, options))
        for m in learned.modules
    }
    mapped = results.given_figures(train, trainer.views, renders)
    table: list[tuple[dict[str, Any], list[str]]] = [  # figures of metrics.json, and their sentences in the report
        ({"rule": rule}, [Detail(rule["summary"])]),
        ({"shape": shape}, [Detail(shape_summary(shape))]),
        (complexity, [Detail(complexity_summary(complexity))]),
        ({"photographs": [vars(p) | {"moved": moved.get(p.name)} for p in checks]}, []),
        ({"view_modules": modules}, [e["summary"] for e in modules.values()]),
        ({"start": next((n for n in trainer.notes if n.startswith("start: ")), "")}, []),
        ({"given": mapped}, [e["summary"] for e in mapped.values()]),
    ]
    for figures, sentences in table:
        metrics |= figures
        job.note(*sentences)
    job.notes += moved_notes(moved)
    compiling = {"compiling": sum(job.compiled)} if job.compiled else {}
    return metrics | peak | results.event_figures(trainer) | {
        "protocol": results.protocol_of(scene, job.request.split, job.request.downscale or 1, train, test),
        "steps": trainer.step, "batch": c.batch, "ranks": job.ranks.count,
        "gaussians": len(gaussians), "preset": c.preset, "seed": c.seed,
        "config_hash": c.fingerprint(), "fingerprint": scene.fingerprint, "device": job.where.removeprefix("on "),
        "seconds": {**seconds, **compiling, "total": time.perf_counter() - job.began}, "memory": trainer.memory,
    }  # fmt: skip
