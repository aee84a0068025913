"""Files exchanged with npm's splat-transform: our files read by splat-transform, and its files read by warpgs.

CLI is the command of @playcanvas/splat-transform, version 3. It needs Node 22, which is on npm, too: after `npm install node@22
@playcanvas/splat-transform@3` in any folder, the command is "node_modules/.bin/node
node_modules/@playcanvas/splat-transform/bin/cli.mjs".

For each of our files, splat-transform's statistics of every column (least, largest, mean, standard deviation, to 6 digits) are
compared with those of the Gaussians that warpgs reads, as fractions of the column's range. Each file that splat-transform
writes from our PLY is read by warpgs, compared with that PLY in the same way, and rendered at the held-out views.
"""

from __future__ import annotations

import json
import shlex
import subprocess
import tempfile
from dataclasses import replace
from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.columns import STATISTICS, difference, statistics
from bench.lib.scorer import Scorer
from warpgs.export import spz
from warpgs.export.base import arrays_of, gaussians_of, half_turn, read_gaussians, suffixes
from warpgs.pipeline.run.export import Filters, export
from warpgs.scene import Gaussians

WHAT = "differences between what splat-transform and this program read of the same files, and loss of PSNR of its own files"
READ = tuple(s for s in suffixes() if s not in (".glb", ".gltf"))
"""Our formats that splat-transform reads; it writes glTF, but does not read it."""
WRITTEN = (
    (".compressed.ply", ()), (".spz", ("--spz-version", "3")), (".spz", ("--spz-version", "4")), (".sog", ("-g", "cpu")),
    (".glb", ()),
)  # fmt: skip
"""Formats that splat-transform writes, with the arguments for each."""


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
        """Return splat-transform's number of Gaussians and statistics of each column of a file."""
        found = json.loads(self._run(str(file), "--stats", "json", "null"))
        table = found["stats"][0]
        data = [table["data"][which] for which in STATISTICS]
        return found["numGaussians"], {name: list(values) for name, *values in zip(table["columns"], *data)}

    def write(self, source: Path, target: Path, words: tuple[str, ...]) -> None:
        """Write a file in another format."""
        self._run("-w", "-q", *words, str(source), str(target))


def rows_of(folder: Path, tool: Tool) -> list[dict]:
    """Return a row for each of our files that splat-transform reads, and one for each file that it writes."""
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
    a = parse(__doc__, None, {"run": Path}, need=("command",), command=str, out=Path)
    tool = Tool(a.command)
    rows = rows_of(a.run, tool)
    for row in rows:
        loss = f"{row['loss_db']:+.4f} dB" if "loss_db" in row else ""
        print(
            f"{row['written_by']:<16} {row['format']:<24} same count {row['same_count']!s:<5} "
            f"{row['largest_of_range']:.2g} of the range at most ({row['column']}, {row['columns']} columns) {loss}"
        )
    result_file.keep(a.out, WHAT, torch.device("cpu"), rows, tool=tool.version)


if __name__ == "__main__":
    main()
