"""Fits with several views and processes per step: checks before work starts, and notes for the user."""

from __future__ import annotations

from pathlib import Path

from warpgs.errors import UsageError
from warpgs.pipeline.runs.request import SceneRequest
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.slots import check_ranks, own_slots
from warpgs.poses.find import needs_poses
from warpgs.runtime.ranks import Ranks
from warpgs.scene import Scene


def check_batched(
    scene: Scene | SceneRequest | str | Path, config: FitConfig, ranks: Ranks, time_budget: float | None, resume: bool
) -> None:
    """Check that the processes can share a fit.

    Args:
        scene: The scene, as in `warpgs.fit`.
        config: Settings.
        ranks: The processes.
        time_budget: Time that the fit may take [s]; None for no limit.
        resume: Whether a run is continued.

    Raises:
        UsageError: A step has fewer views than there are processes, or each process would choose settings or find poses of its
            own.
    """
    check_ranks(config.batch, ranks)
    if ranks.count == 1:
        return
    path = None if isinstance(scene, Scene) else Path(scene.path if isinstance(scene, SceneRequest) else scene)
    if path is not None and not resume and needs_poses(path):
        raise UsageError(
            f"{path}: has no cameras, and {ranks.count} ranks would each find poses of their own; find them once with `warpgs "
            f"poses {path} --out SCENE`, and fit that"
        )
    if time_budget is not None:
        raise UsageError(
            f"--time-budget measures the speed of one process, and {ranks.count} would choose different steps: give --steps"
        )


def batched_notes(config: FitConfig, ranks: Ranks) -> list[str]:
    """Return sentences on views and processes of a step, none for one view."""
    if config.batch == 1:
        return []
    notes = [
        f"batch: each of the {config.steps:,} steps renders {config.batch} views and takes the mean of their gradients; "
        f"learning rates are those of one view times {config.batch**0.5:.3g}"
    ]
    if ranks.count > 1:
        counts = sorted({len(own_slots(config.batch, ranks.count, rank)) for rank in range(ranks.count)})
        notes.append(
            f"ranks: {ranks.count} processes by {ranks.backend}, each renders {' or '.join(map(str, counts))} of the views of "
            "a step; the model is the same to the bit for any number of them"
        )
    return notes
