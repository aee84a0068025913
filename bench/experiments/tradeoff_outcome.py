"""Time of whole fits against scores of held-out views, for every knob of a fit, with several seeds."""

from __future__ import annotations

import dataclasses
import statistics
import time
from dataclasses import dataclass

import torch

from bench.training import finish, make_trainer, model_bytes, with_cap
from warpgs.io.splits import split_views
from warpgs.pipeline.metrics.evaluate import render_view, score
from warpgs.pipeline.runs.results import options_for
from warpgs.pipeline.train.config import PRESETS, FitConfig
from warpgs.scene import Scene


@dataclass(frozen=True)
class Trial:
    """One way to fit."""

    name: str
    knob: str
    config: FitConfig
    preset: bool = False


def trials() -> list[Trial]:
    """Every knob by itself from preset `quick`, then pairs, then the presets that are to lie on the front."""
    base = PRESETS["quick"]

    def turned(name: str, knob: str, **changes) -> Trial:
        return Trial(name, knob, dataclasses.replace(base, **changes))

    made = [Trial("quick", "preset", base, preset=True)]
    made += [turned(f"{n} steps", "iterations", steps=n) for n in (300, 1200)]
    made += [turned(f"rule {r}", "rule", rule=r) for r in ("balanced", "fast")]
    made += [turned(f"half size {s:g}", "resolution schedule", half_resolution=s) for s in (0.3, 0.6)]
    made += [Trial(f"{n} Gaussians", "Gaussian budget", with_cap(base, n)) for n in (3000, 5000)]
    made += [turned("degree 0", "SH degree", init=dataclasses.replace(base.init, max_sh_degree=0))]
    pairs = ((1200, "balanced", 0.3), (1200, "fast", 0.6))
    made += [turned(f"{n} steps, {r}, half {h:g}", "pairs", steps=n, rule=r, half_resolution=h) for n, r, h in pairs]
    return made + [Trial(n, "preset", PRESETS[n], preset=True) for n in ("default",)]


def fit_once(scene: Scene, split: str, config: FitConfig, device: torch.device) -> dict:
    """Wall and processor time of one fit [s], without reading, scoring and reporting, and its mean scores."""
    chosen = split_views(scene, split)
    train, test = ([scene.view(name) for name in names] for names in (chosen.train, chosen.test))
    wall, cpu = time.perf_counter(), time.process_time()
    trainer = make_trainer(train, scene.points, config, device, scene.background)
    setup, setup_cpu = time.perf_counter() - wall, time.process_time() - cpu
    finish(trainer)
    row = {
        "seconds": time.perf_counter() - wall, "setup": setup, "cpu_seconds": time.process_time() - cpu, "setup_cpu": setup_cpu,
        "gaussians": len(trainer.gaussians), "bytes": model_bytes(trainer), "steps": config.steps,
    }  # fmt: skip
    options = options_for(config.rule, scene.background, trainer.gaussians)
    scores = [score(v, render_view(trainer.gaussians, v, options)[0]) for v in test]
    return row | {"psnr": statistics.mean(s.psnr for s in scores), "ssim": statistics.mean(s.ssim for s in scores)}


def measured(scene: Scene, split: str, device: torch.device, chosen: list[Trial], seeds: list[int], done: dict, echo, save):
    """Run what ``done`` does not hold yet, seed by seed so that whatever else the machine does meets all alike."""
    todo = [(s, t) for s in seeds for t in chosen if not any(r["trial"] == t.name and r["seed"] == s for r in done["rows"])]
    if not todo:
        return done
    began = time.perf_counter()
    warm = dataclasses.replace(PRESETS["quick"], steps=30)
    fit_once(scene, split, warm, device)  # compiles
    second = fit_once(scene, split, warm, device)
    per_step = (second["seconds"] - second["setup"]) / 30
    predicted = sum(second["setup"] + 1.5 * per_step * t.config.steps for _, t in todo)
    echo(f"{len(todo)} fits, about {predicted:.0f} s")
    for seed, trial in todo:
        row = fit_once(scene, split, dataclasses.replace(trial.config, seed=seed), device)
        done["rows"].append({"trial": trial.name, "knob": trial.knob, "preset": trial.preset, "seed": seed, **row})
        save(done)
        echo(
            f"  {trial.name:<30} seed {seed}  {row['seconds']:6.1f} s  {row['cpu_seconds']:6.1f} s of processor  "
            f"{row['psnr']:.2f} dB  {row['ssim']:.4f}  {row['gaussians']:,} Gaussians"
        )
    echo(f"took {time.perf_counter() - began:.0f} s")
    return done


def summary(rows: list[dict], time_key: str) -> list[dict]:
    """Mean over seeds of each trial, with half the 95 % interval of the paired difference to `quick` for PSNR and SSIM."""
    base = {r["seed"]: r for r in rows if r["trial"] == "quick"}
    t = {2: 12.71, 3: 4.30, 4: 3.18, 5: 2.78}  # Student's t by number of seeds
    made = []
    for name in dict.fromkeys(r["trial"] for r in rows):
        own = [r for r in rows if r["trial"] == name]
        line = {"trial": name, "knob": own[0]["knob"], "preset": own[0]["preset"], "seeds": len(own)}
        line["seconds"] = statistics.mean(r[time_key] for r in own)
        line["gaussians"] = statistics.mean(r["gaussians"] for r in own)
        for key in ("psnr", "ssim"):
            line[key] = statistics.mean(r[key] for r in own)
            line[f"{key}_sd"] = statistics.stdev([r[key] for r in own]) if len(own) > 1 else 0.0
            pairs = [r[key] - base[r["seed"]][key] for r in own if r["seed"] in base]
            line[f"{key}_gain"] = statistics.mean(pairs) if pairs else 0.0
            spread = statistics.stdev(pairs) if len(pairs) > 1 else 0.0
            line[f"{key}_bar"] = t.get(len(pairs), 2.6) * spread / max(1, len(pairs)) ** 0.5
        made.append(line)
    return made
