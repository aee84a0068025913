"""A run folder: set up, filled by a fit, read again by eval, render and export."""

from __future__ import annotations

import contextlib
import importlib.metadata
import json
import platform
import signal
import threading
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from warpgs import __version__
from warpgs.errors import DataError, ResourceError, UsageError, WarpgsError
from warpgs.export.ply import write_ply
from warpgs.files import write_json
from warpgs.io.load import load_scene
from warpgs.io.splits import Split, coincident_views, default_split, split_views
from warpgs.pipeline.metrics.lpips import load_lpips
from warpgs.pipeline.model.compress import drop_unused_sh
from warpgs.pipeline.model.parameter_bounds import unpack
from warpgs.pipeline.runs.checkpoint import load_checkpoint, save_checkpoint
from warpgs.pipeline.runs.results import evaluate_run, protocol_of, score_line, write_report
from warpgs.pipeline.runs.rule_report import rule_report_of
from warpgs.pipeline.runs.sampling_report import event_figures, images_kept, sampling_report_of
from warpgs.pipeline.train.complexity import complexity_figures, complexity_summary
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.time_budget import within_budget
from warpgs.pipeline.train.trainer import StepReport, Trainer, run, train_views
from warpgs.pipeline.train.warmup import rehearsal
from warpgs.report.events import EventLog
from warpgs.report.progress import Progress
from warpgs.scene import Camera, Gaussians, Normalization, Scene

CONFIG = "config.json"


@dataclass(frozen=True)
class SceneRequest:
    """What to read, and how."""

    path: str
    split: str | None = None
    downscale: int = 1
    strict: bool = False
    allow_outside: bool = False
    invert_masks: bool = False
    score_masks: str | None = None
    """Folder of object masks for scoring, matched by image id; None for the scene's own `idrmasks`, if any."""


@dataclass(frozen=True)
class FitRequest:
    """Everything that `warpgs fit` was asked for."""

    scene: SceneRequest
    out: Path
    config: FitConfig
    device: str
    resume: bool = False
    lpips_weights: Path | None = None
    """File of `warpgs convert-lpips`; without one LPIPS is not measured."""
    time_budget: float | None = None
    """Seconds that the fit may take, by which its steps are chosen; None to take those of ``config``. Not with ``resume``."""
    notes: tuple[str, ...] = ()
    """What was chosen for the user before."""


def choose_device(name: str) -> tuple[torch.device, str]:
    """The device for auto, cpu or cuda, and a sentence on it.

    Raises:
        ResourceError: CUDA was asked for and is not there.
        UsageError: The name is none of the three.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise UsageError(f"device {name!r} is not one of auto, cpu, cuda")
    if name == "cuda" and not torch.cuda.is_available():
        raise ResourceError("--device cuda: torch sees no CUDA device here; `warpgs doctor` says why. Use --device cpu")
    if name != "cpu" and torch.cuda.is_available():
        return torch.device("cuda", torch.cuda.current_device()), f"on {torch.cuda.get_device_name()}"
    return torch.device("cpu"), f"on the CPU, {torch.get_num_threads()} threads"


def versions() -> dict[str, str]:
    """Versions of what a result depends on."""
    names = ("torch", "warp-lang", "numpy", "opencv-contrib-python-headless", "scikit-image", "safetensors")
    found = {"warpgs": __version__, "python": platform.python_version(), "system": platform.platform(terse=True)}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = "not installed as a package"
    return found


def read_scene(request: SceneRequest) -> tuple[Scene, Split, list[str]]:
    """Load a scene and split its views; returns both with the notes for the user."""
    scene = load_scene(
        request.path, downscale=request.downscale, strict=request.strict,
        allow_outside=request.allow_outside, invert_masks=request.invert_masks, score_masks=request.score_masks,
    )  # fmt: skip
    if request.split is None:
        split, note = default_split(scene)
        notes = [*scene.notes, note]
    else:
        split, notes = split_views(scene, request.split), list(scene.notes)
    if (request.split or "").startswith("dtu:") and any(v.mask is not None for v in scene.views):
        notes.append(
            "masks hide pixels from the fit, which the published DTU protocol does not do: object masks that only scores "
            "should see belong into a folder idrmasks, or behind --score-masks"
        )
    for test, train in coincident_views(scene, split):
        notes.append(f"{test} is held out, but {train} was taken from the same place: its score says nothing of new views")
    return scene, split, notes


def _prepare_folder(out: Path, resume: bool) -> None:
    if resume:
        if not (out / CONFIG).is_file():
            raise UsageError(f"--resume: {out} holds no {CONFIG}, so there is no run to continue; leave out --resume")
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise UsageError(f"{out} exists already; choose another --out, or continue that run with --resume")
    try:
        out.mkdir(parents=True, exist_ok=True)
        probe = out / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as e:
        raise ResourceError(f"{out}: cannot be written ({e.strerror}); choose another --out") from e


def _camera_values(camera: Camera) -> dict:
    return {"viewmat": camera.viewmat.tolist(), "K": camera.K.tolist(), "width": camera.width, "height": camera.height}


def _record(request: FitRequest, scene: Scene, split: Split, notes: list[str], device: torch.device) -> dict:
    return {
        "scene": {**asdict(request.scene), "path": str(Path(request.scene.path).resolve())},
        "format": scene.format, "fingerprint": scene.fingerprint,
        "train": split.train, "test": split.test, "notes": notes,
        "normalization": {"offset": scene.normalization.offset.tolist(), "scale": scene.normalization.scale},
        "background": scene.background, "config": request.config.to_json(), "config_hash": request.config.fingerprint(),
        "device": device.type, "versions": versions(),
        "cameras": {v.name: _camera_values(v.camera) for v in scene.views},
    }  # fmt: skip


def _check_same(record: dict, stored: dict, out: Path) -> None:
    """A continued run must be the same run: same data, views, settings and kind of device."""
    if "pruned" in stored:
        raise UsageError(
            f"--resume: {out} is a pruned model without the state of its fit; continue the run it came from, "
            f"{stored['pruned']['source']}"
        )
    for key in ("fingerprint", "train", "test", "config", "device"):
        now, then = json.loads(json.dumps(record[key])), stored.get(key)
        if now != then:
            if isinstance(now, dict) and isinstance(then, dict):
                changed = [k for k in now if now[k] != then.get(k)]
                key = f"{key} ({', '.join(changed)})"
            raise UsageError(
                f"--resume: {key} differs from the run in {out}; give the flags it was started with, or a new --out"
            )


def fit_scene(request: FitRequest) -> dict:
    """Fit a scene and fill the run folder: configuration, log, checkpoint, PLY, pictures, scores, report.

    Prints what was chosen for the user, progress, and where the results are.

    Returns:
        The contents of metrics.json.

    Raises:
        WarpgsError: Anything that a user can mend; before training wherever it can be known by then.
    """
    began = time.perf_counter()
    out = request.out
    _prepare_folder(out, request.resume)
    tensors, plain = {}, None
    try:
        device, where = choose_device(request.device)
        lpips = None if request.lpips_weights is None else load_lpips(request.lpips_weights, device)
        scene, split, notes = read_scene(request.scene)
        train, test = train_views(scene, split.train), train_views(scene, split.test)
        if request.time_budget is not None:
            config, note = within_budget(request.config, request.time_budget, train, device)
            request, notes = replace(request, config=config), [*notes, note]
        notes = [*request.notes, *notes]
        record = _record(request, scene, split, notes, device)
        if request.resume:
            _check_same(record, json.loads((out / CONFIG).read_text("utf-8")), out)
            if (out / "checkpoint.safetensors").is_file():
                tensors, plain = load_checkpoint(out)
        c = request.config
        with rehearsal(c, device) as ready:
            fit = Trainer(train, scene.points, c, device, scene.background, ready=ready)
        if device.type == "cuda":
            torch.cuda.reset_peak_memory_stats(device)  # the steps' need is told, not the start's or an earlier fit's
    except WarpgsError:
        if not request.resume:
            out.rmdir()  # nothing is in it yet
        raise
    if not request.resume:
        write_json(out / CONFIG, record)
    if plain is not None:
        fit.load(tensors, plain)
        notes.append(f"continued from step {fit.step}")
    notes += [*fit.notes, fit.memory.sentence()]
    size = f"{train[0].camera.width} x {train[0].camera.height} px"
    print(f"{scene.path}: {scene.format}, {len(train)} views to fit, {len(test)} held out, {size}, {where}")
    for note in notes:
        print(f"  {note}")

    setup = time.perf_counter() - began
    with images_kept(fit, [v.name for v in train], out):
        _train(fit, out, notes)
    trained = time.perf_counter() - began - setup
    peak = {"peak_torch_bytes": torch.cuda.max_memory_allocated(device)} if device.type == "cuda" else {}
    write_ply(out / "point_cloud.ply", drop_unused_sh(fit.gaussians), scene.normalization)
    metrics = evaluate_run(out, fit.gaussians, train, test, request.config.rule, scene.background, lpips, fit.max_instances)
    c = request.config
    trade = rule_report_of(
        fit.gaussians,
        train,
        c.rule,
        scene.background,
        seed=c.seed,
        half_resolution=c.half_resolution,
        max_instances=fit.max_instances,
    )
    notes.append(trade["sentence"])
    print(f"  {notes[-1]}")
    metrics |= {
        "protocol": protocol_of(scene, request.scene.split, request.scene.downscale, train, test),
        "steps": fit.step, "gaussians": len(fit.gaussians), "preset": request.config.preset, "seed": request.config.seed,
        "config_hash": request.config.fingerprint(), "fingerprint": scene.fingerprint, "device": where.removeprefix("on "),
        "seconds": {"setup": setup, "training": trained, "total": time.perf_counter() - began}, **peak,
        "memory": fit.memory.to_json(), "trade": trade, **event_figures(fit), **complexity_figures(fit),
    }  # fmt: skip
    write_json(out / "metrics.json", metrics)
    record["notes"] = notes
    write_report(out, scene, split, fit.gaussians, metrics, record, sampling_report_of(fit, out))
    _print_result(out, metrics)
    return metrics


@contextlib.contextmanager
def _stop_signals():
    """Let Ctrl-C and SIGTERM end the fit after the step in progress; a second one ends it at once.

    Gives a function that says whether one came. Elsewhere than in the main thread signals cannot be caught and act as ever.
    """
    came = False
    if threading.current_thread() is not threading.main_thread():
        yield lambda: came
        return

    def note(*_) -> None:
        nonlocal came
        came = True
        signal.signal(signal.SIGINT, signal.default_int_handler)

    before = {s: signal.signal(s, note) for s in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield lambda: came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _train(fit: Trainer, out: Path, notes: list[str]) -> None:
    log = EventLog(out / "metrics.jsonl", fit.step)

    def save(current: Trainer) -> None:
        log.flush()
        save_checkpoint(out, *current.state())

    with Progress(fit.config.steps, fit.step) as progress:

        def on_step(r: StepReport) -> None:
            progress.update(step=r.step, loss=r.loss, psnr=r.psnr, count=r.count)
            log.write(step=r.step, loss=r.loss, psnr=r.psnr, count=r.count, seconds=round(r.seconds, 6))
            while fit.messages:
                notes.append(fit.messages.pop(0))
                print(f"  {notes[-1]}")

        try:
            with _stop_signals() as stopped:
                run(fit, on_step, save, stopped)
        finally:
            log.close()


def _print_result(out: Path, metrics: dict) -> None:
    if metrics["test"]:
        scores = metrics["test"]
        print(f"held-out {score_line(scores)} over {len(metrics['views'])} views")
        for name, value in metrics["baselines"].items():
            print(f"  without a fit, the {name.replace('_', ' ')} scores {value:.2f} dB")
    print(complexity_summary(metrics))
    print(f"{metrics['gaussians']:,} Gaussians; report: {out / 'report.html'}  pictures: {out / 'renders'}")


@dataclass(frozen=True)
class StoredRun:
    """What a run folder holds."""

    folder: Path
    record: dict
    gaussians: Gaussians
    cameras: dict[str, Camera]
    step: int
    """Steps done when the checkpoint was written."""

    @property
    def normalization(self) -> Normalization:
        """How scene coordinates came from those of the files."""
        n = self.record["normalization"]
        return Normalization(np.array(n["offset"]), n["scale"])


def open_run(folder: Path, device: torch.device) -> StoredRun:
    """Read a finished or interrupted run.

    Raises:
        DataError: The folder is no run folder, or its checkpoint is not whole.
    """
    path = folder / CONFIG
    try:
        record = json.loads(path.read_text("utf-8"))
        cameras = {
            n: Camera(np.array(c["viewmat"]), np.array(c["K"]), c["width"], c["height"]) for n, c in record["cameras"].items()
        }
    except (OSError, ValueError, KeyError, TypeError) as e:
        raise DataError(f"{path}: cannot be read ({e}); give a folder that `warpgs fit --out` filled") from e
    tensors, state = load_checkpoint(folder)
    if "params.sh_packed" in tensors:
        tensors["params.sh"] = unpack(tensors["params.sh_packed"], tensors["degrees"])
    gaussians = Gaussians(**{n: tensors[f"params.{n}"].to(device) for n in Gaussians.__dataclass_fields__})
    return StoredRun(folder, record, gaussians, cameras, state["step"])
