"""Studies: several settings on the same scenes with the same seeds, their scores, and intervals of the differences."""

from __future__ import annotations

import dataclasses
import gc

import torch

from warpgs.errors import DataError, UsageError
from warpgs.io.splits import held_out_split, split_views
from warpgs.pipeline.farm.ensure_run import Outcome, ensure_run
from warpgs.pipeline.farm.job import FarmJob
from warpgs.pipeline.farm.record import JobRecord
from warpgs.pipeline.farm.run import make_engine, run_and_show
from warpgs.pipeline.metrics.lpips import load_lpips
from warpgs.pipeline.runs.request import FitRequest, choose_device, read_scene
from warpgs.pipeline.runs.results import summary_line
from warpgs.pipeline.study.study import FILES, SWITCHES, Place, Runs, StudyRequest, run_folder, scene_name, write_study
from warpgs.pipeline.train.by_views import settings_by_views
from warpgs.pipeline.train.config import FitConfig
from warpgs.pipeline.train.loop import train_views
from warpgs.pipeline.train.presets import PRESETS, preset_settings, preset_word
from warpgs.runtime.folder_lock import hold_folder
from warpgs.runtime.terminal import say

SCORES = ("s_render", "s_semantic", "s_geometry")
"""Switches of the scores whose weighted sum is the importance map."""
PAPER = "paper-literal"
"""Preset with the paper's hyper-parameters, a row of each ablation."""
ABLATION_ROWS: dict[str, dict[str, bool] | None] = {
    "full": {},
    "uniform": dict.fromkeys(SCORES, False),
    "residual only": {"s_render": True, "s_semantic": False, "s_geometry": False},
    "residual + semantics": {"s_render": True, "s_semantic": True, "s_geometry": False},
    "residual + semantics + geometry": dict.fromkeys(SCORES, True),
    **{f"no {name}": {name: False} for name in SWITCHES},
    **{f"with {name}": {name: True} for name in SWITCHES},
    PAPER: None,
}
"""Switches that each row of the ablation changes in the preset. The rows: no change; pixels sampled uniformly; pixels sampled
by the residual; by the residual and one more score at a time; each enabled part switched off alone; each disabled part switched
on alone. `PAPER` is a preset of its own. A row that equals an earlier one is left out."""


def preset_variants(names: list[str], steps: int | None) -> dict[str, FitConfig]:
    """Return presets as the variants of a study, in the order of ``names``; ``steps`` replaces the steps of each preset.

    Args:
        names: Presets as `warpgs.fit` takes them; a file or an object is shown by the last part of its name.
        steps: Steps of each run; None for the steps of its preset.

    Raises:
        DataError: The file of a preset cannot be read.
        UsageError: A preset is unknown, or two have the same name.
    """
    words = [preset_word(n) for n in names]
    for word in words:
        if words.count(word) > 1:
            raise UsageError(f"preset {word!r} appears twice; rename one")
    found = {word: preset_settings(n)[0] for word, n in zip(words, names, strict=True)}
    return found if steps is None else {n: dataclasses.replace(c, steps=steps) for n, c in found.items()}


def ablation_variants(base: FitConfig) -> tuple[dict[str, FitConfig], dict[str, tuple[bool, ...]]]:
    """Return the rows of the ablation of a configuration, and their check marks in the order of `SWITCHES`.

    All rows have the configuration's number of steps.

    Raises:
        UsageError: The configuration has no sampling events, so there is nothing to ablate.
    """
    if not base.method.events:
        raise UsageError(f"preset {base.preset!r} has no sampling events; ablate a preset with them, such as default")
    variants: dict[str, FitConfig] = {}
    marks: dict[str, tuple[bool, ...]] = {}
    for row, switches in ABLATION_ROWS.items():
        if switches is None:  # the steps are the preset's, so that rows differ in the method alone
            changed = dataclasses.replace(PRESETS[PAPER], steps=base.steps, max_steps=base.max_steps, cpu_limit=base.cpu_limit)
        else:
            method = dataclasses.replace(base.method, **switches)  # type: ignore[arg-type]  # names of bool fields alone
            changed = dataclasses.replace(base, method=method)
        if base.preset != row and changed not in variants.values():
            variants[row] = changed
            marks[row] = tuple(bool(getattr(changed.method, name)) for name in SWITCHES)
    return variants, marks


def _places(request: StudyRequest, device: str) -> list[Place]:
    """Read the scenes of a study; DataError if one has no held-out view."""
    places = []
    for asked in request.scenes:
        wanted = asked.with_scale(device)
        scene, split, _ = read_scene(wanted)
        if wanted.split is None:
            spec, note = held_out_split(scene)
            say(f"{wanted.path}: {note}")
            wanted, split = dataclasses.replace(wanted, split=spec), split_views(scene, spec)
        if not split.test:
            raise DataError(f"{wanted.path}: no view is held out, so there are no scores to compare; choose another --split")
        places.append(
            Place(
                scene_name(wanted),
                wanted,
                scene.fingerprint,
                split,
                *(train_views(scene, n) for n in (split.train, split.test)),
            )
        )
    return places


Key = tuple[str, str, int]
"""Scene, variant and seed of a run."""


def _fits(request: StudyRequest, places: list[Place]) -> dict[Key, tuple[Place, FitRequest]]:
    """Return all runs, seed by seed, so that an interrupted study has complete pairs."""
    return {
        (place.name, name, seed): (
            place,
            FitRequest(
                place.request, run_folder(request, place.name, name, seed), dataclasses.replace(config, seed=seed),
                request.device, lpips_weights=request.lpips_weights,
            ),
        )
        for seed in range(request.seeds) for place in places for name, config in request.variants.items()
    }  # fmt: skip


def _farmed(request: StudyRequest, fits: dict[Key, tuple[Place, FitRequest]]) -> dict[Key, JobRecord]:
    """Run all fits on a farm, if one is requested; return their records."""
    if request.engine is None:
        return {}
    jobs = {}
    for key, (_, fit) in fits.items():
        name = "-".join(map(str, key)).replace(" ", "-")
        jobs[name] = FarmJob(name, fit, request.out / "farm" / name, request.out)
    engine = make_engine(request.engine, request.device)
    statuses = run_and_show(list(jobs.values()), engine, request.out)
    return {key: s.record for key, s in zip(fits, statuses, strict=True) if s.record is not None}


def _run_all(request: StudyRequest, places: list[Place], device: torch.device, lpips: dict[str, str]) -> Runs:
    """Make all runs, or read the results of a farm."""
    runs: Runs = {}
    fits = _fits(request, places)
    farmed = _farmed(request, fits)
    for key, (place, fit) in fits.items():
        record = farmed.get(key)
        if record is None:
            say(f"[{len(runs) + 1}/{len(fits)}] {key[0]}, {key[1]}, seed {key[2]}")
        elif record.state == "failed":
            runs[key] = Outcome("failed", None, record.message)
            continue
        resolved, _ = settings_by_views(fit.config, place.train, device.type)
        outcome = ensure_run(fit, place.fingerprint, place.split, device.type, lpips, resolved, verbose="progress")
        if record is not None and outcome.state == "kept":
            outcome = dataclasses.replace(outcome, state=record.how, note=record.message)
        if record is None and outcome.state != "fitted":
            say(f"  {outcome.state}{': ' if outcome.note else ''}{outcome.note}")
        if record is None and outcome.metrics is not None:
            say(f"  {summary_line(outcome.metrics)}")
        runs[key] = outcome
        gc.collect()  # a fit and its recorded steps refer to each other: without this their device memory is not freed
    return runs


def run_study(request: StudyRequest) -> list[str]:
    """Fit every variant to every scene with every seed, and write the results into the study's folder.

    Scenes and weights are read before the first fit. The notes name each failed run; its seed is excluded from paired
    differences.

    Returns:
        Lines for the user: the table and the notes.

    Raises:
        DataError: A scene cannot be read or has no held-out view, the LPIPS weights are invalid, or every run of a variant
            failed.
        ResourceError: The folder cannot be written, another process writes into it, or the device is missing.
    """
    device, where = choose_device(request.device)
    lpips = {} if request.lpips_weights is None else load_lpips(request.lpips_weights, device).variants()
    places = _places(request, device.type)
    with hold_folder(request.out) as notes:
        for note in notes:
            say(note)
        counts = {"scene": len(places), "setting": len(request.variants), "seed": request.seeds}
        say(", ".join([*(f"{n} {word}{'' if n == 1 else 's'}" for word, n in counts.items()), where]))
        try:
            runs = _run_all(request, places, device, lpips)
        except KeyboardInterrupt:
            say("repeat the command to continue: finished runs are kept, and the interrupted run continues")
            raise
        for name in request.variants:
            failed = [o.note for (_, v, _), o in runs.items() if v == name and o.metrics is None]
            if len(failed) == len(places) * request.seeds:
                raise DataError(f"every run of {name} failed, so nothing can be compared; first error: {failed[0]}")
        lines = write_study(request, runs, places, device, where.removeprefix("on "))
        return [*lines, f"in {request.out}: {', '.join(FILES)}"]
