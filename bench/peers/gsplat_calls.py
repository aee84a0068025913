"""The same calls of `rasterization` on gsplat and on `warpgs.compat.gsplat`: images, gradients, ``meta`` and times of both.

Inputs are random, with a fixed seed. Differences are the largest and the median: of colours and alphas in levels of
1/255, of all else relative to gsplat's largest value; of rows of ``meta`` where a Gaussian is visible in both. A call that a
program refuses has the reason in its row. Times are of forward and backward pass. --only selects calls by beginnings of names.
"""

from __future__ import annotations

import importlib
from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.gsplat_calls import CALLS, GSPLAT, OURS, row_of
from warpgs.compat import gsplat as compat

WHAT = "the same calls of gsplat's rasterization on gsplat and on warpgs.compat.gsplat, on random inputs"


def main() -> None:
    """Make the calls, print each row, write after each."""
    a = parse(__doc__, gaussians=30_000, width=1280, height=720, repeats=20, only="", out=Path)
    try:
        programs = {OURS: compat.rasterization, GSPLAT: importlib.import_module("gsplat").rasterization}
    except (ImportError, OSError) as e:
        raise SystemExit(f"gsplat cannot be imported ({e}): install gsplat 1.6.0 to compare with it") from e
    device, rows = torch.device("cuda" if torch.cuda.is_available() else "cpu"), []
    for name in (name for name in CALLS if name.startswith(a.only)):
        rows.append({"call": name} | row_of(CALLS[name], programs, a.gaussians, a.width, a.height, a.repeats))
        print(*(f"{k}: {v}" for k, v in rows[-1].items()), sep="\n  ", flush=True)
        result_file.keep(a.out, WHAT, device, rows, gaussians=a.gaussians, width=a.width, height=a.height, repeats=a.repeats)


if __name__ == "__main__":
    main()
