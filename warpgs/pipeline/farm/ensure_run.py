"""Runs of a study or a farm: keep a finished run with the same settings, continue an interrupted one, else fit."""

from __future__ import annotations

import contextlib
import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from warpgs import schema
from warpgs.errors import DataError, FolderHeldError, ResourceError, UsageError, WarpgsError
from warpgs.files import LOCK, is_empty, move_folder
from warpgs.io.splits import Split
from warpgs.pipeline.runs.commands import evaluate
from warpgs.pipeline.runs.fit import fit_request
from warpgs.pipeline.runs.folder import CONFIG, read_record
from warpgs.pipeline.runs.request import FitRequest
from warpgs.pipeline.runs.schemas import METRICS
from warpgs.pipeline.train.config import FitConfig
from warpgs.runtime.folder_lock import hold_folder
from warpgs.version import __version__


@dataclass(frozen=True)
class Outcome:
    """Outcome of one run."""

    state: str
    """kept, continued, fitted, redone or failed."""
    metrics: dict[str, Any] | None
    """Contents of metrics.json, or of eval.json if LPIPS was measured later; None if the run failed."""
    note: str = ""
    """Note on this run for readers of the study; empty if there is none."""
    error: WarpgsError | None = None
    """Error that ended the run, if any."""


def _scores(path: Path) -> dict[str, Any] | None:
    """Read metrics.json or eval.json; None if it is missing or incomplete."""
    try:
        value: dict[str, Any] = schema.read(path, path.parent)
        METRICS(value, "")
    except (OSError, schema.SchemaError):
        return None
    return value


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
    """Rename the folder of a run that cannot be used; no result is deleted.

    Raises:
        ResourceError: Another process writes there, or the folder cannot be moved.
    """
    with hold_folder(folder):
        pass  # no process writes there; the lock is released first, since Windows moves no folder with an open file
    number = 1
    while os.path.lexists(target := folder.with_name(f"{folder.name}.old{number}")):
        number += 1
    try:
        return move_folder(folder, target.name)
    except OSError as e:
        raise ResourceError(f"{folder}: cannot be moved to {target.name} ({e.strerror or e}); move it by hand") from e


def _with_lpips(metrics: dict[str, Any], folder: Path, request: FitRequest, variants: dict[str, str]) -> dict[str, Any]:
    """Return the scores of a finished run with LPIPS for the requested weights; LPIPS is measured now if it is missing."""
    for found in (metrics, _scores(folder / "eval.json")):
        if found and found.get("config_hash") == metrics["config_hash"] and variants.items() <= found["variants"].items():
            return metrics | {k: found[k] for k in ("test", "views", "variants")}
    evaluate(folder, request.device, request.lpips_weights)
    written = schema.read(folder / "eval.json", folder)
    return metrics | {k: written[k] for k in ("test", "views", "variants")}


def ensure_run(
    request: FitRequest,
    fingerprint: str,
    split: Split | None,
    device: str,
    variants: dict[str, str],
    resolved: FitConfig | None = None,
    **others: Any,
) -> Outcome:
    """Ensure that a run folder holds the finished run that is requested.

    A finished run with the same configuration, user code, data, views, kind of device and version is kept. An interrupted run
    is continued from its checkpoint. Any other folder is moved aside, and the run is repeated.

    Args:
        request: The fit; ``out`` is its folder, ``resume`` is ignored.
        fingerprint: Fingerprint of the scene's data.
        split: Training and held-out views; None if no existing run can match.
        device: cpu or cuda.
        variants: Definitions of the required LPIPS scores by name; empty for none.
        resolved: The settings of ``request`` with automatic ones chosen; None if no setting is automatic.
        others: Further arguments of `fit`: on_step, verbose.

    Returns:
        The outcome. It contains the error of this run, if any, so that other runs continue.
    """
    try:
        record, why = _stored(request.out)
        gap = "" if record is None else _difference(record, resolved or request.config, fingerprint, split, device)
        return _outcome(request, record, gap, why, variants, others)
    except WarpgsError as e:
        return Outcome("failed", None, str(e), e)


def _stored(folder: Path) -> tuple[dict[str, Any] | None, str]:
    """Return the record of a run folder, or None and the reason why there is no record."""
    try:
        return (read_record(folder) if (folder / CONFIG).exists() else None), "not a run folder"
    except DataError as e:
        return None, f"unusable ({e})"


def _outcome(
    request: FitRequest, record: dict[str, Any] | None, gap: str, why: str, variants: dict[str, str], others: dict[str, Any]
) -> Outcome:
    """Return the outcome of `ensure_run`, or raise the error that prevents a start."""
    folder, note, state, resume = request.out, "", "fitted", False
    if record is not None:
        # the report is what a fit writes last
        metrics = _scores(folder / "metrics.json") if (folder / "report.html").is_file() else None
        if gap:
            note = f"the old run differs in {gap}; moved to {_set_aside(folder).name}, and the scene was fitted again"
            state = "redone"
        elif metrics is not None:
            if (folder / LOCK).exists():  # left by a fit that was killed after its last file, like other leftovers
                with contextlib.suppress(FolderHeldError), hold_folder(folder):
                    pass
            try:
                scores = _with_lpips(metrics, folder, request, variants) if variants else metrics
            except WarpgsError as e:
                return Outcome("failed", None, f"scoring the finished run failed: {e}", e)
            return Outcome("kept", scores)
        else:
            resume, state, note = True, "continued", "was interrupted; continued from the last checkpoint"
    elif os.path.exists(folder) and not is_empty(folder):
        note = f"old results: {why}; moved to {_set_aside(folder).name}, and the scene was fitted again"
        state = "redone"

    def fit(go_on: bool) -> dict[str, Any]:
        return fit_request(replace(request, resume=go_on), **others).metrics

    try:
        try:
            return Outcome(state, fit(resume), note)
        except (DataError, UsageError) as e:
            if not resume:
                raise
            note = f"could not be continued ({e}); moved to {_set_aside(folder).name}, and the scene was fitted again"
            return Outcome("redone", fit(False), note)
    except WarpgsError as e:
        return Outcome("failed", None, f"{note + '; then ' if note else ''}{e}", e)
