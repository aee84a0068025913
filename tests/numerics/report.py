"""Measure every line of the error budget and keep the figures; `python -m bench.document` puts them into docs/numerics.md.

usage: python -m tests.numerics.report [--device cuda] [--out bench/results/budget_cpu.json]
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import torch

from bench.lib import result_file
from tests.numerics.budget import CASES, broken, measure, split, tile_size_of
from tests.numerics.scenes import SCENES
from warpgs.constants import RULES


def main() -> int:
    """Print a line a scene and every line that is broken; 1 if there is one."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    device = torch.device(a.device)
    rows, lines = [], []
    for rule, name in CASES:
        scene = SCENES[name]()
        row = measure(scene, RULES[rule], split(scene, RULES[rule], device, tile_size_of(rule), with_model=True))
        rows.append(row)
        lines += broken(scene, row)
        rgb, worst = row["pictures"]["rgb"], max(e["rel L2"] for e in row["gradients"].values())
        print(f"{rule:7} {scene.name:18} rgb E mean {rgb['E mean']:.1e} max {rgb['E max']:.1e}, worst gradient {worst:.1e}")
    print(*(lines or ["every line is kept"]), sep="\n")
    what = "the error budget of docs/numerics.md, line by line, on its scenes"
    result_file.write(a.out, result_file.result(what, device, rows, broken=lines))
    return int(bool(lines))


if __name__ == "__main__":
    sys.exit(main())
