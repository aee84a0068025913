"""Size, error and cost in PSNR of each file format, on the held-out views of runs, and with cleaning.

usage: python -m bench.formats RUN ... [--splat-transform CLI] [--out bench/results/formats_cpu2.json]

A run is written in each format, read back and rendered at its held-out views; the difference to the PSNR of the model in memory
is what the format costs. CLI is the command of npm's @playcanvas/splat-transform (such as "node cli.mjs"): with it, each file
is read by that program, too, written as .glb, and compared with what this program reads.
"""

from __future__ import annotations

import argparse
import shlex
import subprocess
import tempfile
import time
from pathlib import Path

import torch

from bench import result_file
from warpgs.coordinates import convert_gaussians
from warpgs.export import spz
from warpgs.export.arrays import arrays_of
from warpgs.export.formats import FORMATS, read_gaussians
from warpgs.geometry import rotation_matrices
from warpgs.pipeline.runs.commands import scene_of
from warpgs.pipeline.runs.folder import StoredRun, open_run
from warpgs.pipeline.runs.results import evaluate_run
from warpgs.pipeline.runs.share import export
from warpgs.pipeline.runs.share_filters import Filters
from warpgs.scene import Gaussians

WHAT = "file size, differences from the model and loss of PSNR on held-out views of each file format"


def _scores(run: StoredRun, gaussians: Gaussians, views: tuple) -> float:
    metrics = evaluate_run(None, gaussians, *views, run.rule, run.background)
    return float(metrics["test"]["psnr"])


def _foreign(command: str, file: Path, folder: Path) -> dict:
    """Return how another program's reading of a file differs from ours; both keep the order of the file."""
    target = folder / "foreign.glb"  # as PLY it would hold infinite logits for opacities of 0 and 255
    subprocess.run([*shlex.split(command), "-w", "-q", str(file), str(target)], check=True, capture_output=True)
    ours, theirs = read_gaussians(file), read_gaussians(target)
    out: dict = {"count": len(theirs), "same_count": len(ours) == len(theirs)}
    for name in ("means", "log_scales", "logit_opacities", "sh"):
        a, b = (getattr(g, name).double() for g in (ours, theirs))
        if name == "logit_opacities":
            a, b = a.sigmoid(), b.sigmoid()
        out[name] = float((a.mean(0) - b.mean(0)).abs().max())
    out["box"] = max(float((f(ours.means, 0) - f(theirs.means, 0)).abs().max()) for f in (torch.amin, torch.amax))
    out["rotation"] = float((_axes(ours) - _axes(theirs)).abs().max())
    return out


def _axes(g: Gaussians) -> torch.Tensor:
    """Return the rotation matrices [N, 3, 3] without the signs of the axes, which change no Gaussian."""
    return torch.as_tensor(rotation_matrices(torch.nn.functional.normalize(g.quats.double(), dim=1))).abs()


def rows_of(folder: Path, command: str | None) -> list[dict]:
    """Return a row for each format of a run, and one for each with cleaning."""
    run = open_run(folder, "cpu")
    _, train, test = scene_of(run)
    views, reference = (train, test), run.gaussians()
    base = _scores(run, reference, views)
    rows = []
    with tempfile.TemporaryDirectory() as name:
        for suffix in FORMATS:
            for clean in (False, True):
                file = Path(name) / f"model{suffix}"
                start = time.perf_counter()
                lines = export(folder, file, Filters(clean=clean))
                written = time.perf_counter() - start
                start = time.perf_counter()
                back = read_gaussians(file)
                seconds = {"write_s": round(written, 2), "read_s": round(time.perf_counter() - start, 2)}
                there = convert_gaussians(back, run.normalization, "file", "scene")
                row = {
                    "run": folder.name, "format": suffix, "clean": clean, "gaussians": len(back), "degree": back.sh_degree,
                    "of": len(reference), "of_degree": reference.sh_degree, "bytes": file.stat().st_size, **seconds,
                    "psnr": base, "loss_db": base - _scores(run, there, views), "said": lines[:-1],
                }  # fmt: skip
                if command and not clean and suffix in (".ply", ".compressed.ply", ".splat", ".spz", ".sog"):
                    row["splat_transform"] = _foreign(command, file, Path(name))
                rows.append(row)
        for version in spz.VERSIONS:
            file = Path(name) / "version.spz"
            file.write_bytes(b"".join(spz.encode(arrays_of(read_gaussians(Path(name) / "model.ply")), version)))
            there = convert_gaussians(read_gaussians(file), run.normalization, "file", "scene")
            rows.append({
                "run": folder.name, "format": f".spz version {version}", "clean": True, "bytes": file.stat().st_size,
                "psnr": base, "loss_db": base - _scores(run, there, views),
            })  # fmt: skip
    return rows


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="+", type=Path)
    parser.add_argument("--splat-transform")
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    rows = [row for run in a.runs for row in rows_of(run, a.splat_transform)]
    for row in rows:
        print(
            f"{row['run']:<12} {row['format']:<18} clean {row['clean']!s:<5} {row['bytes'] / 2**20:8.3f} MiB  "
            f"{row['loss_db']:+.4f} dB  {row.get('splat_transform', '')}"
        )
    result_file.write(a.out, result_file.result(WHAT, torch.device("cpu"), rows))


if __name__ == "__main__":
    main()
