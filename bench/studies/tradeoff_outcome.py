"""Time of whole fits against scores of held-out views, for every setting of a fit, with several seeds and a chart.

An interrupted measurement continues: rows in --out are not measured again. A chart is written as SVG beside --out.
"""

from __future__ import annotations

import statistics
from pathlib import Path

from bench.lib import pareto, result_file
from bench.lib.arguments import SCENE, parse
from bench.lib.one_fit import bare_fit, config_of
from bench.lib.pool import stored_rows
from bench.lib.tables import markdown
from warpgs import load_scene
from warpgs.files import write_text
from warpgs.io.load import split_views
from warpgs.kernels.launch import set_threads
from warpgs.pipeline.run.request import choose_device
from warpgs.pipeline.study.tables import paired_difference

WHAT = "time of whole fits against scores of held-out views"
TRIALS = {
    "quick": ("preset", "quick"),
    **{f"{n} steps": ("iterations", f"quick:steps={n}") for n in (300, 1200)},
    **{f"rule {r}": ("rule", f"quick:rule={r}") for r in ("balanced", "fast")},
    **{f"half size {s:g}": ("resolution schedule", f"quick:half_resolution={s}") for s in (0.3, 0.6)},
    **{f"{n} Gaussians": ("Gaussian budget", f"quick:max_gaussians={n}") for n in (3000, 5000)},
    "degree 0": ("SH degree", "quick:sh_degree=0"),
    **{
        f"1200 steps, {r}, half {h:g}": ("pairs", f"quick:steps=1200,rule={r},half_resolution={h}")
        for r, h in (("balanced", 0.3), ("fast", 0.6))
    },
    "default": ("preset", "default"),
}
"""Name of the changed setting, and the settings, of each fit by name: one setting changed from preset `quick`, then pairs, then
presets."""
KEPT = ("seconds", "setup", "cpu_seconds", "setup_cpu", "gaussians", "bytes", "steps", "psnr", "ssim")


def summary(rows: list[dict], time_key: str) -> list[dict]:
    """Return the mean over seeds of each trial, with half the 95 % interval of the paired difference to `quick`."""
    base, made = {r["seed"]: r for r in rows if r["trial"] == "quick"}, []
    for name in dict.fromkeys(r["trial"] for r in rows):
        own = [r for r in rows if r["trial"] == name]
        line = {"trial": name, "knob": own[0]["knob"], "preset": own[0]["preset"], "seeds": len(own)}
        line["seconds"], line["gaussians"] = (statistics.mean(r[k] for r in own) for k in (time_key, "gaussians"))
        pairs = [(r, base[r["seed"]]) for r in own if r["seed"] in base]
        for key in ("psnr", "ssim"):
            d = paired_difference([r[key] for r, _ in pairs], [b[key] for _, b in pairs])
            line |= {key: statistics.mean(r[key] for r in own), f"{key}_gain": d.mean}
            line[f"{key}_bar"] = (d.high - d.low) / 2 if d.count > 1 else 0.0
            line[f"{key}_sd"] = statistics.stdev([r[key] for r in own]) if len(own) > 1 else 0.0
        made.append(line)
    return made


def table(lines: list[dict]) -> str:
    """Return time and scores of every trial, and its difference to `quick` with the 95 % interval over paired seeds."""
    head = ["fit", "time [s]", "PSNR [dB]", "to quick", "SSIM", "to quick", "Gaussians"]
    return markdown(head, [
        [r["trial"], f"{r['seconds']:.1f}", f"{r['psnr']:.2f}", f"{r['psnr_gain']:+.2f} ± {r['psnr_bar']:.2f}",
         f"{r['ssim']:.4f}", f"{r['ssim_gain']:+.4f} ± {r['ssim_bar']:.4f}", f"{r['gaussians']:,.0f}"] for r in lines
    ])  # fmt: skip


def chart(done: dict) -> str:
    """Return time of a fit against the scores of held-out views, with the spread over seeds, as SVG."""
    label = "processor time of the fit [s]" if done["machine"]["device"] == "cpu" else "wall time of the fit [s]"
    panels = []
    for key, words in (("psnr", "held-out PSNR [dB]"), ("ssim", "held-out SSIM")):
        points = tuple(
            pareto.Point(r["trial"], r["knob"], r["seconds"], r[key], r[f"{key}_sd"], r["preset"]) for r in done["summary"]
        )
        what = "bars: standard deviation over seeds"
        panels.append(pareto.Panel(words, what, label, words, points, upwards=True, log_y=False))
    views = f"{done['scene']}, {done['size'][0]}, {done['resolution']}"
    return pareto.chart(f"{done['machine']['name']}: time of a fit against its scores, {views}", panels)


def main(arguments: list[str] | None = None) -> None:
    """Run the missing fits, seed by seed, so that other load on the machine affects all alike; write, draw, print."""
    a = parse(
        __doc__, arguments, SCENE, need=("out",), split="llff:3", device="auto", downscale=1, seeds=[0, 1, 2], threads=0,
        only=list(TRIALS), plot=False, out=Path,
    )  # fmt: skip
    if not a.plot:
        if a.threads:
            set_threads(a.threads)
        device, scene = choose_device(a.device)[0], load_scene(a.scene, downscale=a.downscale)
        split, camera = split_views(scene, a.split), scene.views[0].camera
        train, test = ([scene.view(name) for name in names] for names in (split.train, split.test))
        facts = {"kind": "outcome", "size": [a.split, a.downscale], "scene": a.scene.name}
        facts["resolution"] = f"{camera.width} x {camera.height} px"
        rows, time_key = stored_rows(a.out, **facts), "cpu_seconds" if device.type == "cpu" else "seconds"
        bare_fit(scene, train, test, config_of("quick:steps=30"), device)  # compiles
        for seed, name in ((s, t) for s in a.seeds for t in a.only):
            if not any((r["trial"], r["seed"]) == (name, seed) for r in rows):
                knob, preset = TRIALS[name]
                row = bare_fit(scene, train, test, config_of(preset, seed), device)
                head = {"trial": name, "knob": knob, "preset": knob == "preset", "seed": seed}
                rows.append(head | {k: row[k] for k in KEPT})
                print(f"  {name:<30} seed {seed}  {row[time_key]:6.1f} s  {row['psnr']:.2f} dB", flush=True)
                result_file.keep(a.out, WHAT, device, rows, **facts, summary=summary(rows, time_key))
    done = result_file.read(a.out)
    write_text(a.out.with_suffix(".svg"), chart(done))
    print(table(done["summary"]))


if __name__ == "__main__":
    main()
