"""All ops, the whole picture and the training step, forward and backward over sizes, with a roofline of the machine.

Points are measured from the lightest to the heaviest, all ops at each, so that what a time budget cuts off is the far end
of every series. `python -m bench.document` turns the results into docs/performance.md.
"""

from __future__ import annotations

import argparse
import gc
import importlib
import json
import time
from collections.abc import Callable
from pathlib import Path

import torch

from bench import machine, predict, roofline
from bench.harness import REPEATS, Task, measure_in_turn, peak_bytes
from bench.pairs import instances_and_pairs
from bench.points import Point, load, points
from warpgs.errors import ResourceError
from warpgs.kernels import bridge

OPS = ("project", "sh", "tiles", "blend", "ssim", "adam", "knn", "render", "step")
FAILURES = (ResourceError, torch.cuda.OutOfMemoryError, MemoryError)


class Bench:
    """A run: rows and skipped tasks so far, and the time that is left."""

    def __init__(self, device: torch.device, repeats: int, budget: float | None, echo: Callable[[str], None]):
        self.device, self.repeats, self.echo = device, repeats, echo
        self.deadline = None if budget is None else time.monotonic() + budget
        self.rows: list[dict] = []
        self.skipped: list[dict] = []

    def _skip(self, head: dict, reason: str) -> None:
        self.skipped.append(head | {"reason": reason})
        self.echo(f"{_title(head)}  skipped: {reason}")

    def _chosen(self, op: str, module, point: Point, sizes: dict) -> set[tuple[str, str]]:
        """The tasks of an op at a point that can be expected to fit into time and memory; the others are noted."""
        chosen, predicted, free = set(), 0.0, predict.free_bytes(self.device)
        for program, directions in module.PROGRAMS.items():
            for direction in directions:
                head = {"op": op, "program": program, "direction": direction, **sizes}
                reason = predict.reason_to_skip(self.rows, op, program, direction, point, sizes, free)
                earlier = {(s["op"], s["program"], s["direction"]) for s in self.skipped if s.get("failed")}
                if reason is None and (op, program, direction) in earlier:
                    reason = "failed at a smaller size"
                if reason:
                    self._skip(head, reason)
                    continue
                chosen.add((program, direction))
                predicted += predict.time_ms(self.rows, op, program, direction, sizes) or 0.0
        if self.deadline is not None and chosen:
            needed, left = predicted / 1000 * (self.repeats + 5), self.deadline - time.monotonic()
            if left <= 0 or needed > left:
                for program, direction in sorted(chosen):
                    head = {"op": op, "program": program, "direction": direction, **sizes}
                    self._skip(head, f"predicted {needed:.2g} s in all, {max(left, 0):.2g} s left of the time given")
                return set()
        return chosen

    def measure(self, op: str, module, point: Point, roof: dict | None) -> None:
        """All programs and directions of an op at one point, in turn."""
        sizes = point.sizes(module.AXES)
        chosen = self._chosen(op, module, point, sizes)
        if not chosen:
            return
        everything = torch.get_num_threads()
        if point.threads:
            bridge.set_threads(point.threads)
        try:
            tasks = list(module.tasks(point, self.device, lambda p, d: (p, d) in chosen))
            timings = measure_in_turn([t.run for t in tasks], self.device, self.repeats)
            for task, timing in zip(tasks, timings):
                self._add(op, task, sizes, timing, None if point.threads else roof)
        except FAILURES as e:
            for program, direction in sorted(chosen):
                self._skip(
                    {"op": op, "program": program, "direction": direction, **sizes, "failed": True},
                    " ".join(str(e).split())[:200] or type(e).__name__,
                )
        finally:
            bridge.set_threads(everything)
            tasks = None
            gc.collect()
            if self.device.type == "cuda":
                torch.cuda.empty_cache()

    def _add(self, op: str, task: Task, sizes: dict, timing: dict, roof: dict | None) -> None:
        row = {"op": op, "program": task.program, "direction": task.direction, **sizes, **task.facts, **timing}
        if self.device.type == "cuda":
            row["peak_bytes"] = peak_bytes(task, self.device)
        if roof and task.cost:
            row |= roofline.against_roof(task.cost, row.get("gpu_ms", row["median_ms"]) / 1000, roof)
        self.rows.append(row)
        low, high = row["quartiles_ms"]
        self.echo(f"{_title(row)} {row['median_ms']:>10.3f} ms  ({low:.3f} to {high:.3f})")


def _title(row: dict) -> str:
    sizes = (f"{k} {row[k]}" for k in ("N", "width", "height", "degree", "cameras", "threads") if k in row)
    return f"{row['op']:<8} {row['program']:<12} {row['direction']:<9} {'  '.join(sizes):<58}"


def run(
    device: torch.device,
    *,
    tiny: bool = False,
    ops: tuple[str, ...] = OPS,
    budget: float | None = None,
    note: str = "",
    echo: Callable[[str], None] = lambda line: print(line, flush=True),
) -> dict:
    """Measure the ops named; returns the machine, its roofline, a row per task, and what was skipped and why.

    Args:
        device: Where to measure.
        tiny: Sizes and repeats that only show that it runs.
        ops: Names out of `OPS`.
        budget: Time for all of it [s]; what is predicted not to fit is skipped. None for no limit.
        note: Words about the machine that belong in the results.
        echo: Takes a line per task.
    """
    bench = Bench(device, 3 if tiny else REPEATS, budget, echo)
    roof = roofline.ceilings(device, tiny)
    echo(f"roof: {roof['bytes_per_s'] / 1e9:.4g} GB/s, {roof['operations_per_s'] / 1e9:.4g} Gop/s")
    modules = {op: importlib.import_module(f"bench.kernels.bench_{op}") for op in ops}
    grid = [(p, op) for op, module in modules.items() for p in points(module.AXES, device, tiny)]
    for point, op in sorted(grid, key=lambda pair: load(pair[0])):
        bench.measure(op, modules[op], point, roof)
    instances_and_pairs.cache_clear()
    record = machine.describe(device) | ({"note": note} if note else {})
    return record | {"repeats": bench.repeats, "roofline": roof, "rows": bench.rows, "skipped": bench.skipped}


def main() -> None:
    """Parse, measure, write."""
    parser = argparse.ArgumentParser(prog="python -m bench", description=__doc__)
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--tiny", action="store_true", help="sizes that only show that it runs")
    parser.add_argument("--out", type=Path, help="bench/results/ops_MACHINE.json")
    parser.add_argument("--op", nargs="+", choices=OPS, default=OPS, metavar="NAME", help=f"some of {', '.join(OPS)}")
    parser.add_argument("--budget", type=float, help="seconds for all of it; what does not fit is skipped and listed")
    parser.add_argument("--note", default="", help="words about the machine that belong in the results")
    a = parser.parse_args()
    result = run(torch.device(a.device), tiny=a.tiny, ops=tuple(a.op), budget=a.budget, note=a.note)
    if a.out:
        a.out.parent.mkdir(parents=True, exist_ok=True)
        a.out.write_text(json.dumps(result, indent=1) + "\n")


if __name__ == "__main__":
    main()
