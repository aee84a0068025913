"""All ops, forward and backward, over sizes.

usage: python -m bench [--device cpu|cuda] [--tiny] [--out FILE.json]
"""

from __future__ import annotations

import argparse
import importlib
import json
import platform
from pathlib import Path

import torch
import warp

from bench.harness import REPEATS, run

OPS = ("project", "sh", "tiles", "blend", "ssim", "adam", "knn")


def bench(device: torch.device, tiny: bool = False) -> dict:
    """Measure every op; returns the machine, the versions and a row per case."""
    rows = []
    for op in OPS:
        module = importlib.import_module(f"bench.kernels.bench_{op}")
        rows += run(module.cases(device, tiny), device, 3 if tiny else REPEATS)
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else platform.processor() or platform.machine()
    versions = {"torch": torch.__version__, "warp": warp.config.version, "python": platform.python_version()}
    return {"device": name, "threads": torch.get_num_threads(), "versions": versions, "rows": rows}


def main() -> None:
    """Parse, measure, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--tiny", action="store_true", help="sizes that only show that it runs")
    parser.add_argument("--out", type=Path)
    a = parser.parse_args()
    result = bench(torch.device(a.device), a.tiny)
    if a.out:
        a.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
