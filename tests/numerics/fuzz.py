"""Random scenes with poisoned Gaussians, rendered and differentiated until enough of them were tried.

usage: python -m tests.numerics.fuzz [--device cpu] [--gaussians 1000000] [--seed 0] [--largest 8000]

Counted are Gaussians with at least one poisoned slot. One scene in four is small and is held against float64. A scene that
fails is named by the call that makes it again. Exit code 1 on a failure.
"""

import argparse
import time

from tests.numerics.poison import LRS, VALUES, failures, make_case, non_finite, reference_error

REFERENCE_LIMIT = 1e-4
"""Most that a picture of finite extremes may differ from float64; measured 1.1e-6 (tests/numerics/poison.py: ASPECT)."""


def fuzz(device: str, gaussians: int, seed: int, largest: int) -> int:
    """Try scenes until ``gaussians`` poisoned Gaussians were seen; prints counts, returns the number of failures."""
    begin = time.perf_counter()
    scenes = tried = broken = drawn = compared = shown = failed = 0
    worst = 0.0
    while tried < gaussians:
        case = make_case(seed, scenes, largest)
        try:
            wrong, seen = failures(case, device)
        except Exception as e:  # a crash is what is looked for; the scene is kept and the fuzz goes on
            wrong, seen = [f"{type(e).__name__}: {e}"], 0
        if scenes % 4 == 0:
            error, some, visible = reference_error(seed, scenes, device)
            worst, compared, shown = max(worst, error), compared + some, shown + visible
            if not error <= REFERENCE_LIMIT:
                wrong.append(f"reference_error({seed}, {scenes}, {device!r}) is {error:.2e}, above {REFERENCE_LIMIT:.0e}")
        if wrong:
            failed += 1
            print(f"make_case({seed}, {scenes}, {largest}), rule {case.rule}: " + "; ".join(wrong))
        scenes, tried, drawn = scenes + 1, tried + int(case.poisoned.sum()), drawn + seen
        broken += int(non_finite(case.gaussians).sum())
        if scenes % 50 == 0:
            seconds = time.perf_counter() - begin
            print(f"{scenes} scenes, {tried:,} poisoned Gaussians, {failed} failures, {seconds:.0f} s", flush=True)
    print(
        f"{scenes} scenes on {device}, {len(VALUES)} values in 14 slots of up to {max(LRS):.0%} of the Gaussians: {tried:,} "
        f"poisoned, {broken:,} of them with a non-finite parameter, {drawn:,} drawn, poisoned or not; float64 compared with "
        f"{compared:,}, {shown:,} of them drawn, largest difference {worst:.1e}"
    )
    print(f"{failed} failures in {tried:,} poisoned Gaussians, seed {seed}, {time.perf_counter() - begin:.0f} s")
    return failed


def main() -> int:
    """The program; returns its exit code."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--gaussians", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--largest", type=int, default=8000, help="Gaussians of the largest scenes")
    a = parser.parse_args()
    return int(fuzz(a.device, a.gaussians, a.seed, a.largest) > 0)


if __name__ == "__main__":
    raise SystemExit(main())
