"""Size of each file format, and its loss of PSNR on the held-out views of runs, whole and cleaned.

A run is written in each format, read back and rendered at its held-out views. The loss is the difference in PSNR to the model
in memory. The last rows are the versions of SPZ.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.scorer import Scorer
from warpgs.export import spz
from warpgs.export.base import arrays_of, read_gaussians, suffixes
from warpgs.pipeline.run.export import Filters, export

WHAT = "file size, and loss of PSNR on held-out views, of each file format"


def rows_of(folder: Path) -> list[dict]:
    """Return a row for each format of a run whole and cleaned, and one for each version of SPZ."""
    scorer, rows = Scorer(folder), []
    known = {"run": folder.name, "of": len(scorer.run.gaussians()), "psnr": scorer.own}
    with tempfile.TemporaryDirectory() as name:
        for suffix in suffixes():
            for clean in (False, True):
                file = Path(name) / f"model{suffix}"
                start = time.perf_counter()
                lines = export(folder, file, Filters(clean=clean))
                written = time.perf_counter() - start
                back = read_gaussians(file)
                rows.append(known | {
                    "format": suffix, "clean": clean, "gaussians": len(back), "degree": back.sh_degree,
                    "bytes": file.stat().st_size, "write_s": round(written, 2), "loss_db": scorer.loss(back),
                    "said": lines[:-1],
                })  # fmt: skip
        export(folder, whole := Path(name) / "whole.ply", Filters(clean=False))
        for version in spz.VERSIONS:
            file = Path(name) / "version.spz"
            file.write_bytes(b"".join(spz.encode(arrays_of(read_gaussians(whole)), version)))
            rows.append(known | {
                "format": f".spz version {version}", "clean": False, "gaussians": known["of"], "bytes": file.stat().st_size,
                "loss_db": scorer.loss(read_gaussians(file)),
            })  # fmt: skip
    return rows


def main() -> None:
    """Measure, print and write."""
    a = parse(__doc__, None, {"runs": [Path]}, out=Path)
    rows = [row for run in a.runs for row in rows_of(run)]
    for row in rows:
        print(
            f"{row['run']:<12} {row['format']:<18} clean {row['clean']!s:<5} {row['gaussians']:>8,} Gaussians "
            f"{row['bytes'] / 2**20:8.3f} MiB {row['loss_db']:+.4f} dB"
        )
    result_file.keep(a.out, WHAT, torch.device("cpu"), rows)


if __name__ == "__main__":
    main()
