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
import sys
import tempfile
import time
from pathlib import Path

from bench.lib.arguments import parse
from bench.lib.arm_fits import ArmFits, missing
from bench.lib.arms import ARMS, GSPLAT
from bench.lib.one_fit import compile_all, is_peer, measure
from bench.lib.pool import measure_all
from bench.lib.preset_table import means_table
from bench.lib.scenes import made, row_of, shrunk
from warpgs.errors import UsageError, WarpgsError
from warpgs.pipeline.run.request import choose_device

WHAT = "scores, sizes and times of methods by row and seed, under one rule"


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
            study = ArmFits(a, rows, {name: made(a.data, row, Path(place)) for name, row in rows.items()}, device)
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
