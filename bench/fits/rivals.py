"""Methods under one rule, side by side on named rows with several seeds; the ladder from plain 3DGS to the method; an ablation.

All arms of a set have the same initial points, background, degree and scores. If an arm lists several numbers of steps, the
number is chosen by scores on left-out training views: each in turn if there are up to four, the middle one first, or only the
first --folds of them; else two at once. Then all training views are fitted, seed by seed: every arm has a first seed before any
arm has a second one, and fits of more than 10,000 steps have further seeds last. Rows in --out are kept when the command is
repeated. --arms N selects the first N arms of the set. Arms of gsplat are left out where it is not installed, and those with a
segmentation network where the environment variable SEGMENTATION, the path of its ONNX file, is not set.
"""

from __future__ import annotations

import argparse
import functools
import math
import os
import sys
import tempfile
import time
from importlib.util import find_spec
from pathlib import Path

import torch

from bench.lib.arguments import parse
from bench.lib.arms import ARMS, GSPLAT, NETWORK, Arm, chosen_steps, steps_in
from bench.lib.one_fit import Fit, compile_all, is_peer, measure, plan
from bench.lib.pool import measure_all
from bench.lib.preset_table import means_table
from bench.lib.scenes import Row, made, row_of, shrunk
from warpgs.errors import UsageError, WarpgsError
from warpgs.pipeline.run.request import choose_device

LEFT_OUT = 2
"""Number of training views that are left out at once if there are more than four; else each is left out in turn."""
LONG = 10_000
"""Number of steps above which the further seeds of a fit come after those of shorter fits."""
WHAT = "scores, sizes and times of methods by row and seed, under one rule"


def work(fit: Fit) -> int:
    """Return roughly the time of a fit, in steps: a step of two models takes as long as four, one with more renders as two."""
    return steps_in(fit.preset) * (4 if "CorGS" in fit.preset else 2 if "rivals/" in fit.preset else 1)


def missing(arm: Arm) -> str:
    """Return what an arm needs that is not here; empty if nothing is missing."""
    if is_peer(arm.preset) and find_spec("gsplat") is None:
        return "gsplat is not installed"
    return f"{NETWORK} is not set" if f"${NETWORK}" in arm.preset and NETWORK not in os.environ else ""


class Study:
    """The fits of a set of arms."""

    def __init__(self, a: argparse.Namespace, rows: dict[str, Row], folders: dict[str, str], device: torch.device):
        """Keep the arguments, the rows by name, and the folders of their scenes."""
        self.arms, self.seeds, self.folds = [arm for arm in ARMS[a.set][: a.arms] if not missing(arm)], a.seeds, a.folds
        self.rows, self.folders, self.device = rows, folders, str(device)

    def _plan(self, row: str, preset: str, seed: int, left_out: int) -> list[Fit]:
        place = (self.rows[row].split, self.rows[row].downscale)
        return plan(row, preset, seed, self.folders[row], place, left_out, self.device)

    def tuning(self) -> list[Fit]:
        """Return the fits that choose steps, the longest first."""
        found = []
        for name in self.rows:
            for preset in (arm.with_steps(n) for arm in self.arms for n in arm.steps):
                fits = self._plan(name, preset, 0, LEFT_OUT)
                found += [*fits[len(fits) // 2 :], *fits[: len(fits) // 2]][: self.folds]
        return sorted(found, key=work, reverse=True)

    def scored(self, done: list[dict], tuned: bool) -> list[Fit]:
        """Return the fits to all training views, seed by seed; if not ``tuned``, only first seeds of arms with fixed steps."""
        presets = [(name, self._preset(done, name, arm)) for arm in self.arms for name in self.rows if tuned or not arm.steps]
        fits = [
            fit
            for seed in range(self.seeds if tuned else min(1, self.seeds))
            for name, preset in presets if preset
            for fit in self._plan(name, preset, seed, 0)
        ]  # fmt: skip
        return sorted(fits, key=lambda fit: fit.seed > 0 and steps_in(fit.preset) > LONG)

    def _preset(self, done: list[dict], name: str, arm: Arm) -> str | None:
        if not arm.steps:
            return arm.preset
        try:
            return arm.with_steps(chosen_steps(done, name, arm))
        except UsageError as e:  # the tuning was cut short
            print(f"not fitted: {e}")
            return None


def line(row: dict) -> str:
    """Return a result in words."""
    return f"{row['psnr']:.2f} dB  {row['training']:.1f} s"


def main(arguments: list[str] | None = None) -> int:
    """Measure and print the table; return the exit code."""
    a = parse(
        __doc__, arguments, {"data": Path}, rows=["fern:3", "horns:3"], set="rivals", arms=99, folds=99, seeds=5, jobs=1,
        seconds=math.inf, shrink=1, device="auto", out=Path,
    )  # fmt: skip
    device, began = choose_device(a.device)[0], time.monotonic()
    try:
        if a.set not in ARMS or a.out is None:
            raise UsageError(f"--out is needed, and a --set of {', '.join(ARMS)}")
        rows = {name: shrunk(row_of(name), a.shrink) for name in a.rows}
        with tempfile.TemporaryDirectory() as place:
            study = Study(a, rows, {name: made(a.data, row, Path(place)) for name, row in rows.items()}, device)
            for arm in ARMS[a.set][: a.arms]:
                if missing(arm):
                    print(f"left out: {arm.words}, because {missing(arm)}")
            used = ("default", *((GSPLAT,) if any(is_peer(arm.preset) for arm in study.arms) else ()))  # others use little else
            first = functools.partial(compile_all, used, str(device))
            found: list[dict] = []
            for tuned in (False, True):
                tasks = study.scored(found, True) if tuned else study.scored(found, False) + study.tuning()
                left = argparse.Namespace(**vars(a) | {"seconds": a.seconds - (time.monotonic() - began)})
                found = measure_all(measure, tasks, None if tuned else first, left, WHAT, device, line)
    except WarpgsError as e:
        print(f"bench.fits.rivals: {e}", file=sys.stderr)
        return e.exit_code
    print(means_table([row for row in found if not row["left_out"]]))
    return int(any("error" in row for row in found))


if __name__ == "__main__":
    sys.exit(main())
