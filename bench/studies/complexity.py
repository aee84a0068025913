"""Bytes against PSNR of runs that are pruned at increasing losses of training PSNR, with a chart.

RUN is a run folder, such as each scene's first seed of a study of `warpgs compare`. curve.json and curve.svg are written to
--out. `bench.fits.presets --fixed` compares fits of fixed size, without harmonics, and pruned, over seeds.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

from bench.lib import pareto, result_file
from bench.lib.arguments import parse
from bench.lib.tables import named
from warpgs.errors import WarpgsError
from warpgs.files import write_text
from warpgs.pipeline.run.commands import prune
from warpgs.pipeline.run.request import choose_device

WHAT = "what is left of a model when it is pruned, by the training PSNR that is given up"
KEEP = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0)
"""Losses of training PSNR at which a run is pruned [dB]."""
FIGURES = {"gaussians": "count", "mean_degree": "mean_degree", "bytes": "bytes", "train_psnr": "train_psnr"}


def curve_rows(run: Path, device: str) -> list[dict]:
    """Return rows of the run itself, and of the run pruned at each loss of `KEEP`."""
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for keep in KEEP:
            out = Path(folder) / f"{keep:g}"
            prune(run, keep, out, device)
            p = json.loads((out / "config.json").read_text("utf-8"))["pruned"]
            for i in (0, 1) if not rows else (1,):
                row = {"run": run.name, "keep_db": keep if i else 0.0} | {name: p[key][i] for name, key in FIGURES.items()}
                rows.append(row | {"psnr": p["test_psnr"][i] if p["test_psnr"] else float("nan")})
    return rows


def chart(rows: list[dict]) -> str:
    """Return held-out PSNR against megabytes as SVG: a colour for each run, a square for the run as it was fitted."""
    points = tuple(
        pareto.Point(f"{r['run']}, {r['keep_db']:g} dB", r["run"], r["bytes"] / 1e6, r["psnr"], preset=not r["keep_db"])
        for r in rows
    )
    what = "by the loss of training PSNR that is allowed"
    panel = pareto.Panel("runs", what, "bytes of the model [MB]", "held-out PSNR [dB]", points, upwards=True, log_y=False)
    return pareto.chart("What is left when a model is pruned", [panel])


def main(arguments: list[str] | None = None) -> int:
    """Prune the runs, write rows and chart; return an exit code."""
    a = parse(__doc__, arguments, {"runs": [Path]}, need=("out",), device="auto", out=Path)
    try:
        rows = [row for run in a.runs for row in curve_rows(run, a.device)]
    except WarpgsError as e:
        print(f"bench.studies.complexity: {e}", file=sys.stderr)
        return e.exit_code
    result_file.keep(a.out / "curve.json", WHAT, choose_device(a.device)[0], rows)
    write_text(a.out / "curve.svg", chart(rows))
    print(*map(named, rows), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
