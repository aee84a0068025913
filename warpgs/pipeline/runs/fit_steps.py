"""The steps of a fit: progress for the user, log, checkpoints, and the end of a fit with a non-finite loss."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

from warpgs.errors import NotFiniteError
from warpgs.pipeline.model.model_file import FittedModel
from warpgs.pipeline.runs.checkpoint import TENSORS, load_checkpoint, save_checkpoint
from warpgs.pipeline.runs.failed_step import FILE as FAILED
from warpgs.pipeline.runs.failed_step import broken_terms, failed_step, save_failed_step
from warpgs.pipeline.runs.folder import camera_values
from warpgs.pipeline.runs.job import FitJob
from warpgs.pipeline.runs.learned_views import cameras_of, learned_cameras
from warpgs.pipeline.train.loop import run
from warpgs.pipeline.train.step_report import StepReport
from warpgs.pipeline.train.trainer import Trainer
from warpgs.plugins import is_ours
from warpgs.report.events import EventLog
from warpgs.report.progress import Progress
from warpgs.runtime.stop_signals import noted_signals
from warpgs.scene import Camera, Gaussians, Normalization

Names = tuple[str, ...]


class RunRecorder:
    """Log and checkpoints of a fit in its run folder; nothing is written without a folder."""

    def __init__(self, job: FitJob, step: int, images_written: Callable[[], None]):
        """Open the log after ``step``; ``images_written`` waits for the images before a checkpoint is written."""
        self.job, self.images_written = job, images_written
        self.log = None if job.out is None else EventLog(job.out / "metrics.jsonl", step)

    def write(self, r: StepReport) -> None:
        """Write a step to the log."""
        if self.log is not None:
            self.log.write(step=r.step, loss=r.loss, psnr=r.psnr, count=r.count, seconds=round(r.seconds, 6))

    def save(self, trainer: Trainer) -> None:
        """Save the state as a checkpoint, after the log and the images of earlier steps are written."""
        job = self.job
        if job.out is None or self.log is None:
            return
        self.log.flush()
        self.images_written()
        tensors, state = trainer.state()
        if trainer.config.view_modules:  # by which a run is opened without their code
            cameras = learned_cameras(job.scene, job.split, trainer.learned.views)
            state["cameras"] = {n: camera_values(c) for n, c in cameras.items()}
        save_checkpoint(job.out, tensors, state | {"fingerprint": job.scene.fingerprint, "train": job.split.train})

    def restore(self, trainer: Trainer) -> bool:
        """Load the last checkpoint, and truncate the log to it; returns False without a checkpoint."""
        out = self.job.out
        if out is None or self.log is None or not (out / TENSORS).is_file():
            return False
        trainer.load(*load_checkpoint(out))
        self.log.rewind(trainer.step)
        return True

    def close(self) -> None:
        """Close the log."""
        if self.log is not None:
            self.log.close()


class StepTeller:
    """Receiver of each step's report, for the terminal, the log and the caller."""

    def __init__(self, job: FitJob, trainer: Trainer, recorder: RunRecorder, progress: Progress | None):
        """Start before the first step; ``progress`` is None for a fit without a display of progress."""
        self.job, self.trainer, self.recorder, self.progress = job, trainer, recorder, progress
        self.slow, self.compiled = -1, -1
        """The last step that was slow because it compiled kernels; the number of kernels compiled by then."""

    def __call__(self, r: StepReport) -> None:
        """Take one report."""
        job, trainer = self.job, self.trainer
        if len(job.compiled) > self.compiled:
            self.slow, self.compiled = trainer.step, len(job.compiled)
        if self.progress is not None:
            self.progress.total = trainer.steps  # fewer, once the fit is known to end earlier
            seconds = None if r.step <= self.slow else r.seconds
            self.progress.update(step=r.step, loss=r.loss, psnr=r.psnr, count=r.count, seconds=seconds)
        self.recorder.write(r)
        tell(job, trainer)
        if job.on_step is not None:
            job.on_step(r)
        if job.on_model is not None:
            model = FittedModel(
                *model_fields(job, trainer), transparent=job.scene.transparent, antialiased=job.config.antialiased
            )
            job.on_model(model)


def take_steps(job: FitJob, trainer: Trainer, images_written: Callable[[], None]) -> None:
    """Take all remaining steps, with a log and checkpoints if there is a run folder; images are written before a checkpoint.

    Raises:
        NotFiniteError: A loss or the state is not finite; with a run folder, the state before the step is saved.
        KeyboardInterrupt: A signal ended the fit; the state is saved.
    """
    recorder = RunRecorder(job, trainer.step, images_written)
    shown = Progress(trainer.steps, trainer.step) if job.verbose else contextlib.nullcontext()
    with shown as progress, contextlib.closing(recorder):
        try:
            with noted_signals() as stopped:
                run(trainer, StepTeller(job, trainer, recorder, progress), recorder.save, stopped, recorder.restore)
        except NotFiniteError as e:
            if e.view is None:
                raise
            if job.out is None:
                job.ranks.leave()  # all ranks have this loss; the first reports it
                raise
            failed = _saved_failure(job.out, job, trainer, e)
            recorder.save(trainer)
            raise failed from e


def _saved_failure(out: Path, job: FitJob, trainer: Trainer, error: NotFiniteError) -> NotFiniteError:
    """Save the inputs of a step with a non-finite loss; returns the error for the user."""
    assert error.view is not None
    name = job.split.train[error.view]
    bundle = failed_step(trainer, error.view, name, error.slot)
    save_failed_step(out / FAILED, bundle)
    broken = broken_terms(bundle)
    own = [t.name for t in trainer.terms if t.name in broken and not is_ours(type(t))]
    where = f", in the loss term {' and '.join(broken)}" if broken else ""
    mend = f"correct {' and '.join(own)}, and fit again" if own else "fit again with lower learning rates"
    names = "names the non-finite values of the other terms" if own else "names the non-finite values"
    return NotFiniteError(
        f"{error}, on {name}{where}. The state before the step and its inputs are saved; `warpgs doctor --repeat "
        f"{out / FAILED}` {names}. --resume would fail at the same step; {mend} into a new --out"
    )


def model_fields(
    job: FitJob, trainer: Trainer
) -> tuple[Gaussians, Normalization, dict[str, Camera], Names, Names, str, tuple[float, float, float], int]:
    """Return the fields of the current `FittedModel` of a fit."""
    cameras = cameras_of(job.scene)
    names, rule = (job.split.train, job.split.test), job.config.rule
    return trainer.gaussians, job.scene.normalization, cameras, *names, rule, job.scene.background, trainer.step


def tell(job: FitJob, trainer: Trainer) -> None:
    """Print the messages of the fit, and keep them for the report."""
    while trainer.messages:
        trainer.notes.append(trainer.messages.pop(0))  # a continued run has them in its report, too
        job.note(trainer.notes[-1])
