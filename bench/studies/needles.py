"""Errors of needles with a triangular factor, with an inverse covariance ("conic") and with textbook formulas.

See `bench/lib/needles.py` for definitions.
"""

from __future__ import annotations

from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.needles import ANGLES, IMAGES, SIDE, measure

WHAT = "errors of needles in the form of a triangular factor and in that of an inverse covariance"


def main() -> None:
    """Measure, print, and keep."""
    a = parse(__doc__, device="cpu", out=Path)
    rows = measure(device := torch.device(a.device))
    for row in rows:
        print(row["sigma"], *(f"{what} " + " ".join(f"{n} {e['max']:.1e}" for n, e in row[what].items())
                              for what in ("weight", "image", "gradient")), sep=" | ")  # fmt: skip
    result_file.keep(a.out, WHAT, device, rows, needles=ANGLES, images=IMAGES, side=SIDE)


if __name__ == "__main__":
    main()
