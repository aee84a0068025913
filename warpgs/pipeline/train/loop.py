"""The loop around the training steps: reports, checkpoints, stops, and a second try of a step that runs out of memory."""

from __future__ import annotations

import time
from collections.abc import Callable

from warpgs.errors import OutOfMemoryError, ResourceError
from warpgs.pipeline.train.step_report import StepReport
from warpgs.pipeline.train.trainer import Trainer
from warpgs.scene import Scene, View


def train_views(scene: Scene, names: tuple[str, ...]) -> list[View]:
    """Return the named views of a scene, in the order of the names."""
    return [scene.view(n) for n in names]


def run(
    trainer: Trainer,
    on_step: Callable[[StepReport], None],
    save: Callable[[Trainer], None],
    stopped: Callable[[], bool],
    restore: Callable[[Trainer], bool] = lambda _: False,
) -> None:
    """Take all remaining steps; report each, and save at intervals and at the end.

    A step that runs out of memory is tried once more with less memory (`Trainer.spare_memory`). If the state is incomplete, for
    example during a change of the set of Gaussians, the fit continues from the last saved state. With several processes there
    is no second try, because one process would be alone in that step.

    Args:
        trainer: The fit.
        on_step: Called after each step.
        save: Saves the state.
        stopped: Returns whether to end after the current step.
        restore: Loads the last saved state; returns False without one.

    Raises:
        NotFiniteError: The loss, or the state to save, is not finite; the state is not saved.
        OutOfMemoryError: A step ran out of memory, and a second try failed or was not possible; a complete state before the
            step is saved.
        KeyboardInterrupt: ``stopped`` returned True after a step; the state after it is saved.
    """
    every, saved, ran_out = trainer.config.checkpoint_every, time.monotonic(), -1
    while trainer.step < trainer.steps:
        reports, failure = [], None
        try:
            reports = trainer.advance(every - trainer.step % every)
        except OutOfMemoryError as e:
            failure = e.with_traceback(None)  # whose frames hold tensors
            failure.__cause__ = failure.__context__ = None
        if failure is not None:
            again, ran_out = trainer.step > ran_out and trainer.ranks.count == 1, trainer.step
            try:
                if not again or not (failure.intact or restore(trainer)):
                    raise failure
                trainer.spare_memory()
            except ResourceError:
                if failure.intact:
                    save(trainer)
                raise
            continue
        for report in reports:
            on_step(report)
        stop = trainer.taker.agreed(stopped())
        due = trainer.step % every == 0 and time.monotonic() - saved >= trainer.config.checkpoint_seconds
        if stop or due or trainer.step == trainer.steps:
            save(trainer)
            saved = time.monotonic()
        if stop:
            trainer.ranks.leave()
            raise KeyboardInterrupt
