"""Two checkouts in turn on one machine: wall time, start, and held-out PSNR of the whole command `warpgs fit`.

usage: python -m bench.turns OLD NEW SCENE [--split llff:3] [--downscale 1] [--rounds 5] [--cores 0,1] [--device cpu]
           [--old-flags="--preset quick"] [--new-flags="..."] --out FILE.json
OLD and NEW are folders of the two checkouts; each keeps a kernel cache of its own, filled by a short fit before the first
round. The order changes from round to round. Everything from the start of the process to its end counts as wall time.
"""

from __future__ import annotations

import argparse
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

from bench import result_file

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
    lines = ["| | rounds | wall [s] | setup [s] | training [s] | steps | ms a step | PSNR [dB] |", "|---" * 8 + "|"]
    for side in SIDES:
        own = [r for r in rows if r["side"] == side]
        m = {k: statistics.median(r[k] for r in own) for k in ("wall", "setup", "training", "steps", "psnr")}
        per_step = 1000 * m["training"] / m["steps"]
        cells = (
            f"{m['wall']:.1f} | {m['setup']:.1f} | {m['training']:.1f} | {m['steps']:.0f} | {per_step:.0f} | {m['psnr']:.2f}"
        )
        lines.append(f"| {side} | {len(own)} | {cells} |")
    pairs = [[next(r for r in rows if (r["side"], r["round"]) == (s, n)) for s in SIDES] for n in {r["round"] for r in rows}]
    ratio = statistics.median(new["wall"] / old["wall"] for old, new in pairs)
    gain = statistics.median(new["psnr"] - old["psnr"] for old, new in pairs)
    return "\n".join(
        [*lines, "", f"new over old: {ratio:.3f} of the wall time, {gain:+.2f} dB (medians of {len(pairs)} rounds)"]
    )


def main(arguments: list[str] | None = None) -> int:
    """Run the rounds, print and keep the times; return 0."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("old", type=Path)
    p.add_argument("new", type=Path)
    p.add_argument("scene")
    p.add_argument("--split", default="llff:3")
    p.add_argument("--downscale", type=int, default=1)
    p.add_argument("--rounds", type=int, default=5)
    p.add_argument("--cores", default="0,1", help="processor cores, with commas; empty for all")
    p.add_argument("--device", default="cpu")
    p.add_argument("--old-flags", default="")
    p.add_argument("--new-flags", default="")
    p.add_argument("--out", type=Path, required=True)
    a = p.parse_args(arguments)
    scene, rows = str(Path(a.scene).resolve()), []
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
                commits = {side: commit(getattr(a, side)) for side in SIDES}
                result_file.write(a.out, result_file.result(WHAT, torch.device(a.device), rows, commits=commits))
    print(summary(rows))
    return 0


def commit(checkout: Path) -> str | None:
    """Return the commit of a checkout; None outside a repository."""
    words = ["git", "describe", "--always", "--abbrev=12", "--dirty", "--exclude=*"]
    done = subprocess.run(words, cwd=checkout, capture_output=True, text=True, check=False)
    return done.stdout.strip() or None


if __name__ == "__main__":
    sys.exit(main())
