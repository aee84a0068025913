"""Two checkouts in turn on one machine: wall time, start, and held-out PSNR of the whole command `warpgs fit`.

OLD and NEW are folders of the two checkouts; each keeps a kernel cache of its own, filled by a short fit before the first
round. The order changes from round to round. Everything from the start of the process to its end counts as wall time.
"""

from __future__ import annotations

import json
import os
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import SCENE, parse
from bench.lib.tables import markdown

WHAT = "the whole command warpgs fit from two checkouts in turn"
SIDES = ("old", "new")


def command(scene: str, split: str, downscale: int, device: str, flags: str, out: Path, cores: str) -> list[str]:
    """Return the command of one fit, on some processor cores; all cores where none is named."""
    words = ["taskset", "-c", cores] if cores else []
    words += [sys.executable, "-m", "warpgs", "fit", scene, "--out", str(out), "--split", split]
    return [*words, "--downscale", str(downscale), "--device", device, *shlex.split(flags)]


def environment(checkout: Path, cache: Path, cores: str) -> dict[str, str]:
    """Return the environment in which a checkout runs: its own package and kernel cache, a thread for each core."""
    count = {"OMP_NUM_THREADS": str(len(cores.split(",")))} if cores else {}
    return os.environ | {"PYTHONPATH": str(checkout), "WARP_CACHE_PATH": str(cache)} | count


def timed(words: list[str], checkout: Path, env: dict[str, str], out: Path) -> dict:
    """Run a fit and return its wall time [s] and what its metrics.json tells.

    Raises:
        RuntimeError: The fit failed.
    """
    began = time.perf_counter()
    done = subprocess.run(words, cwd=checkout, env=env, capture_output=True, text=True, check=False)
    wall = time.perf_counter() - began
    if done.returncode:
        raise RuntimeError(f"{shlex.join(words)} in {checkout} ended with {done.returncode}:\n{done.stderr[-2000:]}")
    m = json.loads((out / "metrics.json").read_text("utf-8"))
    seconds = {k: m["seconds"][k] for k in ("setup", "training", "total")}
    return {"wall": wall, **seconds, "steps": m["steps"], "psnr": m["test"]["psnr"], "gaussians": m["gaussians"]}


def summary(rows: list[dict]) -> str:
    """Return the medians of both sides, and the median over rounds of new over old."""
    lines = []
    for side in SIDES:
        own = [r for r in rows if r["side"] == side]
        m = {k: statistics.median(r[k] for r in own) for k in ("wall", "setup", "training", "steps", "psnr")}
        cells = [side, len(own), *(f"{m[k]:.1f}" for k in ("wall", "setup", "training")), f"{m['steps']:.0f}"]
        lines.append([*cells, f"{1000 * m['training'] / m['steps']:.0f}", f"{m['psnr']:.2f}"])
    head = ["", "rounds", "wall [s]", "setup [s]", "training [s]", "steps", "ms a step", "PSNR [dB]"]
    pairs = [[next(r for r in rows if (r["side"], r["round"]) == (s, n)) for s in SIDES] for n in {r["round"] for r in rows}]
    ratio = statistics.median(new["wall"] / old["wall"] for old, new in pairs)
    gain = statistics.median(new["psnr"] - old["psnr"] for old, new in pairs)
    over = f"new over old: {ratio:.3f} of the wall time, {gain:+.2f} dB (medians of {len(pairs)} rounds)"
    return f"{markdown(head, lines)}\n{over}"


def main(arguments: list[str] | None = None) -> int:
    """Run the rounds, print and keep the times; return 0."""
    a = parse(
        __doc__, arguments, {"old": Path, "new": Path, **SCENE}, need=("out",), split="llff:3", downscale=1, rounds=5,
        cores="0,1", device="cpu", old_flags="", new_flags="", out=Path,
    )  # fmt: skip
    scene, rows = str(a.scene.resolve()), []
    with tempfile.TemporaryDirectory() as work:
        for turn in range(a.rounds + 1):  # the first fills the kernel caches and is not kept
            for side in SIDES if turn % 2 else SIDES[::-1]:
                checkout = getattr(a, side).resolve()
                flags, out = getattr(a, f"{side}_flags"), Path(work, f"{side}{turn}")
                flags = flags if turn else f"{flags} --steps 20"
                words = command(scene, a.split, a.downscale, a.device, flags, out, a.cores)
                row = timed(words, checkout, environment(checkout, Path(work, f"cache_{side}"), a.cores), out)
                if turn:
                    rows.append({"side": side, "round": turn} | row)
                    print(f"round {turn} {side}: {row['wall']:.1f} s, {row['psnr']:.2f} dB", flush=True)
            if turn:
                commits = {side: result_file.commit_of(getattr(a, side)) for side in SIDES}
                result_file.keep(a.out, WHAT, torch.device(a.device), rows, commits=commits)
    print(summary(rows))
    return 0


if __name__ == "__main__":
    sys.exit(main())
