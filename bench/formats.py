"""Size of each file format, and its cost in PSNR on the held-out views of runs, whole and cleaned.

usage: python -m bench.formats RUN ... [--out bench/results/formats_fern_cpu2.json]

A run is written in each format, read back and rendered at its held-out views; what the PSNR is lower than that of the model in
memory is what the format costs. The last rows are SPZ in each version.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path

import torch

from bench import result_file
from warpgs.coordinates import convert_gaussians
from warpgs.export import spz
from warpgs.export.arrays import arrays_of
from warpgs.export.formats import FORMATS, read_gaussians
from warpgs.pipeline.runs.commands import scene_of
from warpgs.pipeline.runs.folder import StoredRun, open_run
from warpgs.pipeline.runs.results import evaluate_run
from warpgs.pipeline.runs.share import export
from warpgs.pipeline.runs.share_filters import Filters
from warpgs.scene import Gaussians

WHAT = "file size, and loss of PSNR on held-out views, of each file format"


class Scorer:
    """The held-out views of a run, and the PSNR of its own model on them."""

    def __init__(self, folder: Path) -> None:
        self.run: StoredRun = open_run(folder, "cpu")
        _, train, test = scene_of(self.run)
        self.views = (train, test)
        self.own = self._psnr(self.run.gaussians())

    def _psnr(self, gaussians: Gaussians) -> float:
        metrics = evaluate_run(None, gaussians, *self.views, self.run.rule, self.run.background)
        return float(metrics["test"]["psnr"])

    def loss(self, gaussians: Gaussians) -> float:
        """Return by how much the PSNR of Gaussians in file units is lower than that of the run's own model [dB]."""
        return self.own - self._psnr(convert_gaussians(gaussians, self.run.normalization, "file", "scene"))


def rows_of(folder: Path) -> list[dict]:
    """Return a row for each format of a run whole and cleaned, and one for each version of SPZ."""
    scorer, rows = Scorer(folder), []
    known = {"run": folder.name, "of": len(scorer.run.gaussians()), "psnr": scorer.own}
    with tempfile.TemporaryDirectory() as name:
        for suffix in FORMATS:
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
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    rows = [row for run in a.runs for row in rows_of(run)]
    for row in rows:
        print(
            f"{row['run']:<12} {row['format']:<18} clean {row['clean']!s:<5} {row['gaussians']:>8,} Gaussians "
            f"{row['bytes'] / 2**20:8.3f} MiB {row['loss_db']:+.4f} dB"
        )
    result_file.write(a.out, result_file.result(WHAT, torch.device("cpu"), rows))


if __name__ == "__main__":
    main()
