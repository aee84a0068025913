"""Farms of small fits: equal bytes and time by engine, and fits per hour by scenes that share a GPU and by GPUs.

`engines` fits demo scenes one by one with `warpgs fit`, and then with each engine; it also kills a worker during a job, and
starts two farms on one folder. `packing` and `captures` need CUDA; in every row a GPU has the same number of cores, and a slot
of threads. `packing` gives every slot --fits fits of one scene, each with its own seed, after a tiny fit that starts the
process of the slot, on one GPU with several numbers of slots, then with the best number on several GPUs. `captures` runs a list
of jobs, as `warpgs farm` takes it, on each number of GPUs, and compares the PLY files with the first ones.
"""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from bench.lib import result_file
from bench.lib.arguments import parse
from warpgs.app.farm import jobs_of as farm_jobs
from warpgs.files import input_digest
from warpgs.pipeline.farm.farm import JobStatus, LocalEngine, Slot, make_engine, run_farm
from warpgs.pipeline.farm.job import LOG, PLY, Engine, FarmJob, list_jobs
from warpgs.pipeline.run.request import FitRequest, SceneRequest
from warpgs.pipeline.train.presets import PRESETS
from warpgs.pipeline.train.settings import FitConfig
from warpgs.synthetic.demo import split_spec, write_demo

VIEWS, WIDTH, HEIGHT = 8, 126, 94
"""Views of a demo scene, and their size [px]."""


def demo_scenes(folder: Path, count: int) -> dict[str, Path]:
    """Write demo scenes with a seed each."""
    found = {f"demo{i:02d}": folder / f"demo{i:02d}" for i in range(count)}
    for seed, path in enumerate(found.values()):
        if not path.is_dir():
            write_demo(path, views=VIEWS, width=WIDTH, height=HEIGHT, seed=seed)
    return found


def jobs_of(scenes: dict[str, Path], out: Path, config: FitConfig) -> list[FarmJob]:
    """Return the jobs of demo scenes."""
    return [
        FarmJob(n, FitRequest(SceneRequest(str(p), split_spec(VIEWS)), out / n / "run", config, "cpu"), out / n, out)
        for n, p in scenes.items()
    ]


def farm_command(scenes: Path, out: Path, steps: int, slots: int) -> list[str]:
    """Return the command of a farm of demo scenes."""
    words = ["farm", str(scenes), "--out", str(out), "--split", split_spec(VIEWS), "--preset", "quick", "--steps", str(steps)]
    return [sys.executable, "-m", "warpgs", *words, "--device", "cpu", "--slots", str(slots)]


def digests(out: Path, names: list[str]) -> list[str]:
    """Return the SHA-256 of the PLY file of each job."""
    return [input_digest(out / n / "run" / PLY) for n in names]


def one_by_one(scenes: dict[str, Path], out: Path, steps: int) -> float:
    """Run `warpgs fit` for each scene, one process after another; return the time [s]."""
    began = time.perf_counter()
    for name, path in scenes.items():
        words = ["fit", str(path), "--out", str(out / name / "run"), "--split", split_spec(VIEWS), "--preset", "quick"]
        command = [sys.executable, "-m", "warpgs", *words, "--steps", str(steps), "--device", "cpu"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - began


def timed(jobs: list[FarmJob], engine: Callable[[], Engine], show: Callable[[list[JobStatus], Engine], object]) -> dict:
    """Run a farm and return its time, from the start of the engine to its end, and the results of the jobs."""
    began = time.perf_counter()
    running = engine()
    try:
        statuses = run_farm(jobs, running, lambda s: show(s, running))
    finally:
        running.close()
    return {
        "seconds": time.perf_counter() - began, "done": sum(s.state == "done" for s in statuses),
        "attempts": max(s.attempts for s in statuses),
    }  # fmt: skip


def kill_once(killed: list[str]) -> Callable[[list[JobStatus], Engine], None]:
    """Return a function that kills the process of the first job that has taken a step."""

    def show(statuses: list[JobStatus], engine: Engine) -> None:
        running = [s.job.name for s in statuses if s.state == "running" and s.step]
        if running and not killed:
            killed.append(running[0])
            os.kill(engine._workers[running[0]]._process.pid, signal.SIGKILL)

    return show


def shared(scenes: dict[str, Path], folder: Path, out: Path, steps: int) -> dict:
    """Start two farms of one slot each on one folder; return their time, and the largest number of fits of a scene."""
    began = time.perf_counter()
    command = farm_command(folder, out, steps, 1)
    farms = [subprocess.Popen(command, stdout=subprocess.DEVNULL) for _ in range(2)]
    codes = [farm.wait() for farm in farms]
    logs = [(out / name / LOG).read_text("utf-8") for name in scenes]
    return {
        "seconds": time.perf_counter() - began, "exit_codes": codes,
        "most_fits_of_a_scene": max(text.count("views to fit,") for text in logs),
    }  # fmt: skip


def engines(scenes: int, steps: int, slots: int, work: Path) -> list[dict]:
    """Return a row for each way to fit the demo scenes."""
    found = demo_scenes(work / "scenes", scenes)
    config = dataclasses.replace(PRESETS["quick"], steps=steps)
    names = list(found)
    one_by_one(dict(list(found.items())[:1]), work / "warm", steps)  # kernels are compiled
    rows = [{"way": "one by one, warpgs fit", "slots": 1, "seconds": one_by_one(found, work / "single", steps)}]
    wanted = digests(work / "single", names)
    killed: list[str] = []
    ways: dict[str, tuple[tuple[str, int | None], Callable]] = {
        "local": (("local", slots), lambda *_: None),
        "local, 1 slot": (("local", 1), lambda *_: None),
        "local, a worker killed": (("local", slots), kill_once(killed)),
        "ray": (("ray", slots), lambda *_: None),
    }
    for way, (request, show) in ways.items():
        out = work / way.replace(" ", "-").replace(",", "")
        out.mkdir()
        row = timed(jobs_of(found, out, config), lambda: make_engine("cpu", request[0], slots=request[1]), show)  # noqa: B023
        rows.append({"way": way, "slots": request[1], **row, "same_bytes": digests(out, names) == wanted})
    row = shared(found, work / "scenes", work / "shared", steps)
    rows.append({"way": "two farms of 1 slot", "slots": 2, **row, "same_bytes": digests(work / "shared", names) == wanted})
    for row in rows:
        row |= {"scenes": scenes, "steps": steps, "against_one_by_one": rows[0]["seconds"] / row["seconds"]}
    return rows


CORES = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []


def gpu_slots(gpus: int, per_gpu: int, most_gpus: int) -> list[Slot]:
    """Leave as many cores to this process as these GPUs have on a machine of ``most_gpus``; return slots that share them."""
    os.sched_setaffinity(0, CORES[: len(CORES) * gpus // most_gpus])  # processes of slots inherit it
    threads = max(1, len(CORES) // (most_gpus * per_gpu))
    return [("cuda", threads, {"CUDA_VISIBLE_DEVICES": str(i % gpus)}) for i in range(gpus * per_gpu)]


def seeds_of(scene: SceneRequest, config: FitConfig, out: Path, kind: str, count: int) -> list[FarmJob]:
    """Return jobs of one scene with a seed each."""
    return [
        FarmJob(n, FitRequest(scene, out / n / "run", dataclasses.replace(config, seed=i), "cuda"), out / n, out)
        for i, n in enumerate(f"{kind}{i}" for i in range(count))
    ]


def pack(slots: list[Slot], tiny: list[FarmJob], jobs: list[FarmJob]) -> dict:
    """Run jobs in slots that each had a tiny one; return fits per hour, and for each GPU how long it idled at the end [s]."""
    engine, gpu_of = LocalEngine(slots), {}

    def show(_: list[JobStatus]) -> None:
        """Note on which GPU a job runs."""
        for name, worker in dict(engine._workers).items():
            if name not in gpu_of:
                variables = Path(f"/proc/{worker._process.pid}/environ").read_text("utf-8", "replace").split("\0")
                gpu_of[name] = next(v.partition("=")[2] for v in variables if v.startswith("CUDA_VISIBLE_DEVICES="))

    try:
        run_farm(tiny, engine)
        began = time.monotonic()
        statuses = run_farm(jobs, engine, show)
        seconds = time.monotonic() - began
    finally:
        engine.close()
    took = [s.seconds for s in statuses if s.state == "done"]
    failures = [s.record.message if s.record else s.state for s in statuses if s.state != "done"]
    if failures:
        print(f"{len(failures)} of {len(jobs)} fits failed, the first: {failures[0]}", file=sys.stderr)
    sections = [
        json.loads((s.job.request.out / "metrics.json").read_text("utf-8"))["wall_seconds"]
        for s in statuses
        if s.state == "done"
    ]
    ends = {gpu: max(s.began + s.seconds for s in statuses if gpu_of.get(s.job.name) == gpu) for gpu in gpu_of.values()}
    return {
        "fits": len(took), "failed": len(failures), "seconds": seconds, "fits_per_hour": 3600 * len(took) / seconds,
        "mean_seconds_of_a_fit": sum(took) / max(1, len(took)),
        "mean_sections": {n: round(sum(r.get(n, 0.0) for r in sections) / len(sections), 2) for n in (sections or [{}])[0]},
        "mean_psnr": sum(s.record.psnr or 0 for s in statuses if s.record) / len(jobs),
        "idle_at_the_end": {gpu: round(began + seconds - end, 2) for gpu, end in sorted(ends.items())},
    }  # fmt: skip


def packing(a: Namespace, work: Path) -> Iterator[dict]:
    """Yield a row for each number of slots on one GPU, then for each number of GPUs with the best one."""
    if a.scene is None:
        write_demo(work / "demo", views=24, width=504, height=378)
        a.scene, a.split = work / "demo", "train=000.png,012.png,023.png;test=006.png,018.png"
    scene = SceneRequest(str(a.scene.resolve()), a.split, downscale=a.downscale)
    config = PRESETS["default"] if a.steps is None else dataclasses.replace(PRESETS["default"], steps=a.steps)
    tiny = dataclasses.replace(config, steps=20)
    counts, best, alone = [g for g in a.gpus if g <= torch.cuda.device_count()], 0, {}

    def measure(gpus: int, per_gpu: int) -> dict:
        slots, out = gpu_slots(gpus, per_gpu, max(counts)), work / f"{gpus}x{per_gpu}"
        first, jobs = (seeds_of(scene, c, out, k, n * len(slots)) for c, k, n in ((tiny, "tiny", 1), (config, "fit", a.fits)))
        row = {"gpus": gpus, "per_gpu": per_gpu, "threads": slots[0][1], **pack(slots, first, jobs)}
        shutil.rmtree(out)
        return row

    for per_gpu in a.per_gpu:
        row = measure(1, per_gpu)
        yield row
        if row["fits_per_hour"] > alone.get("fits_per_hour", 0):
            best, alone = per_gpu, row
    for gpus in counts:
        if gpus > 1:
            row = measure(gpus, best)
            yield row | {"efficiency": row["fits_per_hour"] / (gpus * alone["fits_per_hour"])}


def captures(a: Namespace, work: Path) -> Iterator[dict]:
    """Yield a row for each number of GPUs on which a list of jobs of different sizes runs."""
    listed, wanted = list_jobs(str(a.scene)), None
    counts = [g for g in a.gpus if g <= torch.cuda.device_count()]
    for gpus in counts:
        slots, out = gpu_slots(gpus, a.per_gpu[-1], max(counts)), work / f"{gpus}"
        jobs = farm_jobs(listed, ["--device", "cuda"], out)
        request = dataclasses.replace(jobs[0].request, config=dataclasses.replace(jobs[0].request.config, steps=20))
        tiny = [
            FarmJob(n, dataclasses.replace(request, out=out / n / "run"), out / n, out) for n in map(str, range(len(slots)))
        ]
        row = {"gpus": gpus, "per_gpu": a.per_gpu[-1], "threads": slots[0][1], **pack(slots, tiny, jobs)}
        written = digests(out, [j.name for j in jobs])
        wanted = wanted or written
        yield row | {"same_bytes": written == wanted}
        shutil.rmtree(out)


def main() -> None:
    """Parse, measure, print, write."""
    a = parse(
        __doc__, None, {"what": ("engines", "packing", "captures"), "scene?": Path}, split=str, downscale=int, scenes=20,
        steps=int, slots=2, per_gpu=[1, 2, 4, 8, 12], gpus=[1, 2, 4, 8], fits=4, work=Path, out=Path,
    )  # fmt: skip
    with tempfile.TemporaryDirectory() as temporary:
        work = (a.work or Path(temporary)).resolve()
        work.mkdir(parents=True, exist_ok=True)
        if a.what == "engines":
            found, device = engines(a.scenes, a.steps or 100, a.slots, work), torch.device("cpu")
        else:
            found, device = (packing if a.what == "packing" else captures)(a, work), torch.device("cuda")
        rows = []
        for row in found:  # a row that took minutes is kept when a later one fails
            rows.append(row)
            print(row, flush=True)
            load = os.getloadavg()[0]
            result_file.keep(a.out, f"farms of small fits: {a.what}", device, rows, load_average=load)


if __name__ == "__main__":
    main()
