"""Time of all ops, of the whole image and of a training step over sizes, beside peers and a roofline of the machine.

Points are measured from the lightest to the heaviest, all ops at each. So a time budget [s] cuts off the end of every series;
the skipped points are listed. ``--again`` measures only rows that --out lacks, or that other programs disturbed. ``--tiny``:
small sizes, for tests. `python -m bench.document` turns the results into docs/performance.md.
"""

from __future__ import annotations

from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.op_tasks import DEFAULT
from bench.lib.ops import run


def main() -> None:
    """Parse, measure, write."""
    device = "cuda" if torch.cuda.is_available() else "cpu"
    a = parse(__doc__, device=device, tiny=False, out=Path, op=list(DEFAULT), budget=float, note="", again=False)
    earlier = result_file.read(a.out) if a.again and a.out and a.out.exists() else None
    made = run(torch.device(a.device), tiny=a.tiny, ops=tuple(a.op), budget=a.budget, note=a.note, earlier=earlier)
    result_file.write(a.out, made)


if __name__ == "__main__":
    main()
