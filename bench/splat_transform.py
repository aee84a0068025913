"""Files exchanged with npm's splat-transform: what it reads of ours, and what is read here of its own.

usage: python -m bench.splat_transform RUN --command "node PATH/cli.mjs" [--out bench/results/splat_transform_fern_cpu2.json]

CLI is that of @playcanvas/splat-transform, version 3. It needs Node 22, which npm has, too: after `npm install node@22
@playcanvas/splat-transform@3` in any folder, the command is "node_modules/.bin/node
node_modules/@playcanvas/splat-transform/bin/cli.mjs".

Of each file of ours, its statistics of every column (least, largest, mean, standard deviation, to 6 digits) are compared with
those of what is read here, in parts of the column's range. Each file that it writes of our PLY is read here, compared with that
PLY in the same way, and rendered at the held-out views.
"""

from __future__ import annotations

import argparse
import json
import shlex
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from bench import result_file
from bench.formats import Scorer
from warpgs.colors import C0
from warpgs.export import spz
from warpgs.export.arrays import arrays_of, gaussians_of, half_turn, unit_quats
from warpgs.export.formats import FORMATS, read_gaussians
from warpgs.geometry import rotation_matrices
from warpgs.pipeline.runs.share import export
from warpgs.pipeline.runs.share_filters import Filters
from warpgs.scene import Gaussians

WHAT = "differences between what splat-transform and this program read of the same files, and loss of PSNR of its own files"
READ = tuple(s for s in FORMATS if s not in (".glb", ".gltf"))
"""Formats of ours that it reads; of glTF it writes only."""
WRITTEN = (
    (".compressed.ply", ()), (".spz", ("--spz-version", "3")), (".spz", ("--spz-version", "4")), (".sog", ("-g", "cpu")),
    (".glb", ()),
)  # fmt: skip
"""Formats that it writes, with the words for that."""
STATISTICS = ("min", "max", "mean", "stdDev")


def statistics(gaussians: Gaussians, axes: bool = False) -> dict[str, list[float]]:
    """Return least, largest, mean and standard deviation of each column, as splat-transform names and states them.

    It takes them of the columns of PLY, and states those of scales, opacities and colours as lengths, opacities and colours.

    Args:
        gaussians: N Gaussians.
        axes: Whether rotations are stated as the sizes of the entries of their matrices instead of as they are: several
            quaternions stand for the same Gaussian.
    """
    a = {name: array.astype(np.float64) for name, array in arrays_of(gaussians).items()}
    quats = np.abs(rotation_matrices(unit_quats(a["quats"]))).reshape(-1, 9) if axes else a["quats"]
    rest = a["sh"][:, 1:].transpose(0, 2, 1).reshape(len(gaussians), -1)
    groups = (
        ("xyz", a["means"], lambda v: v), ("rot_", quats, lambda v: v), ("scale_", a["log_scales"], np.exp),
        ("opacity", a["logit_opacities"][:, None], lambda v: 1 / (1 + np.exp(-v))),
        ("f_dc_", a["sh"][:, 0], lambda v: 0.5 + C0 * v), ("f_rest_", rest, lambda v: v),
    )  # fmt: skip
    out = {}
    for name, table, stated in groups:
        for i, column in enumerate(table.T):
            key = name if name == "opacity" else "xyz"[i] if name == "xyz" else f"{name}{i}"
            out[key] = [float(stated(f(column))) for f in (np.min, np.max, np.mean, np.std)]
    return out


def difference(ours: dict[str, list[float]], theirs: dict[str, list[float]]) -> dict:
    """Return the largest difference of two statistics in parts of the range of its column, and where it is."""
    worst = {"largest_of_range": 0.0, "column": "", "columns": len(ours), "same_columns": set(ours) <= set(theirs)}
    for name in (n for n in ours if n in theirs):
        low, high = ours[name][:2]
        for which, a, b in zip(STATISTICS, ours[name], theirs[name]):
            found = abs(a - b) / (high - low if high > low else max(abs(low), 1e-30))
            if found > worst["largest_of_range"]:
                worst |= {"largest_of_range": found, "column": f"{name} {which}"}
    return worst


def turned(gaussians: Gaussians) -> Gaussians:
    """Return Gaussians turned by half a turn about x: splat-transform 3 stores SPZ in the axes of PLY, not in those of SPZ."""
    return gaussians_of(Path("turned"), half_turn(arrays_of(gaussians), "x"))


class Tool:
    """The program."""

    def __init__(self, command: str) -> None:
        self.words = shlex.split(command)
        self.version = self._run("--version").strip()

    def _run(self, *words: str) -> str:
        done = subprocess.run([*self.words, *words], check=True, capture_output=True, text=True)
        return done.stdout or done.stderr

    def statistics(self, file: Path) -> tuple[int, dict[str, list[float]]]:
        """Return the number of Gaussians and the statistics of each column that it reads of a file."""
        found = json.loads(self._run(str(file), "--stats", "json", "null"))
        table = found["stats"][0]
        data = [table["data"][which] for which in STATISTICS]
        return found["numGaussians"], {name: list(values) for name, *values in zip(table["columns"], *data)}

    def write(self, source: Path, target: Path, words: tuple[str, ...]) -> None:
        """Write a file in another format."""
        self._run("-w", "-q", *words, str(source), str(target))


def rows_of(folder: Path, tool: Tool) -> list[dict]:
    """Return a row for each file of ours that it reads, and one for each file that it writes."""
    scorer, rows = Scorer(folder), []
    with tempfile.TemporaryDirectory() as name:
        files = {suffix: Path(name) / f"model{suffix}" for suffix in READ}
        for file in files.values():
            export(folder, file, Filters(clean=False))
        whole = read_gaussians(files[".ply"])
        for version in spz.VERSIONS:
            files[f".spz version {version}"] = file = Path(name) / f"version{version}.spz"
            file.write_bytes(b"".join(spz.encode(arrays_of(whole), version)))
        for kind, file in files.items():
            ours = read_gaussians(file)
            if kind == ".splat":  # its rotations have 8 bits a component; splat-transform makes their length 1
                ours = replace(ours, quats=torch.nn.functional.normalize(ours.quats, dim=1))
            count, theirs = tool.statistics(file)
            found = difference(statistics(turned(ours) if ".spz" in kind else ours), theirs)
            rows.append({"written_by": "warpgs", "format": kind, "same_count": count == len(ours), **found})
        for suffix, words in WRITTEN:
            file = Path(name) / f"theirs{suffix}"
            tool.write(files[".ply"], file, words)
            theirs = read_gaussians(file)
            theirs = turned(theirs) if suffix == ".spz" else theirs
            found = difference(statistics(whole, axes=True), statistics(theirs, axes=True))
            rows.append({
                "written_by": "splat-transform", "format": " ".join([suffix, *words]), "same_count": len(theirs) == len(whole),
                "bytes": file.stat().st_size, "loss_db": scorer.loss(theirs), **found,
            })  # fmt: skip
    return rows


def main() -> None:
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--command", required=True)
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    tool = Tool(a.command)
    rows = rows_of(a.run, tool)
    for row in rows:
        loss = f"{row['loss_db']:+.4f} dB" if "loss_db" in row else ""
        print(
            f"{row['written_by']:<16} {row['format']:<24} same count {row['same_count']!s:<5} "
            f"{row['largest_of_range']:.2g} of the range at most ({row['column']}, {row['columns']} columns) {loss}"
        )
    result_file.write(a.out, result_file.result(WHAT, torch.device("cpu"), rows, tool=tool.version))


if __name__ == "__main__":
    main()
