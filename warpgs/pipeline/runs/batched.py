"""Fits with several views and processes per step: checks before work starts, and notes for the user."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

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
        UsageError: A step has fewer views than processes, or each process would choose its own settings or find its own poses.
    """
    check_ranks(config.batch, ranks)
    if ranks.count == 1:
        return
    path = None if isinstance(scene, Scene) else Path(scene.path if isinstance(scene, SceneRequest) else scene)
    if path is not None and not resume and needs_poses(path):
        raise UsageError(
            f"{path}: has no cameras, and each of {ranks.count} ranks would find its own poses; run `warpgs poses {path} --out "
            "SCENE` first, and fit SCENE"
        )
    if time_budget is not None:
        raise UsageError(
            f"--time-budget: each of {ranks.count} ranks would measure its own speed and choose other steps; give --steps"
        )


def check_equal(record: dict[str, Any], step: int | None, ranks: Ranks) -> None:
    """Check that all processes fit the same scene with the same settings, because each takes a part of the same steps.

    Args:
        record: Record of the run, as this process has it.
        step: Step of the checkpoint to continue from; None without one.
        ranks: The processes.

    Raises:
        UsageError: A process differs from the first one; raised in every process.
    """
    if ranks.count == 1:
        return
    parts = {
        "a different version of warpgs": (record["versions"]["warpgs"], "install the same version everywhere"),
        "a different scene": (record["fingerprint"], "give all ranks the same files and options for reading"),
        "a different split": ([record["train"], record["test"]], "give all ranks the same --split"),
        "different settings": ([record["config"], record["own_code"]], "start all ranks with the same flags and the same code"),
        "a different checkpoint": (step, "give all ranks the same --out, on a file system that all machines share"),
    }
    own = {name: hashlib.sha256(json.dumps(value, sort_keys=True).encode()).hexdigest() for name, (value, _) in parts.items()}
    first, *others = map(json.loads, ranks.texts(json.dumps(own)))
    for rank, other in enumerate(others, 1):
        for name, (_, fix) in parts.items():
            if other.get(name) != first.get(name):
                raise UsageError(f"rank {rank} has {name} than rank 0: {fix}")


def batched_notes(config: FitConfig, ranks: Ranks) -> list[str]:
    """Return sentences on views and processes of a step; empty if a step has one view."""
    if config.batch == 1:
        return []
    notes = [
        f"batch: each of the {config.steps:,} steps renders {config.batch} views and averages their gradients; "
        f"learning rates are {config.batch**0.5:.3g} times those for one view"
    ]
    if ranks.count > 1:
        counts = sorted({len(own_slots(config.batch, ranks.count, rank)) for rank in range(ranks.count)})
        notes.append(
            f"ranks: {ranks.count} processes ({ranks.backend}); each renders {' or '.join(map(str, counts))} views of a step; "
            "the model has the same bits for any number of ranks"
        )
    return notes
