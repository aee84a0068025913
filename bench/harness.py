"""How things are timed here: warm-up, repeats, median and quartiles, one row per case."""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import torch

REPEATS = 30
WARM_UP = 5


@dataclass(frozen=True)
class Case:
    """One thing to time."""

    op: str
    direction: str
    """forward or backward."""
    parameters: dict
    work: Callable[[], object]


def measure(work: Callable[[], object], device: torch.device, repeats: int = REPEATS) -> dict:
    """Median and quartiles of the wall time [ms], the device drained before and after each repeat."""
    samples = []
    for i in range(WARM_UP + repeats):
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        begin = time.perf_counter()
        work()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        if i >= WARM_UP:
            samples.append(1000 * (time.perf_counter() - begin))
    low, middle, high = statistics.quantiles(samples, n=4)
    return {"median_ms": round(middle, 4), "quartiles_ms": [round(low, 4), round(high, 4)], "repeats": repeats}


def backward_of(outputs: torch.Tensor, inputs: list[torch.Tensor]) -> Callable[[], object]:
    """Work that runs the backward pass of ``outputs`` for a fixed random upstream gradient."""
    upstream = torch.rand_like(outputs)
    return lambda: torch.autograd.grad(outputs, inputs, upstream, retain_graph=True)


def run(cases: Iterator[Case], device: torch.device, repeats: int = REPEATS) -> list[dict]:
    """Measure all cases, printing each as it is done."""
    rows = []
    for case in cases:
        row = {"op": case.op, "direction": case.direction, **case.parameters, "device": device.type}
        row |= measure(case.work, device, repeats)
        size = "  ".join(f"{k} {v}" for k, v in case.parameters.items())
        low, high = row["quartiles_ms"]
        print(
            f"{case.op:<8} {case.direction:<9} {size:<40} {row['median_ms']:>10.3f} ms  ({low:.3f} to {high:.3f})", flush=True
        )
        rows.append(row)
    return rows


def main(cases: Callable[[torch.device, bool], Iterator[Case]]) -> None:
    """Command line of a single op's bench."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--tiny", action="store_true", help="sizes that only show that it runs")
    a = parser.parse_args()
    device = torch.device(a.device)
    run(cases(device, a.tiny), device, 3 if a.tiny else REPEATS)
