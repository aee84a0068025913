"""Results of `select_rule` for limits of 1e-2, 1e-3 and 1e-4 on haze, needles, far and trained scenes, on a CPU.

The true error is the distance from `reference_image`, in float64 and without the kernels. Times are of images without
gradients, in turn with `exact`. RUN is a fit, for the trained scene.
"""

from pathlib import Path

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.selected_rules import CPU, measure, measured_scenes, summary
from bench.lib.tables import named


def main(arguments: list[str] | None = None) -> int:
    """Print a row for each kind of scene, measure and limit; exit 1 if a true error is above its limit."""
    a = parse(__doc__, arguments, run=Path, width=120, count=4000, seeds=5, repeats=15, out=Path)
    rows = []
    for scene in measured_scenes(a.width, a.count, a.seeds, a.run):
        rows += measure(scene, a.repeats)
        print(named({k: v for k, v in rows[-6].items() if v is not None}), flush=True)
    means = summary(rows)
    for row in means:
        print(named(row))
    facts = {"size": [a.width, 3 * a.width // 4, a.count, a.seeds], "run": str(a.run and a.run.name)}
    result_file.keep(a.out, "rules that select_rule finds, their time and true error", CPU, rows, summary=means, **facts)
    return int(any(row["rule"] != "none" and row["error"] > row["limit"] for row in rows))


if __name__ == "__main__":
    raise SystemExit(main())
