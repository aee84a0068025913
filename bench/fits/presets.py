"""Presets side by side, and beside gsplat's default strategy, on named rows with several seeds.

A preset may carry settings: ``default:optimizer.scales_lr=0.1``, ``gsplat:steps=1000,sh_degree=0,background=mean``;
``pruned/PRESET`` is a fit that is pruned afterwards. The held-out views of the split are scored. With --leave-out K, training
views are left out and scored instead, to choose settings: each in turn if there are up to four, else K at once. Seeds run one
after the other, the longest fits of each seed first. Rows in --out are kept when the command is repeated; failures are tried
again. Times measured beside other fits are in brackets. --fixed PRESET adds a table of bytes against quality, paired with that
preset; --shrink N makes images smaller by a further factor, to try the command.
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
from bench.lib.one_fit import PEER, PEER_POINTS, Fit, compile_all, config_of, is_peer, measure, peer_settings, plan
from bench.lib.pool import measure_all
from bench.lib.preset_table import tables
from bench.lib.scenes import ROWS, Row, made, row_of, scene_at, shrunk
from warpgs.errors import UsageError, WarpgsError
from warpgs.pipeline.run.request import choose_device
from warpgs.pipeline.train.settings import steps_by_views

WHAT = "scores, sizes and times of fits by row, preset and seed"


def fits(a: argparse.Namespace, rows: dict[str, Row], folders: dict[str, str], device: torch.device) -> list[Fit]:
    """Return all fits that were asked for: seeds in order, the longest of each seed first."""

    def work(fit: Fit) -> float:
        steps = peer_settings(fit.preset, []).steps if is_peer(fit.preset) else config_of(fit.preset).steps
        views = rows[fit.row].views
        return (steps or steps_by_views(views)) * (views + 20)  # roughly: more views mean more Gaussians and a longer start

    found = []
    for seed in range(a.first_seed, a.first_seed + a.seeds):
        own: list[Fit] = []
        for name, row in rows.items():
            known = scene_at(folders[name], row.downscale).points is not None
            for preset in [*a.presets, *((PEER, PEER_POINTS)[: 1 + known] if a.gsplat else ())]:
                place = (row.split, row.downscale)
                own += plan(name, preset, seed, folders[name], place, a.leave_out, str(device))
        found += sorted(own, key=work, reverse=True)
    return found


def line(row: dict) -> str:
    """Return a result in words."""
    return f"{row['psnr']:.2f} dB  {row['gaussians']:,} Gaussians  {row['steps']} steps  {row['training']:.1f} s"


def main(arguments: list[str] | None = None) -> int:
    """Measure and print the tables, or print those of files; return the exit code."""
    a = parse(
        __doc__, arguments, {"data?": Path}, rows=list(ROWS), presets=["default"], gsplat=False, leave_out=0, seeds=5,
        first_seed=0, jobs=1, seconds=math.inf, shrink=1, device="auto", out=Path, table=[Path], base="default", fixed=str,
    )  # fmt: skip
    if a.table:
        print(tables([row for path in a.table for row in result_file.read(path)["rows"]], a.base, a.fixed))
        return 0
    device = choose_device(a.device)[0]
    try:
        if a.data is None or a.out is None:
            raise UsageError("DATA and --out are needed, or --table")
        rows = {name: shrunk(row_of(name), a.shrink) for name in a.rows}
        with tempfile.TemporaryDirectory() as work:
            folders = {name: made(a.data, row, Path(work)) for name, row in rows.items()}
            tasks = fits(a, rows, folders, device)
            first = functools.partial(compile_all, tuple(dict.fromkeys(t.preset for t in tasks)), str(device))
            found = measure_all(measure, tasks, first, a, WHAT, device, line)
    except WarpgsError as e:
        print(f"bench.fits.presets: {e}", file=sys.stderr)
        return e.exit_code
    print(tables(found, a.base, a.fixed))
    return int(any("error" in row for row in found))


if __name__ == "__main__":
    sys.exit(main())
