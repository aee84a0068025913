"""Presets side by side, and beside gsplat's default strategy, on named rows with several seeds.

usage: python -m bench.presets DATA --rows fern:3 horns:54 ... --presets default 3dgs ... [--gsplat] [--leave-out K]
           [--seeds 5] [--jobs 1] [--seconds S] [--device auto] --out FILE.json
       python -m bench.presets --table FILE.json ... [--base default]
A preset may carry settings: ``default:optimizer.scales_lr=0.1``. The views of the split are scored, or with --leave-out K
training views that the fit did not see, by which settings may be chosen. Seeds come one after the other, the longest fits of
each first. Rows that FILE.json holds are kept when the command is given again, those that failed are tried again. Times mean
something with --jobs 1 alone; the table puts others in brackets.
"""

from __future__ import annotations

import argparse
import functools
import math
import sys
import tempfile
from pathlib import Path

import torch

from bench import result_file
from bench.machine import describe
from bench.one_fit import PEER, PEER_POINTS, PEER_STEPS, PEERS, Fit, compile_all, config_of, measure, plan
from bench.pool import finished
from bench.preset_table import tables
from bench.rows import ROWS, Row, made, row_of, scene_at, shrunk
from warpgs.errors import UsageError, WarpgsError
from warpgs.pipeline.runs.request import choose_device
from warpgs.pipeline.train.by_views import steps_by_views

WHAT = "scores, sizes and times of fits by row, preset and seed"


def fits(a: argparse.Namespace, rows: dict[str, Row], folders: dict[str, str], device: torch.device) -> list[Fit]:
    """Return all fits that were asked for: seeds in order, the longest of each seed first."""

    def work(fit: Fit) -> float:
        steps = a.peer_steps if fit.preset in PEERS else config_of(fit.preset, device).steps
        views = rows[fit.row].views
        return (steps or steps_by_views(views)) * (views + 20)  # roughly: more views mean more Gaussians and a longer start

    found = []
    for seed in range(a.first_seed, a.first_seed + a.seeds):
        own: list[Fit] = []
        for name, row in rows.items():
            known = scene_at(folders[name], row.downscale).points is not None
            for preset in [*a.presets, *((PEER, PEER_POINTS)[: 1 + known] if a.gsplat else ())]:
                own += plan(
                    name, preset, seed, folders[name], (row.split, row.downscale), a.leave_out, str(device), a.peer_steps
                )
        found += sorted(own, key=work, reverse=True)
    return found


def stored_rows(path: Path) -> list[dict]:
    """Return the finished rows of a file, none where there is no file; those that failed are left out.

    Raises:
        UsageError: They were measured at another commit.
    """
    if not path.is_file():
        return []
    stored, now = result_file.read(path), describe(torch.device("cpu"))["commit"]
    if stored["commit"] != now:
        raise UsageError(f"{path} was measured at commit {stored['commit']}, this is {now}; choose another --out")
    return [row for row in stored["rows"] if "error" not in row]


def line(row: dict) -> str:
    """Return a result in words."""
    head = f"{row['row']:<9} {row['preset']:<24} seed {row['seed']}"
    if "error" in row:
        return f"{head}  failed: {row['error']}"
    return f"{head}  {row['psnr']:.2f} dB  {row['gaussians']:,} Gaussians  {row['steps']} steps  {row['training']:.1f} s"


def measure_all(tasks: list[Fit], a: argparse.Namespace, device: torch.device) -> list[dict]:
    """Run the fits that the file lacks and write it after each; returns all rows."""
    rows = stored_rows(a.out)
    todo = [t for t in tasks if not any(t.key.items() <= row.items() for row in rows)]
    presets = tuple(dict.fromkeys(t.preset for t in todo))
    first = functools.partial(compile_all, presets, str(device))
    done = 0
    for task, figures in finished(measure, todo, a.jobs, a.seconds, first):
        rows.append(task.key | {"jobs": a.jobs} | figures)
        done += 1
        print(f"{done}/{len(todo)}", line(rows[-1]), flush=True)
        result_file.write(a.out, result_file.result(WHAT, device, rows))
    if done < len(todo):
        print(
            f"{len(todo) - done} fits were not begun: --seconds {a.seconds:g} had passed; give the command again for the rest"
        )
    return rows


def parsed(arguments: list[str] | None) -> argparse.Namespace:
    """Return the arguments."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("data", type=Path, nargs="?", help="folder of the scenes")
    p.add_argument("--rows", nargs="+", default=list(ROWS), help=f"{', '.join(ROWS)}, or FOLDER@SPLIT@DOWNSCALE")
    p.add_argument("--presets", nargs="+", default=["default"])
    p.add_argument("--gsplat", action="store_true", help="gsplat's default strategy, too")
    p.add_argument("--peer-steps", type=int, default=PEER_STEPS, help="steps of gsplat")
    p.add_argument("--leave-out", type=int, default=0, help="training views to score instead of held-out ones")
    p.add_argument("--seeds", type=int, default=5)
    p.add_argument("--first-seed", type=int, default=0)
    p.add_argument("--jobs", type=int, default=1, help="fits at a time")
    p.add_argument("--seconds", type=float, default=math.inf, help="after this long no further fit is begun")
    p.add_argument("--shrink", type=int, default=1, help="further factor by which images shrink, to try the command")
    p.add_argument("--device", default="auto")
    p.add_argument("--out", type=Path)
    p.add_argument("--table", type=Path, nargs="+", help="files to print as tables; nothing is measured")
    p.add_argument("--base", default="default", help="preset that the others are compared with")
    a = p.parse_args(arguments)
    if a.table is None and (a.data is None or a.out is None):
        p.error("DATA and --out are needed, or --table")
    return a


def main(arguments: list[str] | None = None) -> int:
    """Measure and print the tables, or print those of files; return the exit code."""
    a = parsed(arguments)
    if a.table is not None:
        print(tables([row for path in a.table for row in result_file.read(path)["rows"]], a.base))
        return 0
    device = choose_device(a.device)[0]
    try:
        rows = {name: shrunk(row_of(name), a.shrink) for name in a.rows}
        with tempfile.TemporaryDirectory() as work:
            folders = {name: made(a.data, row, Path(work)) for name, row in rows.items()}
            found = measure_all(fits(a, rows, folders, device), a, device)
    except WarpgsError as e:
        print(f"bench.presets: {e}", file=sys.stderr)
        return 2
    print(tables(found, a.base))
    return int(any("error" in row for row in found))


if __name__ == "__main__":
    sys.exit(main())
