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
from pathlib import Path

from bench.lib import one_fit, result_file
from bench.lib.arguments import parse
from bench.lib.one_fit import Fit
from bench.lib.pool import stored_rows
from bench.lib.scenes import made, row_of, shrunk
from bench.lib.score_times import MARKS, OURS, RIVALS, WHAT, loaded, picture, rival, table, write_points
from warpgs.errors import UsageError
from warpgs.pipeline.run.request import choose_device
from warpgs.pipeline.train.settings import settings_by_views


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
