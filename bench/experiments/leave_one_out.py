"""Settings of a fit compared by leaving out one training view at a time: the only evidence by which they may be chosen.

usage: python -m bench.experiments.leave_one_out SCENE... --trials default default:optimizer.scales_decay=0.1 [--split llff:3]
           [--seeds 3] [--jobs 1] [--downscale 1] [--device auto] [--seconds S] --out FILE.json
Each training view of the split is fitted without and scored once; its held-out views are never read. A trial is a preset and,
after a colon, settings with commas between. Several fits at a time say nothing of speed, so no times are kept.
"""

from __future__ import annotations

import argparse
import gc
import json
import math
import multiprocessing
import statistics
import time
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from dataclasses import replace
from pathlib import Path

import torch

from bench import result_file
from bench.experiments.tradeoff_outcome import fit_once
from warpgs.errors import UsageError
from warpgs.pipeline.runs.request import SceneRequest, choose_device, read_scene
from warpgs.pipeline.train.config import PRESETS, FitConfig

WHAT = "settings of a fit compared by leaving out one training view at a time"
COLUMNS = ("scene", "trial", "left_out", "seed", "psnr", "ssim", "gaussians", "bytes")


def trial_config(trial: str) -> FitConfig:
    """The settings that ``PRESET`` or ``PRESET:a.b=value,c=value`` names; values are JSON, a bare word is a word.

    Raises:
        UsageError: The preset or a setting is unknown, or a value is out of range.
    """
    preset, _, changes = trial.partition(":")
    if preset not in PRESETS:
        raise UsageError(f"preset {preset!r} is not one of {', '.join(PRESETS)}")
    values = PRESETS[preset].to_json()
    for change in filter(None, changes.split(",")):
        key, sep, value = change.partition("=")
        *groups, last = key.split(".")
        place = values
        for group in groups:
            place = place.get(group) if isinstance(place, dict) else None
        if not sep or not isinstance(place, dict) or last not in place:
            raise UsageError(f"trial {trial!r}: {change!r} sets nothing; write GROUP.NAME=VALUE as in optimizer.scales_lr=0.1")
        try:
            place[last] = json.loads(value)
        except json.JSONDecodeError:
            place[last] = value
    return FitConfig.from_json(values)


def folds(request: SceneRequest) -> list[tuple[str, str]]:
    """Each training view of a scene's split, and the split that trains on the other training views and scores it alone."""
    train = read_scene(request)[1].train
    if len(train) < 3:
        raise UsageError(f"{request.path}: {len(train)} training views; leaving one out needs at least three")
    return [(name, f"train={','.join(n for n in train if n != name)};test={name}") for name in train]


def _one(task: tuple[SceneRequest, str, str, str, int, str]) -> dict:
    request, trial, name, split, seed, device = task
    scene, _, _ = read_scene(replace(request, split=split))
    row = fit_once(scene, split, replace(trial_config(trial), seed=seed), torch.device(device))
    gc.collect()  # a fit and its recorded steps refer to each other: without this their device memory piles up
    return {"scene": Path(request.path).resolve().name, "trial": trial, "left_out": name, "seed": seed} | {
        k: row[k] for k in ("psnr", "ssim", "gaussians", "bytes")
    }


def table(rows: list[dict], trials: list[str], views: int) -> list[str]:
    """Markdown lines: mean and standard deviation over seeds of the mean over the views left out, by trial and scene."""
    scenes = sorted({r["scene"] for r in rows})
    lines = ["| trial | " + " | ".join(f"{s} PSNR [dB] | {s} SSIM | {s} worst seed | {s} kB" for s in scenes) + " |"]
    lines.append("|---" * (1 + 4 * len(scenes)) + "|")
    for trial in trials:
        cells = []
        for scene in scenes:
            own = [r for r in rows if r["trial"] == trial and r["scene"] == scene]
            by_seed = [[r for r in own if r["seed"] == s] for s in sorted({r["seed"] for r in own})]
            whole = [g for g in by_seed if len(g) == views]
            psnr = [statistics.mean(r["psnr"] for r in g) for g in whole]
            if not psnr:
                cells += ["", "", "", ""]
                continue
            spread = f" ± {statistics.stdev(psnr):.2f}" if len(psnr) > 1 else ""
            ssim = statistics.mean(r["ssim"] for g in whole for r in g)
            size = statistics.mean(r["bytes"] for g in whole for r in g) / 1000
            cells += [f"{statistics.mean(psnr):.2f}{spread} ({len(psnr)})", f"{ssim:.4f}", f"{min(psnr):.2f}", f"{size:,.0f}"]
        lines.append(f"| `{trial}` | " + " | ".join(cells) + " |")
    return lines


def main() -> int:
    """Run every trial on every fold, seed by seed, and write one row for each."""
    p = argparse.ArgumentParser(prog="python -m bench.experiments.leave_one_out", description=__doc__.splitlines()[0])
    p.add_argument("scenes", nargs="+")
    p.add_argument("--trials", nargs="+", required=True)
    p.add_argument("--split", default="llff:3")
    p.add_argument("--seeds", type=int, default=3)
    p.add_argument("--jobs", type=int, default=1, help="fits at a time")
    p.add_argument("--downscale", type=int, default=1)
    p.add_argument("--device", default="auto")
    p.add_argument("--seconds", type=float, default=math.inf, help="after this long no further fit is begun")
    p.add_argument("--out", type=Path, required=True)
    a = p.parse_args()
    for trial in a.trials:
        trial_config(trial)
    device = choose_device(a.device)[0]
    requests = [SceneRequest(s, a.split, a.downscale) for s in a.scenes]
    cut = {r.path: folds(r) for r in requests}
    tasks = [
        (r, trial, name, split, seed, str(device))
        for seed in range(a.seeds)
        for trial in a.trials
        for r in requests
        for name, split in cut[r.path]
    ]
    began, rows, left = time.monotonic(), [], 0
    with ProcessPoolExecutor(a.jobs, mp_context=multiprocessing.get_context("spawn")) as pool:
        waiting = iter(tasks)
        running = {pool.submit(_one, t) for _, t in zip(range(a.jobs), waiting, strict=False)}
        while running:
            done = next(iter(wait(running, return_when=FIRST_COMPLETED).done))
            running.remove(done)
            rows.append(done.result())
            print(f"{len(rows)}/{len(tasks)}", *(rows[-1][c] for c in COLUMNS), flush=True)
            result_file.write(a.out, result_file.result(WHAT, device, rows))
            if time.monotonic() - began < a.seconds and (task := next(waiting, None)) is not None:
                running.add(pool.submit(_one, task))
        left = sum(1 for _ in waiting)
    for line in table(rows, a.trials, max(len(c) for c in cut.values())):
        print(line)
    if left:
        print(f"{left} fits were not begun: --seconds {a.seconds:g} had passed")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
