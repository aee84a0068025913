"""A run of the benches of ops over sizes, from the lightest point to the heaviest, within a budget of time and memory."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable

import torch

from bench.lib import peers, result_file, roofline
from bench.lib.op_tasks import DEFAULT, OPS
from bench.lib.pairs import instances_and_pairs
from bench.lib.points import SIZES, Point, growth, load, points
from bench.lib.timing import DISTURBED, OURS, REPEATS, Task, measure_in_turn, peak_bytes
from warpgs.errors import ResourceError
from warpgs.kernels import launch

WHAT = "every op, the whole image and a training step, forward and backward, over sizes"
LIMIT_MS = 2000.0
"""Longest time of one repeat that is measured [ms]."""
FAILURES = (ResourceError, RuntimeError, MemoryError)
"""Errors of running out of memory, in our code, torch's and Warp's; one failure must not cost the other results."""


class Bench:
    """A run: rows and skipped tasks so far, and the time that is left."""

    def __init__(self, device: torch.device, repeats: int, budget: float | None, echo: Callable[[str], None]):
        self.device, self.repeats, self.echo = device, repeats, echo
        self.deadline = None if budget is None else time.monotonic() + budget
        self.rows: list[dict] = []
        self.skipped: list[dict] = []
        self.stopped: list[tuple[str, str, str, dict]] = []

    def _skip(self, head: dict, reason: str) -> None:
        self.skipped.append(head | {"reason": reason})
        self.echo(f"{_title(head)}  skipped: {reason}")

    def _stop(self, op: str, program: str, direction: str, sizes: dict, reason: str) -> None:
        """Record a failed task, so that it is not tried at larger sizes."""
        self.stopped.append((op, program, direction, sizes))
        self._skip({"op": op, "program": program, "direction": direction, **sizes}, reason)

    def _chosen(self, op: str, point: Point, sizes: dict) -> set[tuple[str, str]]:
        """Return the tasks of an op at a point that may succeed; the others are recorded as skipped."""
        chosen, late = set(), self.deadline is not None and time.monotonic() >= self.deadline
        for program, directions in OPS[op].programs.items():
            if program in peers.absent(self.device) or point.count > OPS[op].largest.get(program, point.count):
                continue
            for direction in directions:
                vain = (s for *task, s in self.stopped if task == [op, program, direction])
                if late or any(growth(s, sizes) is not None for s in vain):
                    head = {"op": op, "program": program, "direction": direction, **sizes}
                    self._skip(head, "no time is left" if late else "did not get through at a smaller size")
                else:
                    chosen.add((program, direction))
        return chosen

    def measure(self, op: str, point: Point, roof: dict | None) -> None:
        """Measure all programs and directions of an op at one point, in turn; only ours if they fail together."""
        sizes = point.sizes(OPS[op].axes)
        chosen = self._chosen(op, point, sizes)
        ours = {task for task in chosen if task[0] == OURS}
        for attempt in (chosen, ours) if chosen > ours else (ours,):
            reason = self._attempt(op, point, sizes, attempt, None if point.threads else roof)
            if reason is None:
                return
            for program, direction in sorted(attempt if attempt == ours else attempt - ours):
                self._stop(op, program, direction, sizes, reason)

    def _attempt(self, op: str, point: Point, sizes: dict, chosen: set, roof: dict | None) -> str | None:
        """Measure the chosen tasks; the reason if that fails before any row is made."""
        if not chosen:
            return None
        everything = torch.get_num_threads()
        if point.threads:
            launch.set_threads(point.threads)
        tasks: list[Task] = []
        try:
            tasks += OPS[op].tasks(point, self.device, lambda p, d: (p, d) in chosen)
            timings = measure_in_turn([t.run for t in tasks], self.device, self.repeats, LIMIT_MS)
            rows = [self._row(op, task, sizes, timing, roof) for task, timing in zip(tasks, timings)]
        except FAILURES as e:
            return " ".join(str(e).split())[:200] or type(e).__name__
        finally:
            launch.set_threads(everything)
            tasks.clear()
            gc.collect()
            if self.device.type == "cuda":
                torch.cuda.empty_cache()
        self._keep([row for row in rows if "median_ms" in row])
        for row in rows:
            if "median_ms" in row:
                low, high = row["quartiles_ms"]
                self.echo(f"{_title(row)} {row['median_ms']:>10.3f} ms  ({low:.3f} to {high:.3f})")
            else:
                self._stop(op, row["program"], row["direction"], sizes, f"took {row['warm_up_ms'] / 1000:.2g} s a repeat")
        return None

    def _keep(self, rows: list[dict]) -> None:
        """Add the rows of an op at one point; rows of an earlier try stay or go together, so that ratios are of one run."""
        before = {_key(r): r for r in self.rows}
        both = [r for r in rows if _key(r) in before]
        faster = sum(r["median_ms"] for r in both) < sum(before[_key(r)]["median_ms"] for r in both)
        for row in rows:
            if _key(row) not in before:
                self.rows.append(row)
            elif faster:
                self.rows[self.rows.index(before[_key(row)])] = row

    def open(self, op: str, sizes: dict) -> bool:
        """Return whether an op at some sizes has no row yet, or one during which other programs kept the cores busy."""
        own = [r for r in self.rows if r["op"] == op and {s: r[s] for s in SIZES if s in r} == sizes]
        return not own or any(r.get("others_cores", 0.0) > DISTURBED for r in own)

    def _row(self, op: str, task: Task, sizes: dict, timing: dict, roof: dict | None) -> dict:
        row = {"op": op, "program": task.program, "direction": task.direction, **sizes, **task.facts, **timing}
        if "median_ms" in row and self.device.type == "cuda":
            row["peak_bytes"] = peak_bytes(task, self.device)
        if "median_ms" in row and roof and task.cost:
            row |= roofline.against_roof(task.cost, row.get("gpu_ms", row["median_ms"]) / 1000, roof)
        return row


def _key(row: dict) -> tuple:
    return tuple(row.get(n) for n in ("op", "program", "direction", *SIZES))


def _title(row: dict) -> str:
    sizes = (f"{k} {row[k]}" for k in ("N", "width", "height", "degree", "cameras", "threads") if k in row)
    return f"{row['op']:<12} {row['program']:<12} {row['direction']:<9} {'  '.join(sizes):<58}"


def run(
    device: torch.device,
    *,
    tiny: bool = False,
    ops: tuple[str, ...] = DEFAULT,
    budget: float | None = None,
    note: str = "",
    earlier: dict | None = None,
    echo: Callable[[str], None] = lambda line: print(line, flush=True),
) -> dict:
    """Measure the ops named and return the result, with the roofline, a row per task, and what was skipped and why."""
    if device.type == "cuda" and device.index is None:
        device = torch.device("cuda", torch.cuda.current_device())  # Warp asks for the number
    head = result_file.result(WHAT, device, []) | ({"note": note} if note else {})
    bench = Bench(device, 3 if tiny else REPEATS, budget, echo)
    if earlier:
        head = {name: earlier[name] for name in (*head, "note") if name in earlier}
        bench.rows = list(earlier["rows"])
    roof = earlier["roofline"] if earlier else roofline.ceilings(device, tiny)
    echo(f"roof: {roof['bytes_per_s'] / 1e9:.4g} GB/s, {roof['operations_per_s'] / 1e9:.4g} Gop/s")
    grid = [(p, op) for op in ops for p in points(OPS[op].axes, device, tiny)]
    grid.sort(key=lambda pair: load(pair[0]))
    for point, op in grid:
        if bench.open(op, point.sizes(OPS[op].axes)):
            bench.measure(op, point, roof)
    # what met other programs gets a second chance; what was skipped is not tried again
    once = list(bench.skipped)
    for point, op in grid:
        sizes = point.sizes(OPS[op].axes)
        if not tiny and bench.open(op, sizes) and any(r["op"] == op and r.items() >= sizes.items() for r in bench.rows):
            bench.measure(op, point, roof)
    done = {_key(r) for r in bench.rows}
    skipped = {_key(s): s for s in (*(earlier["skipped"] if earlier else ()), *once) if _key(s) not in done}
    instances_and_pairs.cache_clear()
    head |= {"repeats": bench.repeats, "absent": peers.absent(device), "roofline": roof, "skipped": list(skipped.values())}
    head.pop("rows")
    return head | {"rows": bench.rows}
