"""Two checkouts in turn on one machine: wall time, start, and held-out PSNR of the whole command `warpgs fit`.

OLD and NEW are folders of the two checkouts; each has its own kernel cache, in the folder --cache or else for this run alone,
filled before the first round. A checkout that is given twice, with the same flags, is measured alone. SCENES are folders,
FOLDER@SPLIT for different splits, or with --data named rows: those of bench/lib/scenes.py, and ``fern:3:film`` and ``fox:30``,
which begin with photographs without cameras. With several sets of --cores, one scene runs on each set at the same time; an
empty set is all cores. The order of the checkouts changes from round to round. Wall time is measured from the start to the end
of the process, processor time with one set of --cores; no run has poses, priors or a run folder of an earlier one.
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
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from queue import SimpleQueue

import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.scenes import PHOTOGRAPHS, ROWS, made, photographs
from bench.lib.tables import markdown

WHAT = "the whole command warpgs fit from two checkouts in turn"
SIDES = ("old", "new")


def case(name: str, data: Path, work: Path, split: str) -> tuple[str, str, str, str]:
    """Return label, folder, split (empty without cameras) and flags of a scene or a named row."""
    if name in PHOTOGRAPHS:
        folder, count, flags = PHOTOGRAPHS[name]
        return name, str(photographs(data / folder, count, work)), "", flags
    if name in ROWS:
        row = ROWS[name]
        return name, str(Path(made(data, row, work)).resolve()), row.split, f"--downscale {row.downscale}"
    folder, _, own = name.partition("@")
    return f"{Path(folder).name} {own or split}", str(Path(folder).resolve()), own or split, ""


def command(scene: str, split: str, downscale: int, device: str, flags: str, out: Path, cores: str) -> list[str]:
    """Return the command of one fit, on some processor cores; all cores where none is named. 0 gives no ``--downscale``."""
    words = ["taskset", "-c", cores] if cores else []
    words += [sys.executable, "-m", "warpgs", "fit", scene, "--out", str(out), *(["--split", split] if split else [])]
    words += ["--downscale", str(downscale)] if downscale else []
    return [*words, "--device", device, *shlex.split(flags)]


def environment(checkout: Path, cache: Path, cores: str) -> dict[str, str]:
    """Return the environment in which a checkout runs: its own package and kernel cache, a thread for each core."""
    own = {"OMP_NUM_THREADS": str(len(cores.split(",")))} if cores else {}
    own["WARPGS_CACHE"] = tempfile.mkdtemp(dir=cache.parent)  # without maps of an earlier run
    others = os.environ.get("PYTHONPATH")  # torch may be there
    path = os.pathsep.join([str(checkout), *([others] if others else [])])
    return os.environ | {"PYTHONPATH": path, "WARP_CACHE_PATH": str(cache)} | own


def compile_kernels(checkout: Path, env: dict[str, str]) -> None:
    """Compile all kernels of a fit in a checkout's cache."""
    words = [sys.executable, "-m", "warpgs", "doctor", "--warm"]
    subprocess.run(words, cwd=checkout, env=env, capture_output=True, check=True)


def timed(words: list[str], checkout: Path, env: dict[str, str], out: Path, film: bool = False) -> dict:
    """Run a fit, and make a film of it; return its times [s] and the figures of metrics.json."""
    began, used, device = time.perf_counter(), os.times(), words[words.index("--device") :][:2]
    for command in (words, *([[*words[: words.index("fit")], "render", str(out), *device]] if film else [])):
        done = subprocess.run(command, cwd=checkout, env=env, capture_output=True, text=True, check=False)
        if done.returncode:
            raise RuntimeError(f"{shlex.join(command)} in {checkout} ended with {done.returncode}:\n{done.stderr[-2000:]}")
    wall, now = time.perf_counter() - began, os.times()
    processor = now.children_user + now.children_system - used.children_user - used.children_system
    m = json.loads((out / "metrics.json").read_text("utf-8"))
    seconds = {k: m["seconds"][k] for k in ("setup", "training", "total")}
    seconds["compiling"] = m["seconds"].get("compiling", 0.0)
    psnr = (m["test"] or m["train"])["psnr"]
    figures = {"steps": m["steps"], "psnr": psnr, "gaussians": m["gaussians"]}
    return {"wall": wall, "processor": processor, **seconds, **figures, "sections": m.get("wall_seconds", {})}


def sections(rows: list[dict]) -> str:
    """Return the median over rounds of each section of the wall time, a column for each scene and side."""
    columns = list(dict.fromkeys((r["scene"], r["side"]) for r in rows if r["sections"]))
    own = {c: [r for r in rows if (r["scene"], r["side"]) == c] for c in columns}
    order = list(dict.fromkeys(n for r in rows for n in r["sections"] if n not in ("other", "total")))
    names = [*order, "other", "total"]
    lines = [[n, *(f"{statistics.median(r['sections'].get(n, 0.0) for r in own[c]):.2f}" for c in columns)] for n in names]
    for name, kind in (("shell to prompt", "wall"), ("processor time", "processor")):
        lines.append([name, *(f"{statistics.median(r[kind] for r in own[c]):.2f}" for c in columns)])
    return markdown(["section [s], median", *map(" ".join, columns)], lines)


def summary(rows: list[dict]) -> str:
    """Return for each scene the medians of both sides, and the median over rounds of new over old; then their means."""
    lines, ratios, gains = [], [], []
    for scene in dict.fromkeys(r["scene"] for r in rows):
        here = [r for r in rows if r["scene"] == scene]
        both = [n for n in {r["round"] for r in here} if sum(r["round"] == n for r in here) == len(SIDES)]
        pairs = [[next(r for r in here if (r["side"], r["round"]) == (s, n)) for s in SIDES] for n in both]
        if not pairs:
            continue
        ratios.append(statistics.median(new["wall"] / old["wall"] for old, new in pairs))
        gains.append(statistics.median(new["psnr"] - old["psnr"] for old, new in pairs))
        for k, side in enumerate(SIDES):
            own = [pair[k] for pair in pairs]
            m = {n: statistics.median(r[n] for r in own) for n in ("wall", "setup", "training", "steps", "psnr", "gaussians")}
            cells = [scene, side, len(own), *(f"{m[n]:.1f}" for n in ("wall", "setup", "training")), f"{m['steps']:.0f}"]
            cells += [f"{1000 * m['training'] / m['steps']:.0f}", f"{m['gaussians']:,.0f}", f"{m['psnr']:.2f}"]
            lines.append([*cells, *((f"{ratios[-1]:.3f}", f"{gains[-1]:+.2f}") if k else ("", ""))])
    head = ["scene", "", "rounds", "wall [s]", "setup [s]", "training [s]", "steps", "ms a step", "Gaussians", "PSNR [dB]"]
    over = f"new over old, mean of {len(gains)} scenes: {statistics.mean(ratios):.3f} of the wall time, " if gains else ""
    over += f"{statistics.mean(gains):+.2f} dB, least {min(gains):+.2f}" if gains else "no round is whole"
    return f"{markdown([*head, 'time', 'gain [dB]'], lines)}\n{over}"


def main(arguments: list[str] | None = None) -> int:
    """Run the rounds, print and keep the times; return 0."""
    a = parse(
        __doc__, arguments, {"old": Path, "new": Path, "scenes": [str]}, need=("out",), split="llff:3", downscale=0, rounds=5,
        cores=["0,1"], device="cpu", old_flags="", new_flags="", data=Path("."), out=Path, cache=Path(),
    )  # fmt: skip
    rows: list[dict] = []
    sides = SIDES if (a.old.resolve(), a.old_flags) != (a.new.resolve(), a.new_flags) else SIDES[1:]
    commits = {side: result_file.commit_of(getattr(a, side)) for side in sides}
    free: SimpleQueue[str] = SimpleQueue()
    for cores in a.cores:
        free.put(cores)
    with tempfile.TemporaryDirectory() as work, ThreadPoolExecutor(len(a.cores)) as pool:
        Path(work, a.cache).mkdir(parents=True, exist_ok=True)
        caches = {side: Path(work, a.cache, f"cache_{side}") for side in sides}

        def pair(turn: int, place: str) -> list[dict]:
            """Fit a scene with both checkouts, one after the other on the same cores."""
            name, scene, split, flags = case(place, a.data, Path(work), a.split)
            cores, found = free.get(), []
            try:
                for side in sides if turn % 2 else sides[::-1]:
                    checkout, out = getattr(a, side).resolve(), Path(tempfile.mkdtemp(dir=work), "run")
                    own = f"{flags} {getattr(a, f'{side}_flags')}"
                    words = command(scene, split, a.downscale, a.device, own, out, cores)
                    row = timed(words, checkout, environment(checkout, caches[side], cores), out, place.endswith("film"))
                    found.append({"scene": name, "side": side, "round": turn} | row)
                    print(f"round {turn} {name} {side}: {row['wall']:.1f} s, {row['psnr']:.2f} dB", flush=True)
            finally:
                free.put(cores)
            return found

        for side in sides:
            checkout = getattr(a, side).resolve()
            compile_kernels(checkout, environment(checkout, caches[side], ""))
        for turn in range(1, a.rounds + 1):
            for done in as_completed([pool.submit(pair, turn, place) for place in a.scenes]):
                rows += done.result()
                result_file.keep(a.out, WHAT, torch.device(a.device), rows, commits=commits)
    print(*([summary(rows)] if len(sides) > 1 else []), sections(rows), sep="\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
