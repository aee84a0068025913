"""Studies: presets on scenes with several seeds."""

from __future__ import annotations

import csv
import dataclasses
import gc
import io
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgs.errors import DataError, UsageError
from warpgs.files import write_bytes, write_json, write_text
from warpgs.io.load import Split, held_out_split, split_views
from warpgs.locks import hold_folder
from warpgs.pipeline.farm.farm import make_engine, run_and_show
from warpgs.pipeline.farm.job import PLY, FarmJob, JobRecord, file_digest
from warpgs.pipeline.farm.work import Outcome, ensure_run
from warpgs.pipeline.metrics.lpips import Lpips
from warpgs.pipeline.metrics.scores import over_white, render_view
from warpgs.pipeline.paper.strategy import UNIFORM, PaperConfig
from warpgs.pipeline.run.folder import open_run
from warpgs.pipeline.run.request import FitRequest, SceneRequest, choose_device, read_scene
from warpgs.pipeline.run.results import LABELS, summary_line
from warpgs.pipeline.study.tables import (
    GAUSSIANS,
    Metric,
    Row,
    Table,
    csv_text,
    family_confidence,
    forest,
    latex,
    markdown,
    paired_difference,
    sample,
)
from warpgs.pipeline.train.presets import PRESETS, preset_settings, preset_word
from warpgs.pipeline.train.settings import FitConfig, settings_by_views
from warpgs.pipeline.train.trainer import train_views
from warpgs.process import say
from warpgs.report.images import Strip, crops, disagreement, sheet
from warpgs.scene import View

CROPS = 2
"""Enlarged parts of each view."""
FRACTION = 0.22
"""Width and height of a crop, as fractions of the width and height of the image."""


def _rendered(folder: Path, views: list[View], device: torch.device) -> list[np.ndarray]:
    """Render views with the model of a run; colours [H, W, 3] in [0, 1]."""
    run = open_run(folder, device)
    return [np.clip(render_view(run.gaussians(), v, run.options())[0], 0, 1) for v in views]


def strips(
    scene: str,
    views: list[View],
    folders: dict[str, Path],
    scores: dict[str, dict[str, float]],
    count: int,
    device: torch.device,
) -> list[Strip]:
    """Return rows of the figure of one scene: up to ``count`` held-out views on which the variants' PSNR [dB] differs most."""
    images = {name: _rendered(folder, views, device) for name, folder in folders.items()}
    maps = []
    for i, view in enumerate(views):
        values = disagreement([p[i] for p in images.values()], view.image)
        maps.append(values if view.score_mask is None else values * view.score_mask)
    chosen = sorted(sorted(range(len(views)), key=lambda i: -float(maps[i].mean()))[:count])
    rows: list[Strip] = []
    for i in chosen:
        view = views[i]
        H, W = view.image.shape[:2]
        w, h = max(8, round(FRACTION * W)), max(8, round(FRACTION * H))
        corners = crops(maps[i], w, h, CROPS)
        cells = []
        for name, rendered in images.items():
            value = scores.get(name, {}).get(view.name)
            cells.append((rendered[i], f"{value:.2f} dB" if value is not None else ""))
        reference = view.image if view.score_mask is None else over_white(view.image, view.score_mask) * 0.5 + view.image * 0.5
        words = "held-out image" if view.score_mask is None else "image, bleached where not scored"
        rows.append((f"{scene}, {view.name}", [*cells, (reference, words)], [(x, y, w, h) for x, y in corners]))
    return rows


SWITCHES = {
    "hier": "Hier", "s_render": "S_{rend}", "s_semantic": "S_{sem}", "s_geometry": "S_{geo}", "ra": "RA", "agp": "AGP",
    "pm": "PM", "events": "Events",
}  # fmt: skip
"""Parts of the method that can be switched off, with the headings of the paper's ablation table."""
MAX_SEEDS = 1000
"""Largest number of runs of a setting on a scene."""
FIGURE_ROWS = 3
"""Rows of the figure for a single scene; with two scenes each has two rows, with more scenes one."""
FILES = ("table.md", "table.csv", "table.tex", "runs.csv", "plot.svg", "figure.png", "study.json")
"""Files of a study, beside its runs."""


@dataclass(frozen=True)
class StudyRequest:
    """A comparison: settings, scenes and seeds."""

    scenes: tuple[SceneRequest, ...]
    """Scenes that every variant is fitted to."""
    variants: dict[str, FitConfig]
    """Settings by name; each is compared with the first one. The study sets the seed."""
    seeds: int
    """Number of runs of each variant on each scene, with seeds from 0 on."""
    out: Path
    """Folder of the study; its runs are in SCENE/VARIANT/SEED."""
    device: str = "auto"
    """auto, cpu or cuda."""
    lpips_weights: Path | None = None
    """File of `warpgs convert-lpips`; None to leave LPIPS out."""
    engine: dict[str, Any] | None = None
    """Engine of a farm for the runs; None: one run after another in this process."""
    marks: dict[str, tuple[bool, ...]] = field(default_factory=dict)
    """Check marks of each variant in the order of `SWITCHES`; empty for a comparison of presets."""

    def __post_init__(self) -> None:
        if not 1 <= self.seeds <= MAX_SEEDS:
            raise UsageError(f"--seeds must be a number from 1 to {MAX_SEEDS}, not {self.seeds}")
        if len(self.variants) < 2:
            raise UsageError(f"a comparison needs at least two settings, not {', '.join(self.variants) or 'none'}")
        names = [scene_name(s) for s in self.scenes]
        if not names:
            raise UsageError("name at least one scene folder")
        if len(set(names)) < len(names):
            raise UsageError(
                f"two scene folders have the same name ({', '.join(names)}), but it names their results; rename one"
            )


def scene_name(request: SceneRequest) -> str:
    """Return the name of a scene in tables and folders, which is the name of its folder."""
    return Path(request.path).resolve().name


@dataclass(frozen=True)
class Place:
    """One scene of a study, read once."""

    name: str
    """Name of its folder."""
    request: SceneRequest
    """Folder of the scene, and options for reading it."""
    fingerprint: str
    """Fingerprint of its data."""
    split: Split
    """Names of the views to fit, and of held-out views."""
    train: list[View]
    """Views to fit."""
    test: list[View]
    """Held-out views."""


Runs = dict[tuple[str, str, int], Outcome]
"""Outcome by scene, variant and seed."""


def run_folder(request: StudyRequest, scene: str, variant: str, seed: int) -> Path:
    """Return the folder of a run of a study."""
    return request.out / scene / variant.replace(" ", "-") / str(seed)


def _value(outcome: Outcome, key: str) -> float:
    """Return a mean score of a run, or its number of Gaussians; NaN if it was not measured."""
    metrics = outcome.metrics or {}
    value = (metrics if key == GAUSSIANS else metrics.get("test", {})).get(key)
    return float(value) if isinstance(value, int | float) else math.nan


def _by_seed(runs: Runs, scenes: list[str], variant: str, key: str, seeds: int) -> dict[int, float]:
    """Return the mean over scenes by seed; seeds without a result for every scene are left out."""
    means = {s: math.fsum(_value(runs[p, variant, s], key) for p in scenes) / len(scenes) for s in range(seeds)}
    return {s: v for s, v in means.items() if math.isfinite(v)}


def _metrics(runs: Runs) -> tuple[Metric, ...]:
    """Return PSNR, SSIM and, if LPIPS was measured, the variant that papers print."""
    keys = {k for o in runs.values() for k in (o.metrics or {}).get("test", {})}
    order = ("lpips_vgg_legacy", "lpips_alex_legacy")
    found = next((k for k in order if k in keys), "lpips")
    return (
        Metric("psnr", "PSNR", True, 2), Metric("ssim", "SSIM", True, 3),
        Metric(found, LABELS[found].split(" ")[0], False, 3),
    )  # fmt: skip


def _same_files(request: StudyRequest, runs: Runs, scenes: list[str], variant: str, base: str) -> bool:
    """Return whether every run of a variant gave the same PLY as the base with the same scene and seed."""
    pairs = [(p, s) for p in scenes for s in range(request.seeds) if runs[p, variant, s].metrics and runs[p, base, s].metrics]

    def digest(name: str, pair: tuple[str, int]) -> str:
        return file_digest(run_folder(request, pair[0], name, pair[1]) / PLY)

    return bool(pairs) and all(digest(variant, p) == digest(base, p) for p in pairs)


def _table(request: StudyRequest, runs: Runs, scenes: list[str], metrics: tuple[Metric, ...], caption: str) -> Table:
    """Return the means of all variants over scenes and seeds, and their differences to the first variant."""
    base = next(iter(request.variants))
    confidence, rows = family_confidence(len(request.variants) - 1), []
    for name in request.variants:
        samples, differences = {}, {}
        for m in metrics:
            ours = _by_seed(runs, scenes, name, m.key, request.seeds)
            theirs = _by_seed(runs, scenes, base, m.key, request.seeds)
            if ours:
                samples[m.key] = sample(list(ours.values()))
            common = sorted(ours.keys() & theirs.keys())
            if name != base:
                differences[m.key] = paired_difference([ours[s] for s in common], [theirs[s] for s in common], confidence)
        if counts := _by_seed(runs, scenes, name, GAUSSIANS, request.seeds):
            samples[GAUSSIANS] = sample(list(counts.values()))
        exercised = name == base or not _same_files(request, runs, scenes, name, base)
        rows.append(Row(name, samples, differences, request.marks.get(name, ()), exercised))
    return Table(caption, base, metrics, tuple(rows), tuple(SWITCHES.values()) if request.marks else ())


def _figure(request: StudyRequest, runs: Runs, places: list[Place], device: torch.device) -> tuple[bytes | None, str]:
    """Return the figure (PNG) of the first seed for which all runs succeeded, or None, and a note."""
    whole = [s for s in range(request.seeds) if all(runs[p.name, v, s].metrics for p in places for v in request.variants)]
    if not whole:
        return None, "no figure: no seed succeeded in every row"
    seed, rows, each = whole[0], [], {1: FIGURE_ROWS, 2: 2}.get(len(places), 1)
    for place in places:
        folders = {v: run_folder(request, place.name, v, seed) for v in request.variants}
        found = {v: runs[place.name, v, seed].metrics or {} for v in request.variants}
        scores = {v: {r["name"]: r["psnr"] for r in metrics["views"]} for v, metrics in found.items()}
        rows += strips(place.name, place.test, folders, scores, each, device)
    return sheet([*request.variants, "image"], rows), f"the figure shows seed {seed}"


def _notes(request: StudyRequest, runs: Runs, metrics: tuple[Metric, ...]) -> list[str]:
    """Return the caveats that a reader of the tables needs."""
    notes = [f"{p}, {v}, seed {s}: {o.note}" for (p, v, s), o in runs.items() if o.note]
    for v in request.variants:
        lost = [f"{p} seed {s}" for (p, name, s), o in runs.items() if name == v and o.metrics is None]
        if lost:
            notes.append(f"{v}: no result for {', '.join(lost)}; its means and paired differences exclude these seeds")
    if request.seeds < 2:
        notes.append("one seed gives no deviations and no intervals; run more seeds before you claim a difference")
    elif request.seeds < 3:
        notes.append("two seeds give wide, uncertain intervals; run at least three before you claim a difference")
    last = metrics[-1].key
    lacking = sum(math.isnan(_value(o, last)) for o in runs.values() if o.metrics)
    if last == "lpips":
        notes.append("LPIPS was not measured, because --lpips-weights was not given")
    elif lacking:
        notes.append(f"{lacking} runs have no {metrics[-1].label}; the column excludes them")
    if len(request.scenes) > 1:
        notes.append("deviations and intervals cover different seeds on these scenes, not other scenes")
    return notes


def _protocols(runs: Runs) -> list[str]:
    """Return the protocol of each scene, the steps of each variant, and the definition of each score, as Markdown lines."""
    lines, seen = [], set()
    variants: dict[str, str] = {}
    for (scene, _, _), outcome in runs.items():
        if outcome.metrics and scene not in seen:
            seen.add(scene)
            p = outcome.metrics["protocol"]
            words = [f"split {p['split']}", f"{p['training_views']} training and {p['held_out_views']} held-out views"]
            words += [f"{', '.join(p['resolution'])} px from {p['ground_truth']}"]
            if p["score_masks"]:
                words.append(f"{p['score_masks']} views scored within object masks")
            lines.append(f"- {scene}: {'; '.join(words)}")
            variants |= outcome.metrics["variants"]
    steps: dict[str, set[int]] = {}
    for (_, name, _), outcome in runs.items():
        if outcome.metrics:
            steps.setdefault(name, set()).add(outcome.metrics["steps"])
    taken = [f"{name} {' or '.join(f'{n:,}' for n in sorted(of))}" for name, of in steps.items()]
    return [*lines, f"- steps: {', '.join(taken)}", *(f"- {LABELS.get(k, k)}: {v}" for k, v in variants.items())]


def _runs_csv(request: StudyRequest, runs: Runs) -> str:
    """Return CSV with a line per run."""
    keys = [k for k in LABELS if any(k in (o.metrics or {}).get("test", {}) for o in runs.values())]
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(["scene", "variant", "seed", "state", *keys, "gaussians", "steps", "seconds", "config_hash", "folder"])
    for (scene, variant, seed), o in runs.items():
        values = [v if math.isfinite(v := _value(o, k)) else "" for k in keys]
        m = o.metrics or {}
        rest = [
            m.get("gaussians", ""),
            m.get("steps", ""),
            round(m["seconds"]["total"], 3) if m else "",
            m.get("config_hash", ""),
        ]
        place = run_folder(request, scene, variant, seed).relative_to(request.out).as_posix()
        writer.writerow([scene, variant, seed, o.state, *values, *rest, place])
    return out.getvalue()


def write_study(request: StudyRequest, runs: Runs, places: list[Place], device: torch.device, device_name: str) -> list[str]:
    """Write tables, plot, figure and record of a study into its folder; returns the table and the notes as lines."""
    metrics, scenes = _metrics(runs), [p.name for p in places]
    title = "Ablation" if request.marks else "Comparison"
    what = scenes[0] if len(scenes) == 1 else f"the mean over {len(scenes)} scenes"
    seeds = f"{request.seeds} seed{'' if request.seeds == 1 else 's'}"
    table = _table(request, runs, scenes, metrics, f"{title} on {what}, {seeds}")
    image, about = _figure(request, runs, places, device)
    notes = [*_notes(request, runs, metrics), about]
    parts = [f"# {table.caption}", markdown(table)]
    if len(scenes) > 1:
        parts += [f"## {s}\n\n{markdown(_table(request, runs, [s], metrics, s))}" for s in scenes]
    parts += [
        "## How it was scored\n\n" + "\n".join([*_protocols(runs), f"- device: {device_name}"]),
        "## Notes\n\n" + "\n".join(f"- {n}" for n in notes),
    ]
    write_text(request.out / "table.md", "\n\n".join(p.strip() for p in parts) + "\n")
    write_text(request.out / "table.csv", csv_text(table))
    write_text(request.out / "table.tex", latex(table))
    write_text(request.out / "runs.csv", _runs_csv(request, runs))
    write_text(request.out / "plot.svg", forest(table))
    if image is not None:
        write_bytes(request.out / "figure.png", image)
    hashes = {n: dataclasses.replace(c, seed=0).fingerprint() for n, c in request.variants.items()}
    write_json(request.out / "study.json", {
        "variants": {n: {"config_hash_of_seed_0": hashes[n], "config": c.to_json()} for n, c in request.variants.items()},
        "seeds": request.seeds, "device": device_name, "notes": notes,
        "scenes": {p.name: {**dataclasses.asdict(p.request), "fingerprint": p.fingerprint} for p in places},
    })  # fmt: skip
    return [f"{table.caption}:", "", *markdown(table).splitlines(), "", *(f"  {n}" for n in notes)]


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
    """Return presets as the variants of a study, in the order of ``names``; ``steps`` replaces the steps of each preset."""
    words = [preset_word(n) for n in names]
    for word in words:
        if words.count(word) > 1:
            raise UsageError(f"preset {word!r} appears twice; rename one")
    found = {word: preset_settings(n)[0] for word, n in zip(words, names, strict=True)}
    return found if steps is None else {n: dataclasses.replace(c, steps=steps) for n, c in found.items()}


def ablation_variants(base: FitConfig) -> tuple[dict[str, FitConfig], dict[str, tuple[bool, ...]]]:
    """Return the rows of an ablation, all with the same steps, and their check marks in the order of `SWITCHES`."""
    if base.strategy not in ("sampling", "paper"):
        raise UsageError(f"preset {base.preset!r} has no sampling events; ablate a preset with them, such as default")
    variants: dict[str, FitConfig] = {}
    marks: dict[str, tuple[bool, ...]] = {}
    for row, switches in ABLATION_ROWS.items():
        if switches is None:  # the steps are the preset's, so that rows differ in the method alone
            changed = dataclasses.replace(PRESETS[PAPER], steps=base.steps, max_steps=base.max_steps, cpu_limit=base.cpu_limit)
        else:
            changed = _switched(base, switches)
        if base.preset != row and changed not in variants.values():
            variants[row] = changed
            events = changed.strategy != "clone_split"
            parts = _parts(changed if events else base) | {"events": events}
            marks[row] = tuple(bool(parts[name]) for name in SWITCHES)
    return variants, marks


def _parts(config: FitConfig) -> dict[str, Any]:
    """Return the value of each switch but events: the layers, and the settings of strategy paper that its parts have."""
    own = config.strategy_config if config.strategy == "paper" else UNIFORM
    return {"hier": config.method.hier, **dataclasses.asdict(own)}


def _switched(base: FitConfig, switches: Mapping[str, bool]) -> FitConfig:
    """Return settings with some switches changed; without scores and with all other parts, `paper` is `sampling`."""
    parts = _parts(base) | switches
    if not parts.pop("events", True):
        return dataclasses.replace(base, strategy="clone_split", strategy_config=None)
    method = dataclasses.replace(base.method, hier=parts.pop("hier"))
    own = PaperConfig(**parts)
    strategy, config = ("sampling", None) if own == UNIFORM else ("paper", own)
    return dataclasses.replace(base, method=method, strategy=strategy, strategy_config=config)


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
    engine = make_engine(request.device, **request.engine)
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
    """Fit every variant to every scene with every seed, and write the results; returns the table and the notes as lines."""
    device, where = choose_device(request.device)
    lpips = {} if request.lpips_weights is None else Lpips(request.lpips_weights, device).variants()
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
