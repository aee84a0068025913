"""Time against accuracy for every setting: kernels on frozen scenes, fits on a real one, with charts of both.

usage: python -m bench.experiments.tradeoff kernel --device cpu|cuda --out FILE.json [--run FOLDER] [--width 252] [--count 8000]
       python -m bench.experiments.tradeoff outcome SCENE --split llff:3 --out FILE.json [--downscale 1] [--seeds 0,1,2]
           [--only NAMES]
       python -m bench.experiments.tradeoff plot FILE.json    (draws again, prints tables)

An interrupted run goes on where it stopped: what FILE.json holds is not measured again. FILE.svg follows.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from pathlib import Path

from bench import result_file
from bench.experiments import pareto
from bench.experiments.frozen import scenes
from bench.experiments.settings import Setting
from bench.experiments.tradeoff_kernel import measure_scene, measured
from bench.experiments.tradeoff_outcome import measured as measured_fits
from bench.experiments.tradeoff_outcome import summary, trials
from warpgs import load_scene
from warpgs.files import write_json, write_text
from warpgs.pipeline.runs.precompile import fit_kernels
from warpgs.pipeline.runs.request import choose_device
from warpgs.runtime.interop import set_threads


def _stored(path: Path, fresh: dict) -> dict:
    """Return the result of an earlier run of the same kind and size, else a fresh one."""
    if not path.is_file():
        return fresh
    found = result_file.read(path)
    same = ("kind", "size", "scene")
    held, wanted = ([*(r.get(k) for k in same), r["machine"]["device"]] for r in (found, fresh))
    if held != wanted:
        raise SystemExit(f"{path} holds another measurement ({held}); choose another --out")
    return found


def kernel_chart(done: dict) -> str:
    """Time of an image with its gradients against its mean error, a panel for each scene."""
    panels = []
    what = "processor time of an image with gradients" if done["machine"]["device"] == "cpu" else "image with gradients"
    for name, scene in done["scenes"].items():
        points = tuple(
            pareto.Point(r["setting"], r["knob"], r["both_ms"], max(r["mean"], 1e-9), preset=r["preset"])
            for r in done["rows"] if r["scene"] == name and "both_ms" in r
        )  # fmt: skip
        panels.append(pareto.Panel(name, scene["what"], f"{what} [ms]", "mean error to float64 without cut-offs", points))
    m = done["machine"]
    return pareto.chart(f"{m['name']}: time against error, {done['size'][0]} x {done['size'][1]} px", panels)


def kernel_table(done: dict) -> str:
    """Markdown: time and mean error of every setting as multiples of `exact`'s, scene by scene."""
    names = list(done["scenes"])
    rows = {n: {r["setting"]: r for r in done["rows"] if r["scene"] == n} for n in names}
    lines = ["| setting | " + " | ".join(f"{n}: time, error" for n in names) + " |", "|---" * (len(names) + 1) + "|"]
    for setting in rows[names[0]]:
        cells = []
        for n in names:
            r, e = rows[n].get(setting), rows[n]["exact"]
            if r is None:
                cells.append("")
                continue
            time = f"{r['both_ms'] / e['both_ms']:.2f}" if "both_ms" in r else "-"
            cells.append(f"{time}, {r['mean'] / e['mean']:.2g}")
        lines.append(f"| {setting} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def outcome_table(lines: list[dict]) -> str:
    """Markdown: time and scores of every trial, and its difference to `quick` with the 95 % interval over paired seeds."""
    text = ["| fit | time [s] | PSNR [dB] | to quick | SSIM | to quick | Gaussians |", "|---|---|---|---|---|---|---|"]
    for r in lines:
        text.append(
            f"| {r['trial']} | {r['seconds']:.1f} | {r['psnr']:.2f} | {r['psnr_gain']:+.2f} ± {r['psnr_bar']:.2f} | "
            f"{r['ssim']:.4f} | {r['ssim_gain']:+.4f} ± {r['ssim_bar']:.4f} | {r['gaussians']:,.0f} |"
        )
    return "\n".join(text)


def write_kernel(path: Path, done: dict) -> None:
    """Write result and chart."""
    result_file.write(path, done)
    write_text(path.with_suffix(".svg"), kernel_chart(done))


def _fast_math_rows(a: argparse.Namespace) -> dict[str, dict]:
    """The row `exact` of each scene, measured in a process whose kernels are compiled with fast math."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "fast.json"
        command = [sys.executable, "-m", "bench.experiments.tradeoff", "kernel", "--fast-math", "--out", str(out)]
        for name in ("device", "width", "count", "seed", "repeats"):
            command += [f"--{name}", str(getattr(a, name))]
        subprocess.run(command + (["--run", str(a.run)] if a.run else []), check=True)
        return json.loads(out.read_text("utf-8"))


def kernel(a: argparse.Namespace) -> None:
    device, where = choose_device(a.device)
    height = round(a.width * 0.75)
    makers = scenes(device, a.width, height, a.count, a.run, a.seed)
    if a.fast_math:
        for k, _ in fit_kernels(device.type == "cuda"):
            k.module.options["fast_math"] = True
        fast = Setting("fast math", "fast math")
        write_json(a.out, {m.name: measure_scene(m, a.repeats, [fast])[0] for m in (make() for make in makers)})
        return
    facts = {
        "kind": "kernel", "size": [a.width, height, a.count, a.seed], "scene": str(a.run and a.run.name),
        "repeats": a.repeats, "scenes": {},
    }  # fmt: skip
    fresh = result_file.result("time of a render and its gradients against their error, for every setting", device, [], **facts)
    print(f"{where}; {len(makers)} scenes")
    done = measured(makers, _stored(a.out, fresh), a.repeats, lambda s: print(s, flush=True), lambda d: write_kernel(a.out, d))
    have = {r["setting"] for r in done["rows"]}
    if device.type == "cuda" and "fast math" not in have:  # on a CPU Warp has no such option
        for row in _fast_math_rows(a).values():
            own = {k: v for k, v in row.items() if not k.endswith("_to_exact")}  # that process has no `exact` of its own
            done["rows"].append(own)
    write_kernel(a.out, done)


def outcome_chart(done: dict, lines: list[dict]) -> str:
    """Time of a fit against the scores of held-out views, with the spread over seeds."""
    label = "processor time of the fit [s]" if done["machine"]["device"] == "cpu" else "wall time of the fit [s]"
    panels = []
    for key, words in (("psnr", "held-out PSNR [dB]"), ("ssim", "held-out SSIM")):
        points = tuple(pareto.Point(r["trial"], r["knob"], r["seconds"], r[key], r[f"{key}_sd"], r["preset"]) for r in lines)
        panels.append(
            pareto.Panel(words, "bars: standard deviation over seeds", label, words, points, upwards=True, log_y=False)
        )
    views = f"{done['scene']}, {done['size'][0]}, {done['resolution']}"
    return pareto.chart(f"{done['machine']['name']}: time of a fit against its scores, {views}", panels)


def write_outcome(path: Path, done: dict) -> None:
    """Write result and chart."""
    done["summary"] = summary(done["rows"], "cpu_seconds" if done["machine"]["device"] == "cpu" else "seconds")
    result_file.write(path, done)
    write_text(path.with_suffix(".svg"), outcome_chart(done, done["summary"]))


def outcome(a: argparse.Namespace) -> None:
    if a.threads:
        set_threads(a.threads)
    device, where = choose_device(a.device)
    scene = load_scene(a.scene, downscale=a.downscale)
    camera = scene.views[0].camera
    chosen = [t for t in trials() if a.only is None or t.name in a.only.split(",")]
    facts = {
        "kind": "outcome", "size": [a.split, a.downscale], "scene": Path(a.scene).name,
        "resolution": f"{camera.width} x {camera.height} px",
    }  # fmt: skip
    fresh = result_file.result("time of whole fits against scores of held-out views", device, [], **facts)
    print(f"{fresh['scene']} {fresh['resolution']}, {where}")
    seeds = [int(s) for s in a.seeds.split(",")]
    done = measured_fits(
        scene,
        a.split,
        device,
        chosen,
        seeds,
        _stored(a.out, fresh),
        lambda s: print(s, flush=True),
        lambda d: write_outcome(a.out, d),
    )
    write_outcome(a.out, done)


def main(arguments: list[str] | None = None) -> None:
    """Parse and measure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    kinds = parser.add_subparsers(dest="kind", required=True)
    p = kinds.add_parser("kernel")
    p.add_argument("--device", default="auto")
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--run", type=Path, help="folder that a fit filled, for the trained scene")
    p.add_argument("--width", type=int, default=252)
    p.add_argument("--count", type=int, default=8000)
    p.add_argument("--seed", type=int, default=0)
    p.add_argument("--repeats", type=int, default=7)
    p.add_argument("--fast-math", action="store_true", help=argparse.SUPPRESS)
    p = kinds.add_parser("outcome")
    p.add_argument("scene")
    p.add_argument("--split", default="llff:3")
    p.add_argument("--device", default="auto")
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--downscale", type=int, default=1)
    p.add_argument("--seeds", default="0,1,2")
    p.add_argument("--threads", type=int, default=0)
    p.add_argument("--only", help="names of trials, with commas between")
    p = kinds.add_parser("plot")
    p.add_argument("out", type=Path)
    a = parser.parse_args(arguments)
    if a.kind == "plot":
        done = result_file.read(a.out)
        (write_kernel if done["kind"] == "kernel" else write_outcome)(a.out, done)
        print(kernel_table(done) if done["kind"] == "kernel" else outcome_table(done["summary"]))
        return
    (kernel if a.kind == "kernel" else outcome)(a)


if __name__ == "__main__":
    main()
