"""PSNR of held-out views against wall time from the start of the shell, beside gsplat's and Faster-GS's own training.

Every fit is a process of its own, alone on the machine. Ours is the whole command `warpgs fit`, with scores, report and files.
The schedule of a fit depends on its number of steps, so a fit that is stopped early is no short fit: for each of --fractions, a
whole fit with that part of all steps is a point. The rivals likewise: all numbers of steps of their schedules are scaled, as by
``--steps-scaler`` of gsplat's trainer. A rival's longest fit is also scored on the way, with its clock stopped. A rival's time
begins with its process, includes imports, reading the scene and copying it to the device, and ends with its last step.

Rivals begin at the first points of our `default` (without extrapolated ones), written once by a process of their own. Our times
include making them; the table has rivals' times with and without the time that it took. They use their own settings and a black
background. gsplat: settings of its trainer (bench/lib/gsplat_trainer.py), 30,000 steps scaled to --steps; MCMC up to --cap
Gaussians. Faster-GS: its own trainer (bench/lib/faster_gs_trainer.py). Kernels are compiled before the first fit. Rows in --out
are kept when the command is repeated. --svg draws the chart; --one is for the processes of the program itself.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch

from bench.lib import faster_gs_trainer, gsplat_trainer, one_fit, result_file
from bench.lib.arguments import parse
from bench.lib.one_fit import Fit, scores
from bench.lib.plot import Line, Panel, chart
from bench.lib.pool import stored_rows
from bench.lib.scenes import made, row_of, scene_at, shrunk
from bench.lib.tables import markdown
from warpgs.errors import UsageError
from warpgs.io.load import split_views
from warpgs.pipeline.run.request import choose_device
from warpgs.pipeline.train.settings import settings_by_views
from warpgs.scene import Gaussians, Scene, View

WHAT = "PSNR of held-out views against wall time from the start of the shell"
OURS, FASTER_GS, GSPLAT = "warpgs", "Faster-GS", {"gsplat": "default", "gsplat MCMC": "mcmc"}
RIVALS = (*GSPLAT, FASTER_GS)
MARKS = tuple(0.75**k for k in range(14, 0, -1))
"""Parts of the steps after which the longest fit of a rival is scored."""
BELOW = (3.0, 2.0, 1.0, 0.0)
"""Distances from a rival's last score [dB] at which times are compared."""


def loaded(fit: Fit) -> tuple[Scene, list[View], list[View]]:
    """Return the scene of a fit, its training views and its held-out views."""
    scene = scene_at(fit.folder, fit.downscale)
    split = split_views(scene, fit.split)
    return scene, *([scene.view(name) for name in names] for names in (split.train, split.test))


def write_points(fit: Fit, path: Path) -> dict:
    """Write the first points of `default` without extrapolated ones; return the time that it took."""
    scene, train, _ = loaded(fit)
    began = time.monotonic()
    first = one_fit.start_of(fit, scene, train)
    np.savez(path, means=first.means.detach().cpu().numpy(), dc=first.sh.detach()[:, :1].cpu().numpy())
    return {"points": len(first), "points_seconds": time.monotonic() - began}


def rival(fit: Fit, program: str, steps: int, cap: int, points: Path, began: float, marks: tuple[float, ...]) -> dict:
    """Train a rival; return its time since ``began`` (of `time.monotonic`), and its scores at the end and after ``marks``."""
    (scene, train, test), cuda = loaded(fit), torch.device(fit.device).type == "cuda"
    means, dc = (torch.from_numpy(array).to(fit.device) for array in np.load(points).values())
    first = Gaussians(means, *(means.new_zeros(len(means), n) for n in (4, 3)), means.new_zeros(len(means)), dc)
    looks, curve, stopped = {round(part * steps) for part in marks}, [], 0.0

    def now() -> float:
        if cuda:
            torch.cuda.synchronize()
        return time.monotonic() - began - stopped

    def score(image: Callable[[View], np.ndarray]) -> float:
        return scores(map(image, test), test)["psnr"]

    def look(step: int, image: Callable[[View], np.ndarray]) -> None:
        nonlocal stopped
        if step in looks:
            at = now()
            curve.append({"seconds": at, "step": step, "psnr": score(image)})
            stopped += now() - at

    setup = now()
    if program == FASTER_GS:
        count, image = faster_gs_trainer.train(scene, train, first, steps, seed=fit.seed, watch=look)
    else:
        settings, cameras = gsplat_trainer.scaled_settings(GSPLAT[program], steps, cap), [v.camera for v in scene.views]
        unit = gsplat_trainer.own_scale(cameras, scene.normalization)
        size = gsplat_trainer.scene_scale(cameras, unit)

        def drawn(params: dict) -> Callable[[View], np.ndarray]:
            return lambda view: gsplat_trainer.image_of(params, view, unit)

        watch = lambda step, params: look(step, drawn(params))  # noqa: E731
        params = gsplat_trainer.train(train, first, settings, seed=fit.seed, scale=unit, size=size, watch=watch)
        count, image = len(params["means"]), drawn(params)
    row = {"seconds": now(), "setup": setup, "gaussians": count, "psnr": score(image), "curve": curve}
    return row | ({"peak_torch_bytes": torch.cuda.max_memory_allocated()} if cuda else {})


def run(words: list[str], work: Path) -> float:
    """Run a command without maps of an earlier one; return its time [s]; raise UsageError with its last words if it fails."""
    env, began = os.environ | {"WARPGS_CACHE": tempfile.mkdtemp(dir=work)}, time.monotonic()
    words = [sys.executable, "-m", *words]
    done = subprocess.run(words, cwd=result_file.ROOT, env=env, capture_output=True, text=True, check=False)
    if done.returncode:
        raise UsageError(f"{' '.join(words[:4])} ended with {done.returncode}: {done.stderr[-1500:]}")
    return time.monotonic() - began


def ours(fit: Fit, steps: int, work: Path) -> dict:
    """Return the time of the whole command `warpgs fit`, and the figures that it wrote."""
    out = Path(tempfile.mkdtemp(dir=work), "run")
    words = ["warpgs", "fit", fit.folder, "--out", str(out), "--split", fit.split, "--device", fit.device]
    wall = run([*words, "--downscale", str(fit.downscale), "--steps", str(steps), "--seed", str(fit.seed)], work)
    m = json.loads((out / "metrics.json").read_text("utf-8"))
    row = {"seconds": wall, "psnr": m["test"]["psnr"], "gaussians": m["gaussians"], "taken": m["steps"], **m["seconds"]}
    return row | {k: m[k] for k in ("wall_seconds", "peak_torch_bytes") if k in m}


def alone(fit: Fit, work: Path, **call) -> dict:
    """Run `rival`, or `write_points` without a program, in a process of its own; return its row."""
    told = Path(tempfile.mkdtemp(dir=work), "row.json")
    text = json.dumps({"fit": vars(fit), "began": time.monotonic()} | call)
    run(["bench.fits.time_to_score", ".", "--one", text, "--out", str(told)], work)
    return json.loads(told.read_text("utf-8"))


def one(fit: dict, points: str, began: float, program: str = "", **call) -> dict:
    """Do what `alone` asked for."""
    return (
        rival(Fit(**fit), program, points=Path(points), began=began, **call)
        if program
        else write_points(Fit(**fit), Path(points))
    )


def reached(runs: list[dict], score: float, points: bool = False) -> float:
    """Return the least time at which a run had a score [s], with that of the first points if ``points``; infinite for none."""
    found = ((at, r["points_seconds"] if points else 0.0) for r in runs for at in (r, *r.get("curve", ())))
    return min((at["seconds"] + more for at, more in found if at["psnr"] >= score), default=float("inf"))


def runs_of(rows: list[dict], scene: str, program: str) -> list[dict]:
    """Return the rows of a program on a scene."""
    return [r for r in rows if (r["row"], r["program"]) == (scene, program)]


def table(rows: list[dict]) -> str:
    """Return, for each rival and scene, the times at which it and we reach its last score, and less."""
    body = []
    for scene, program in dict.fromkeys((r["row"], r["program"]) for r in rows if r["program"] in RIVALS):
        runs = runs_of(rows, scene, program)
        longest, we = max(runs, key=lambda r: r["steps"]), runs_of(rows, scene, OURS)
        for below in BELOW:
            target = longest["psnr"] - below
            times = [reached(runs, target), reached(runs, target, points=True), reached(we, target)]
            cells = [f"{t:.1f}" for t in (*times, times[1] / times[2])]
            body.append([scene, program, f"{longest['steps']:,}", f"{below:g}", f"{target:.2f}", *cells])
    head = [
        "scene",
        "rival",
        "steps",
        "below its last [dB]",
        "PSNR [dB]",
        "rival [s]",
        "with points [s]",
        "warpgs [s]",
        "ratio",
    ]
    return markdown(head, body, ("scene", "rival"))


def picture(rows: list[dict]) -> str:
    """Return the chart: whole fits, and dashed the way of a rival's longest fit; rivals' times with the first points."""
    panels = []
    for scene in dict.fromkeys(r["row"] for r in rows):
        lines = []
        for color, program in enumerate((OURS, *RIVALS)):
            runs = runs_of(rows, scene, program)
            for words, dashed in (("", False), (", on the way", True)):
                found = [(at, r.get("points_seconds", 0.0)) for r in runs for at in (r.get("curve", ()) if dashed else [r])]
                if places := tuple(sorted((at["seconds"] + more, at["psnr"]) for at, more in found)):
                    lines.append(Line(program + words, places, color, dashed))
        panels.append(Panel(scene, "seconds from the start of the shell", "PSNR [dB]", tuple(lines), linear=True))
    return chart(WHAT, panels)


def main(arguments: list[str] | None = None) -> int:
    """Measure, print, write after each fit; return 1 if a fit failed."""
    a = parse(
        __doc__, arguments, {"data": Path}, rows=["fern:17", "horns:54", "fox:all", "room@every:8"],
        programs=[OURS, *RIVALS], fractions=[1.0, 0.5, 0.25, 0.125], steps=7000, cap=1_000_000, seconds=float("inf"), shrink=1,
        device="auto", out=Path, svg=Path, one="",
    )  # fmt: skip
    if a.one:
        a.out.write_text(json.dumps(one(**json.loads(a.one))), "utf-8")
        return 0
    device, ended, failed, starts = choose_device(a.device)[0], time.monotonic() + a.seconds, 0, {}
    rows = stored_rows(a.out)
    with tempfile.TemporaryDirectory() as place:
        with contextlib.suppress(ImportError):
            one_fit.compile_all(("default", "gsplat"), str(device))
        for fraction, name, program in ((f, n, p) for f in a.fractions for n in a.rows for p in a.programs):
            row, work = shrunk(row_of(name), a.shrink), Path(place)
            fit = Fit(name, "gsplat", 0, str(made(a.data.resolve(), row, work)), row.split, "", row.downscale, str(device))
            whole = settings_by_views(one_fit.config_of("default"), loaded(fit)[1], device.type)[0].steps
            steps = max(1, round(fraction * (whole if program == OURS else a.steps)))
            key = {"row": name, "program": program, "steps": steps}
            if any(key.items() <= r.items() for r in rows) or time.monotonic() > ended:
                continue
            points = str(work / f"{row.scene.replace('/', '_')}.npz")
            try:
                if program == OURS:
                    found = ours(fit, steps, work)
                else:
                    starts[name] = starts.get(name) or alone(fit, work, points=points)
                    call = {
                        "program": program,
                        "steps": steps,
                        "cap": a.cap,
                        "marks": MARKS if fraction == max(a.fractions) else (),
                    }
                    found = starts[name] | alone(fit, work, points=points, **call)
            except UsageError as e:
                failed += 1
                print(f"failed: {key}: {e}", flush=True)
                continue
            rows.append(key | {"fraction": fraction} | found)
            figures = f"{found['gaussians']:,} Gaussians, {found['setup']:.1f} of {found['seconds']:.1f} s"
            print(f"{name} {program}, {steps:,} steps: {figures}, {found['psnr']:.2f} dB", flush=True)
            result_file.keep(a.out, WHAT, device, rows, cap=a.cap)
    print(table(rows))
    if a.svg and rows:
        a.svg.write_text(picture(rows), "utf-8")
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
