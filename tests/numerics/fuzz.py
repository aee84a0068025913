"""Random scenes with poisoned Gaussians, rendered and differentiated until enough of them were tried.

usage: python -m tests.numerics.fuzz [--device cpu] [--gaussians 1000000] [--seed 0] [--largest 8000] [--replay FILE]

Counted are Gaussians with at least one poisoned slot. One scene in four is small and is held against float64. A scene that
fails is written to fuzz-<seed>-<number>.safetensors; --replay says again what is wrong with it. Exit code 1 on a failure.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path

from tests.numerics.poison import LRS, VALUES, Case, failures, make_case, non_finite, reference_error
from warpgs.scene import Camera, Gaussians

REFERENCE_LIMIT = 1e-4
"""Most that a picture of finite extremes may differ from float64; measured 1.1e-6 (tests/numerics/poison.py: ASPECT)."""


def save(case: Case, path: Path, wrong: list[str]) -> None:
    """Write a scene with all that is needed to try it again."""
    from safetensors.torch import save_file

    tensors = case.gaussians.tensors() | {"poisoned": case.poisoned, "viewmats": case.camera.viewmat, "Ks": case.camera.K}
    about = {"size": json.dumps([case.camera.width, case.camera.height]), "rule": case.rule, "wrong": json.dumps(wrong)}
    save_file({n: t.contiguous() for n, t in tensors.items()}, path, about)


def load(path: Path) -> Case:
    """The scene that `save` wrote."""
    from safetensors import safe_open

    with safe_open(path, "pt") as f:
        tensors, about = {n: f.get_tensor(n) for n in f.keys()}, f.metadata()
    names = [field.name for field in dataclasses.fields(Gaussians)]
    views = Camera(tensors["viewmats"], tensors["Ks"], *json.loads(about["size"]))
    return Case(Gaussians(*(tensors[n] for n in names)), tensors["poisoned"], views, about["rule"])


def fuzz(device: str, gaussians: int, seed: int, largest: int, folder: Path) -> int:
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
            path = folder / f"fuzz-{seed}-{scenes}.safetensors"
            save(case, path, wrong)
            print(f"scene {scenes} ({len(case.gaussians)} Gaussians, rule {case.rule}), kept as {path}: " + "; ".join(wrong))
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
    parser.add_argument("--replay", type=Path, help="a scene that failed")
    a = parser.parse_args()
    if a.replay:
        wrong, _ = failures(load(a.replay), a.device)
        print("\n".join(wrong) or "nothing is wrong with this scene")
        return int(bool(wrong))
    return int(fuzz(a.device, a.gaussians, a.seed, a.largest, Path.cwd()) > 0)


if __name__ == "__main__":
    raise SystemExit(main())
