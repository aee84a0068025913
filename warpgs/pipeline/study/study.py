"""Studies: presets on scenes with several seeds."""

import dataclasses
import gc
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch

from warpgs.errors import DataError, UsageError, WarpgsError
from warpgs.files import input_digest, write_bytes, write_csv, write_json, write_text
from warpgs.io.load import Split, held_out_split, split_views
from warpgs.locks import hold_folder
from warpgs.pipeline.farm.farm import make_engine, run_and_show
from warpgs.pipeline.farm.job import PLY, FarmJob
from warpgs.pipeline.farm.work import Outcome, ensure_run
from warpgs.pipeline.metrics.lpips import Lpips
from warpgs.pipeline.metrics.scores import render_view
from warpgs.pipeline.paper.strategy import UNIFORM, PaperConfig
from warpgs.pipeline.run.folder import open_run, versions
from warpgs.pipeline.run.request import FitRequest, SceneRequest, choose_device, read_scene
from warpgs.pipeline.run.results import LABELS, summary_line
from warpgs.pipeline.study import tables
from warpgs.pipeline.study.tables import GAUSSIANS, METRICS, Sample, Table, paired_difference, sample
from warpgs.pipeline.train.presets import PRESETS, preset_settings, preset_word
from warpgs.pipeline.train.settings import FitConfig, settings_by_views
from warpgs.pipeline.train.trainer import train_views
from warpgs.process import say, say_lines
from warpgs.report.images import Tile, contact_sheet, crops, png
from warpgs.scene import Scene, View
from warpgs.schema import Checked, Within

CROPS = 2
"""Enlarged parts of each view."""
FRACTION = 0.22
"""Width and height of a crop, as fractions of the width and height of the image."""
MAX_WIDTH, CELL = 2600, (180, 440)
"""Largest width of the figure of many variants, and the smallest and largest width of a column [px]."""
BOXES = ((0.94, 0.31, 0.14), (0.0, 0.62, 0.75))
"""Colours of the frames of the enlarged parts."""


def view_sheets(
    title: str,
    views: list[View],
    folders: dict[str, Path],
    scores: dict[str, dict[str, float]],
    count: int,
    device: torch.device,
) -> list[np.ndarray]:
    """Return sheets of up to ``count`` held-out views of a scene on which the variants' PSNR [dB] differs most."""
    import cv2

    images = {}
    for name, folder in folders.items():
        run = open_run(folder, device)
        images[name] = [np.clip(render_view(run.gaussians(), v, run.options())[0], 0, 1) for v in views]
    maps = []
    for i, view in enumerate(views):
        spread = np.ptp([rendered[i] for rendered in images.values()], axis=0).mean(-1)
        maps.append(spread if view.score_mask is None else spread * view.score_mask)
    sheets, width = [], max(CELL[0], min(CELL[1], MAX_WIDTH // (len(images) + 1)))
    for i in sorted(sorted(range(len(views)), key=lambda i: -float(maps[i].mean()))[:count]):
        view = views[i]
        w, h = (max(8, round(FRACTION * side)) for side in (view.image.shape[1], view.image.shape[0]))
        values = {n: scores[n].get(view.name) for n in images}  # None if infinite
        labels = [*(n if v is None else f"{v:.2f} dB, {n}" for n, v in values.items()), "held-out image"]
        shown = [np.array(image, np.float32) for image in (*(rendered[i] for rendered in images.values()), view.image)]
        boxes = crops(maps[i], w, h, CROPS)
        for image, ((x, y), color) in product(shown, zip(boxes, BOXES)):
            cv2.rectangle(image, (x, y, w, h), color, max(1, w // 50))
        tiles = [Tile(label, image) for label, image in zip(labels, shown)]
        tiles += [Tile("enlarged", image[y : y + h, x : x + w]) for x, y in boxes for image in shown]
        sheets.append(contact_sheet(f"{title}, {view.name}", [], tiles, columns=len(shown), tile_width=width))
    return sheets


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
class StudyRequest(Checked, group="--"):
    """A comparison: settings, scenes and seeds."""

    scenes: tuple[SceneRequest, ...]
    """Scenes that every variant is fitted to."""
    variants: dict[str, FitConfig]
    """Settings by name; each is compared with the first one. The study sets the seed."""
    seeds: Annotated[int, Within(1, MAX_SEEDS)]
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
        super().__post_init__()
        if len(self.variants) < 2:
            raise UsageError(f"a comparison needs at least two settings, not {', '.join(self.variants) or 'none'}")
        if not (names := [scene_name(s) for s in self.scenes]):
            raise UsageError("name at least one scene folder")
        if len(set(names)) < len(names):
            raise UsageError(f"two scene folders are named {', '.join(names)}, which names their results; rename one")


def scene_name(request: SceneRequest) -> str:
    """Return the name of a scene in tables and folders, which is the name of its folder."""
    return Path(request.path).resolve().name


Place = tuple[SceneRequest, Scene, Split]
"""One scene of a study, read once, and its views to fit and to hold out."""
Places = dict[str, Place]
Key = tuple[str, str, int]
"""Scene, variant and seed of a run."""
Runs = dict[Key, Outcome]


def run_folder(request: StudyRequest, scene: str, variant: str, seed: int) -> Path:
    """Return the folder of a run of a study."""
    return request.out / scene / variant.replace(" ", "-") / str(seed)


def _value(outcome: Outcome, key: str) -> float:
    """Return a mean score of a run, or its number of Gaussians; NaN if it was not measured."""
    metrics = outcome[1] or {}
    value = (metrics if key == GAUSSIANS else metrics.get("test", {})).get(key)
    return float(value) if isinstance(value, int | float) else math.nan


def _by_seed(runs: Runs, scenes: list[str], variant: str, key: str) -> dict[int, float]:
    """Return the mean over scenes by seed; seeds without a result for every scene are left out."""
    seeds = sorted({s for _, _, s in runs})
    means = {s: math.fsum(_value(runs[p, variant, s], key) for p in scenes) / len(scenes) for s in seeds}
    return {s: v for s, v in means.items() if math.isfinite(v)}


def _metrics(runs: Runs) -> tuple[str, ...]:
    """Return PSNR, SSIM and, if LPIPS was measured, the variant that papers print."""
    keys = {k for _, metrics, _ in runs.values() for k in (metrics or {}).get("test", {})}
    return "psnr", "ssim", next((k for k in ("lpips_vgg_legacy", "lpips_alex_legacy") if k in keys), "lpips")


def _same_files(request: StudyRequest, runs: Runs, scenes: list[str], variant: str, base: str) -> bool:
    """Return whether every run of a variant gave the same PLY as the base with the same scene and seed."""
    pairs = [(p, s) for p, v, s in runs if v == base and p in scenes and runs[p, v, s][1] and runs[p, variant, s][1]]
    files = [[run_folder(request, p, v, s) / PLY for v in (variant, base)] for p, s in pairs]
    return bool(files) and all(input_digest(a) == input_digest(b) for a, b in files)


def _table(request: StudyRequest, runs: Runs, scenes: list[str], caption: str) -> Table:
    """Return the means of all variants over scenes and seeds, and their differences to the first variant."""
    base, metrics = next(iter(request.variants)), _metrics(runs)
    confidence = tables.family_confidence(len(request.variants) - 1)
    samples: dict[str, dict[str, Sample]] = {}
    differences: dict[str, dict[str, Sample] | None] = {}
    for name in request.variants:
        own = {key: _by_seed(runs, scenes, name, key) for key in (*metrics, GAUSSIANS)}
        samples[name] = {key: sample(list(values.values())) for key, values in own.items() if values}
        if name != base:
            differences[name] = None
            if not _same_files(request, runs, scenes, name, base):
                gaps = differences[name] = {}
                for key in metrics:
                    theirs = _by_seed(runs, scenes, base, key)
                    common = own[key].keys() & theirs.keys()
                    gaps[key] = paired_difference(*([v[s] for s in sorted(common)] for v in (own[key], theirs)), confidence)
    return Table(caption, metrics, samples, differences, tuple(SWITCHES.values()) if request.marks else (), request.marks)


def _figure(request: StudyRequest, runs: Runs, places: Places, device: torch.device) -> tuple[bytes | None, str]:
    """Return the figure (PNG) of the first seed for which all runs succeeded, or None, and a note."""
    for seed in range(request.seeds):
        if not all(runs[n, v, seed][1] for n in places for v in request.variants):
            continue
        rows, each = [], {1: FIGURE_ROWS, 2: 2}.get(len(places), 1)
        for name, (_, scene, split) in places.items():
            folders = {v: run_folder(request, name, v, seed) for v in request.variants}
            found = {v: runs[name, v, seed][1] or {} for v in request.variants}
            scores = {v: {r["name"]: r["psnr"] for r in metrics["views"]} for v, metrics in found.items()}
            rows += view_sheets(name, train_views(scene, split.test), folders, scores, each, device)
        return png(np.concatenate(rows)), f"the figure shows seed {seed}"
    return None, "no figure: no seed succeeded in every row"


def _notes(request: StudyRequest, runs: Runs) -> list[str]:
    """Return the caveats that a reader of the tables needs."""
    notes = [f"{p}, {v}, seed {s}: {note}" for (p, v, s), (_, _, note) in runs.items() if note]
    starts = {(p, v, s): (metrics or {}).get("start", "") for (p, v, s), (_, metrics, _) in runs.items()}
    notes += [f"{p}, {v}, seed {s}: {start}" for (p, v, s), start in starts.items() if "instead of --init.source" in start]
    for v in request.variants:
        lost = [f"{p} seed {s}" for (p, name, s), (_, metrics, _) in runs.items() if name == v and metrics is None]
        if lost:
            notes.append(f"{v}: no result for {', '.join(lost)}; its means and paired differences exclude these seeds")
    if request.seeds < 3:
        notes.append("one seed gives no intervals, two give uncertain ones; run at least three before you claim a difference")
    last = _metrics(runs)[-1]
    lacking = sum(math.isnan(_value(o, last)) for o in runs.values() if o[1])
    if last == "lpips":
        notes.append("LPIPS was not measured, because --lpips-weights was not given")
    elif lacking:
        notes.append(f"{lacking} runs have no {METRICS[last][0]}; the column excludes them")
    if len(request.scenes) > 1:
        notes.append("deviations and intervals cover different seeds on these scenes, not other scenes")
    return notes


def _protocols(runs: Runs) -> list[str]:
    """Return the protocol of each scene, the steps of each variant, and the definition of each score, as Markdown lines."""
    lines: dict[str, str] = {}
    variants: dict[str, str] = {}
    steps: dict[str, set[int]] = {}
    for (scene, name, _), (_, metrics, _) in runs.items():
        if not metrics:
            continue
        steps.setdefault(name, set()).add(metrics["steps"])
        if scene not in lines:
            p = metrics["protocol"]
            masks = f"; {p['score_masks']} views scored within object masks" if p["score_masks"] else ""
            counts = f"{p['training_views']} training and {p['held_out_views']} held-out views"
            images = f"{', '.join(p['resolution'])} px from {p['ground_truth']}{masks}"
            lines[scene] = f"{scene}: split {p['split']}; {counts}; {images}"
            variants |= metrics["variants"]
    taken = [f"{name} {' or '.join(f'{n:,}' for n in sorted(of))}" for name, of in steps.items()]
    definitions = [f"{LABELS.get(k, k)}: {v}" for k, v in variants.items()]
    return [f"- {line}" for line in (*lines.values(), f"steps: {', '.join(taken)}", *definitions)]


def _run_rows(request: StudyRequest, runs: Runs) -> list[list[Any]]:
    """Return a row per run for runs.csv, after the head."""
    keys = [k for k in LABELS if any(k in (metrics or {}).get("test", {}) for _, metrics, _ in runs.values())]
    rows = [["scene", "variant", "seed", "state", *keys, "gaussians", "steps", "seconds", "config_hash", "folder"]]
    for key, o in runs.items():
        values = [v if math.isfinite(v := _value(o, k)) else "" for k in keys]
        m = o[1] or {}
        seconds = round(m["seconds"]["total"], 3) if m else ""
        rest = m.get("gaussians", ""), m.get("steps", ""), seconds, m.get("config_hash", "")
        rows.append([*key, o[0], *values, *rest, run_folder(request, *key).relative_to(request.out).as_posix()])
    return rows


def write_study(request: StudyRequest, runs: Runs, places: Places, device: torch.device, device_name: str) -> list[str]:
    """Write tables, plot, figure and record of a study into its folder; returns the table and the notes as lines."""
    out, scenes = request.out, list(places)
    what = scenes[0] if len(scenes) == 1 else f"the mean over {len(scenes)} scenes"
    seeds = f"{request.seeds} seed{'' if request.seeds == 1 else 's'}"
    table = _table(request, runs, scenes, f"{'Ablation' if request.marks else 'Comparison'} on {what}, {seeds}")
    image, about = _figure(request, runs, places, device)
    notes, text = [*_notes(request, runs), about], tables.markdown(table)
    parts = [f"# {table.caption}", text]
    if len(scenes) > 1:
        parts += [f"## {s}\n\n{tables.markdown(_table(request, runs, [s], s))}" for s in scenes]
    made = ", ".join(f"{name} {versions()[name]}" for name in ("warpgs", "torch", "warp-lang"))
    scored = "\n".join([*_protocols(runs), f"- device: {device_name}", f"- versions: {made}"])
    parts += [f"## How it was scored\n\n{scored}", "## Notes\n\n" + "\n".join(f"- {n}" for n in notes)]
    write_text(out / "table.md", "\n\n".join(p.strip() for p in parts) + "\n")
    write_csv(out / "table.csv", tables.csv_rows(table))
    write_text(out / "table.tex", tables.latex(table))
    write_csv(out / "runs.csv", _run_rows(request, runs))
    write_text(out / "plot.svg", tables.forest(table))
    if image is not None:
        write_bytes(out / "figure.png", image)
    hashes = {n: dataclasses.replace(c, seed=0).fingerprint() for n, c in request.variants.items()}
    write_json(out / "study.json", {
        "variants": {n: {"config_hash_of_seed_0": hashes[n], "config": c.to_json()} for n, c in request.variants.items()},
        "seeds": request.seeds, "device": device_name, "notes": notes,
        "scenes": {n: {**dataclasses.asdict(p[0]), "fingerprint": p[1].fingerprint} for n, p in places.items()},
    })  # fmt: skip
    return [f"{table.caption}:", "", *text.splitlines(), "", *(f"  {n}" for n in notes)]


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
    found: dict[str, FitConfig] = {}
    for name in names:
        config, word = preset_settings(name)[0], preset_word(name)
        if word in found:
            raise UsageError(f"preset {word!r} appears twice; rename one")
        found[word] = config if steps is None else dataclasses.replace(config, steps=steps)
    return found


def ablation_variants(base: FitConfig) -> tuple[dict[str, FitConfig], dict[str, tuple[bool, ...]]]:
    """Return the rows of an ablation, all with the same steps, and their check marks in the order of `SWITCHES`."""
    if base.strategy not in ("sampling", "paper"):
        raise UsageError(f"preset {base.preset!r} has no sampling events; ablate a preset with them, such as default")
    variants: dict[str, FitConfig] = {}
    marks: dict[str, tuple[bool, ...]] = {}
    # the steps are the preset's, so that rows differ in the method alone
    paper = dataclasses.replace(PRESETS[PAPER], steps=base.steps, max_steps=base.max_steps, cpu_limit=base.cpu_limit)
    for row, switches in ABLATION_ROWS.items():
        changed = paper if switches is None else _switched(base, switches)
        if base.preset != row and changed not in variants.values():
            variants[row] = changed
            events = changed.strategy != "clone_split"
            parts = _parts(changed if events else base) | {"events": events}
            marks[row] = tuple(bool(parts[name]) for name in SWITCHES)
    return variants, marks


def _parts(config: FitConfig) -> dict[str, Any]:
    """Return the value of each switch but events: the layers, and the settings of strategy paper that its parts have."""
    return {"hier": config.method.hier, **dataclasses.asdict(config.strategy_config if config.strategy == "paper" else UNIFORM)}


def _switched(base: FitConfig, switches: Mapping[str, bool]) -> FitConfig:
    """Return settings with some switches changed; without scores and with all other parts, `paper` is `sampling`."""
    parts = _parts(base) | switches
    if not parts.pop("events", True):
        return dataclasses.replace(base, strategy="clone_split", strategy_config=None)
    method = dataclasses.replace(base.method, hier=parts.pop("hier"))
    own = PaperConfig(**parts)
    strategy, config = ("sampling", None) if own == UNIFORM else ("paper", own)
    return dataclasses.replace(base, method=method, strategy=strategy, strategy_config=config)


def _place(asked: SceneRequest, device: str) -> Place:
    """Read a scene of a study; DataError if it has no held-out view."""
    asked = asked.with_scale(device)
    scene, split, _ = read_scene(asked)
    if asked.split is None:
        spec, note = held_out_split(scene)
        say(f"{asked.path}: {note}")
        asked, split = dataclasses.replace(asked, split=spec), split_views(scene, spec)
    if not split.test:
        raise DataError(f"{asked.path}: no view is held out, so there are no scores to compare; choose another --split")
    return asked, scene, split


def _run_all(request: StudyRequest, places: Places, device: torch.device, lpips: dict[str, str]) -> Runs:
    """Make all runs, or read the results of a farm; seed by seed, so that an interrupted study has complete pairs."""
    runs: Runs = {}
    fits: dict[Key, tuple[Place, FitRequest]] = {}
    for seed, (name, place), (variant, config) in product(range(request.seeds), places.items(), request.variants.items()):
        key, config = (name, variant, seed), dataclasses.replace(config, seed=seed)
        out = run_folder(request, *key)
        fits[key] = place, FitRequest(place[0], out, config, request.device, lpips_weights=request.lpips_weights)
    farmed = {}
    if request.engine is not None:
        names = ["-".join(map(str, key)).replace(" ", "-") for key in fits]
        jobs = [FarmJob(n, f, request.out / "farm" / n, request.out) for n, (_, f) in zip(names, fits.values())]
        farmed = dict(zip(fits, run_and_show(jobs, make_engine(request.device, **request.engine), request.out)))
    for key, ((_, scene, split), fit) in fits.items():
        record = farmed[key].record if farmed else None
        if record is not None and record.state == "failed":
            runs[key] = "failed", None, record.message
            continue
        say(f"[{len(runs) + 1}/{len(fits)}] {key[0]}, {key[1]}, seed {key[2]}")
        resolved, _ = settings_by_views(fit.config, train_views(scene, split.train), device.type)
        try:
            outcome = ensure_run(fit, scene.fingerprint, split, device.type, lpips, resolved, verbose="progress")
        except WarpgsError as e:
            outcome = "failed", None, "; then ".join([*getattr(e, "__notes__", ()), str(e)])
        state, metrics, note = outcome
        if record is not None and state == "kept":
            outcome = record.how, metrics, record.message
        elif state != "fitted":
            say(f"  {state}{': ' if note else ''}{note}")
        if metrics is not None:
            say(f"  {summary_line(metrics)}")
        runs[key] = outcome
        gc.collect()  # a fit and its recorded steps refer to each other: without this their device memory is not freed
    return runs


def run_study(request: StudyRequest) -> list[str]:
    """Fit every variant to every scene with every seed, and write the results; returns the table and the notes as lines."""
    device, where = choose_device(request.device)
    lpips = {} if request.lpips_weights is None else Lpips(request.lpips_weights, device).variants()
    places = {scene_name(asked): _place(asked, device.type) for asked in request.scenes}
    with hold_folder(request.out) as notes:
        say_lines(notes)
        counts = {"scene": len(places), "setting": len(request.variants), "seed": request.seeds}
        say(", ".join([*(f"{n} {word}{'' if n == 1 else 's'}" for word, n in counts.items()), where]))
        try:
            runs = _run_all(request, places, device, lpips)
        except KeyboardInterrupt:
            say("repeat the command to continue: finished runs are kept, and the interrupted run continues")
            raise
        for name in request.variants:
            failed = [o for (_, v, _), o in runs.items() if v == name]
            if all(metrics is None for _, metrics, _ in failed):
                raise DataError(f"every run of {name} failed, so nothing can be compared; first error: {failed[0][2]}")
        return [*write_study(request, runs, places, device, where.removeprefix("on ")), f"in {request.out}: {', '.join(FILES)}"]
