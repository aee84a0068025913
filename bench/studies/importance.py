"""Effect of the placement of fine Gaussians: fits whose events sample by a single score, at several budgets.

An arm is SCORE/PRESET:SETTINGS, as in `bench.fits.presets`; a score is one of `bench.lib.importance_scores`, or ``own`` for the
importance of the settings. Training views are left out in turn and scored; only the oracles read them. The held-out views of
the split are scored, too. SCORE+log adds the correlation of each score with the gain in left-out views, for the first, the
middle and the last event. It also adds the correlation with the later gain of the first event's Gaussians in left-out views.
"""

from __future__ import annotations

import argparse
import functools
import math
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import torch

from bench.lib.arguments import parse
from bench.lib.one_fit import Fit, plan
from bench.lib.placed_by_score import measure, warm_up
from bench.lib.pool import measure_all
from bench.lib.scenes import ROWS, made, row_of, shrunk
from bench.lib.tables import markdown
from warpgs.errors import UsageError, WarpgsError
from warpgs.pipeline.run.request import choose_device

WHAT = "scores and sizes of fits whose fine Gaussians are placed by one score each"


def tasks(a: argparse.Namespace, rows: dict, folders: dict[str, str], device: torch.device) -> list[Fit]:
    """Return all fits: seeds in order, then arms, then rows."""
    found = []
    for seed in range(a.first_seed, a.first_seed + a.seeds):
        for arm in a.arms:
            for name, row in rows.items():
                found += plan(name, arm, seed, folders[name], (row.split, row.downscale), a.leave_out, str(device))
    return found


def line(row: dict) -> str:
    """Return a result in words."""
    return f"{row['psnr']:.2f} dB left out  {row['test_psnr']:.2f} held out  {row['gaussians']:,} Gaussians"


def table(rows: list[dict]) -> str:
    """Return means over left-out views and seeds by arm and row, and means of the log by truth and score."""
    groups: dict = defaultdict(list)
    names = list(dict.fromkeys(r["row"] for r in rows))
    for r in rows:
        if "error" not in r:
            groups[r["preset"], r["row"]].append(r)
    body = []
    for arm in dict.fromkeys(r["preset"] for r in rows):
        cells = []
        for name in names:
            own = groups[arm, name]
            mean = {
                k: math.fsum(r[k] for r in own) / len(own) if own else math.nan
                for k in ("psnr", "ssim", "test_psnr", "gaussians")
            }
            cells += [
                f"{mean['psnr']:.2f} / {mean['ssim']:.3f}",
                f"{mean['test_psnr']:.2f}",
                f"{mean['gaussians'] / 1e3:.1f}k",
                str(len(own)),
            ]
        body.append([arm, *cells])
    head = ["arm", *(f"{n} {w}" for n in names for w in ("left out", "held out", "count", "fits"))]
    parts = [markdown(head, body)]
    told: dict = defaultdict(list)
    for r in rows:
        for entry in r.get("log", []):
            told[entry["truth"], entry["score"], r["row"]].append(entry)
    if told:
        body = []
        for truth, score in dict.fromkeys((t, s) for t, s, _ in told):
            cells = []
            for n in names:
                own = told[truth, score, n]
                cells += [f"{math.fsum(e[k] for e in own) / max(1, len(own)):.2f}" for k in ("spearman", "lift")]
            body.append([truth, score, *cells])
        parts.append(markdown(["truth", "score", *(f"{n} {w}" for n in names for w in ("rho", "top 2 %"))], body))
    return "\n\n".join(parts)


def main(arguments: list[str] | None = None) -> int:
    """Measure and print the tables; return the exit code."""
    a = parse(
        __doc__, arguments, {"data": Path}, rows=list(ROWS), arms=["uniform/default"], leave_out=1, seeds=1, first_seed=0,
        jobs=1, seconds=math.inf, shrink=1, device="auto", out=Path,
    )  # fmt: skip
    device = choose_device(a.device)[0]
    try:
        if a.out is None:
            raise UsageError("--out is needed")
        rows = {name: shrunk(row_of(name), a.shrink) for name in a.rows}
        with tempfile.TemporaryDirectory() as work:
            folders = {name: made(a.data, row, Path(work)) for name, row in rows.items()}
            first = functools.partial(warm_up, str(Path(work, "tiny")), str(device))
            found = measure_all(measure, tasks(a, rows, folders, device), first, a, WHAT, device, line)
    except WarpgsError as e:
        print(f"bench.studies.importance: {e}", file=sys.stderr)
        return e.exit_code
    print(table(found))
    return int(any("error" in row for row in found))


if __name__ == "__main__":
    sys.exit(main())
