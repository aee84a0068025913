"""Rivals under one rule, or the ladder from plain 3DGS to the method, on named rows with several seeds.

All start from the same points, stand before the same background, have the same degree and are scored alike. Steps of an arm are
chosen by leaving training views out: first with --tune, which writes --tuned; then without, which reads it and fits to all
training views. --most-steps leaves out arms of more steps. Rows that a file holds are kept when the command is given again.
--set ladder has the ladder.
"""

from __future__ import annotations

import argparse
import functools
import math
import sys
import tempfile
from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.arms import ARMS, GSPLAT, Arm, chosen_steps, steps_in
from bench.lib.one_fit import Fit, compile_all, is_peer, measure, plan
from bench.lib.pool import measure_all
from bench.lib.preset_table import means_table
from bench.lib.scenes import Row, made, row_of, shrunk
from warpgs.errors import UsageError, WarpgsError
from warpgs.pipeline.runs.request import choose_device

LEFT_OUT = 2
"""Training views left out at once where there are more than four; of fewer, each in turn."""
WHAT = "scores, sizes and times of methods by row and seed, under one rule"


def presets_of(arm: Arm, row: str, tuned: list[dict] | None) -> list[str]:
    """Return the presets to fit: of all numbers of steps where ``tuned`` is None, else of the chosen one."""
    if not arm.steps:
        return [] if tuned is None else [arm.preset]
    return [arm.with_steps(n) for n in (arm.steps if tuned is None else (chosen_steps(tuned, row, arm),))]


def fits(a: argparse.Namespace, rows: dict[str, Row], folders: dict[str, str], device: torch.device) -> list[Fit]:
    """Return all fits: seeds in order, the most steps of each seed first."""
    tuned, found = None if a.tune else result_file.read(a.tuned)["rows"], []
    for seed in range(1 if a.tune else a.seeds):
        own: list[Fit] = []
        for arm in ARMS[a.set]:
            for name, row in rows.items():
                for preset in presets_of(arm, name, tuned):
                    place = (row.split, row.downscale)
                    own += plan(name, preset, seed, folders[name], place, LEFT_OUT * a.tune, str(device))
        found += sorted(own, key=lambda fit: work(fit.preset), reverse=True)
    return [fit for fit in found if steps_in(fit.preset) <= a.most_steps]


def work(preset: str) -> float:
    """Return roughly what a fit takes, in steps: a step of two models takes as long as four."""
    return steps_in(preset) * (4 if "CorGS" in preset else 1)


def main(arguments: list[str] | None = None) -> int:
    """Measure and print the table; return the exit code."""
    a = parse(
        __doc__, arguments, {"data": Path}, rows=["fern:3", "horns:3"], set="rivals", tune=False, tuned=Path, most_steps=30_000,
        seeds=5, jobs=1, seconds=math.inf, shrink=1, device="auto", out=Path,
    )  # fmt: skip
    device = choose_device(a.device)[0]
    try:
        if a.tuned is None or a.set not in ARMS or (a.out is None and not a.tune):
            raise UsageError(f"--tuned is needed, --out without --tune, and a --set of {', '.join(ARMS)}")
        a.out = a.tuned if a.tune else a.out
        rows = {name: shrunk(row_of(name), a.shrink) for name in a.rows}
        with tempfile.TemporaryDirectory() as work:
            folders = {name: made(a.data, row, Path(work)) for name, row in rows.items()}
            tasks = fits(a, rows, folders, device)
            used = ("default", *((GSPLAT,) if any(is_peer(t.preset) for t in tasks) else ()))  # others use little else
            first = functools.partial(compile_all, used, str(device))
            found = measure_all(measure, tasks, first, a, WHAT, device, lambda r: f"{r['psnr']:.2f} dB  {r['training']:.1f} s")
    except WarpgsError as e:
        print(f"bench.fits.rivals: {e}", file=sys.stderr)
        return e.exit_code
    print(means_table(found))
    return int(any("error" in row for row in found))


if __name__ == "__main__":
    sys.exit(main())
