"""Bytes against PSNR: fixed and adaptive fits over seeds, and what is left of them when they are pruned further.

    python -m bench.experiments.complexity SCENE ... --out DIR [--split llff:3] [--preset default] [--seeds 5] [--device auto]

DIR is a study as `warpgs compare` makes it, with finished runs kept when the command is given again, and besides its files
complexity.json (a row per run), complexity.md (means, paired differences), curve.json and curve.svg (every scene's first seed
at growing loss of training PSNR). ``--from-runs`` takes RUN folders in place of scenes and only draws their curves.
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import tempfile
from html import escape
from pathlib import Path

from bench import result_file, training
from bench.plot import PALETTE
from warpgs.errors import WarpgsError
from warpgs.files import write_text
from warpgs.pipeline.runs.request import choose_device
from warpgs.report.curve import ticks

KEEP = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0, 4.0)
"""Losses of training PSNR at which a run is pruned [dB]."""
SIZE, LEFT, RIGHT, TOP, BOTTOM = (520, 300), 56, 130, 54, 48


def run_rows(study: Path, scenes: list[str], variants: list[str], seeds: int) -> list[dict]:
    """A row for every finished run of a study."""
    rows = []
    for scene in scenes:
        for variant in variants:
            for seed in range(seeds):
                path = study / scene / variant / str(seed) / "metrics.json"
                if not path.is_file():
                    continue
                m = json.loads(path.read_text("utf-8"))
                c = m["complexity"]
                rows.append({
                    "scene": scene, "variant": variant, "seed": seed, "psnr": m["test"]["psnr"], "ssim": m["test"]["ssim"],
                    "train_psnr": m["train"]["psnr"], "gaussians": c["count"], "mean_degree": c["mean_degree"],
                    "bytes": c["bytes"], "seconds": m["seconds"]["total"], "marginal_db": c["marginal_db"], "why": c["why"],
                })  # fmt: skip
    return rows


def summary(rows: list[dict]) -> str:
    """A Markdown table: means and standard deviations per scene and variant, and the paired difference to the first variant."""
    lines = [
        "| scene | fit | seeds | Gaussians | degree | bytes | PSNR [dB] | bytes, first over this | PSNR - first [dB] |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    variants = list(dict.fromkeys(r["variant"] for r in rows))
    for scene in dict.fromkeys(r["scene"] for r in rows):
        first = {r["seed"]: r for r in rows if (r["scene"], r["variant"]) == (scene, variants[0])}
        for variant in variants:
            own = [r for r in rows if (r["scene"], r["variant"]) == (scene, variant)]
            if not own:
                continue
            mean = {k: statistics.mean(r[k] for r in own) for k in ("gaussians", "mean_degree", "bytes", "psnr")}
            pairs = [(r, first[r["seed"]]) for r in own if r["seed"] in first]
            ratio = statistics.mean(f["bytes"] / r["bytes"] for r, f in pairs) if pairs else float("nan")
            differences = [r["psnr"] - f["psnr"] for r, f in pairs] or [float("nan")]
            lines.append(
                f"| {scene} | {variant} | {len(own)} | {mean['gaussians']:,.0f} | {mean['mean_degree']:.2f} | "
                f"{mean['bytes']:,.0f} | {_spread([r['psnr'] for r in own])} | {ratio:.2f} | {_spread(differences)} |"
            )
    return "\n".join(lines) + "\n"


def _spread(values: list[float]) -> str:
    sd = f" ± {statistics.stdev(values):.2f}" if len(values) > 1 else ""
    return f"{statistics.mean(values):.2f}{sd}"


def curve_rows(run: Path, name: str, device: str) -> list[dict]:
    """The run itself, and the run pruned at every loss of `KEEP`."""
    from warpgs.pipeline.runs.prune import prune

    rows = []
    with tempfile.TemporaryDirectory() as folder:
        for keep in KEEP:
            out = Path(folder) / f"{keep:g}"
            prune(run, keep, out, device)
            p = json.loads((out / "config.json").read_text("utf-8"))["pruned"]
            for i in (0, 1) if not rows else (1,):
                rows.append({
                    "run": name, "keep_db": keep if i else 0.0, "gaussians": p["count"][i], "mean_degree": p["mean_degree"][i],
                    "bytes": p["bytes"][i], "train_psnr": p["train_psnr"][i],
                    "psnr": p["test_psnr"][i] if p["test_psnr"] else float("nan"),
                })  # fmt: skip
    return rows


def curve_svg(rows: list[dict]) -> str:
    """Held-out PSNR against megabytes, a line per run; the run as it was fitted has a larger dot."""
    xs, ys = [r["bytes"] / 1e6 for r in rows], [r["psnr"] for r in rows]
    x0, x1, y0, y1 = 0.0, 1.05 * max(xs), min(ys) - 0.1, max(ys) + 0.1
    width, height = SIZE
    right, bottom = width - RIGHT, height - BOTTOM

    def px(x: float) -> float:
        return LEFT + (x - x0) / (x1 - x0) * (right - LEFT)

    def py(y: float) -> float:
        return bottom - (y - y0) / (y1 - y0) * (bottom - TOP)

    def text(x: float, y: float, words: str, more: str = "") -> str:
        return f'<text x="{x:.1f}" y="{y:.1f}" font-size="11" fill="#555555" {more}>{escape(words)}</text>'

    out = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}" '
        'font-family="system-ui, -apple-system, Segoe UI, Helvetica, Arial, sans-serif">',
        f'<rect width="{width}" height="{height}" fill="#ffffff"/>',
        text(16, 22, "What is left when a model is pruned", 'font-weight="600" style="font-size:15px;fill:#111111"'),
        text(16, 40, "held-out PSNR [dB]"),
        text((LEFT + right) / 2, height - 10, "bytes of the model [MB]", 'text-anchor="middle"'),
    ]
    for y in ticks(y0, y1):
        out.append(f'<path d="M{LEFT} {py(y):.1f}H{right}" stroke="#e6e6e6"/>')
        out.append(text(LEFT - 6, py(y) + 4, f"{y:g}", 'text-anchor="end"'))
    out += [text(px(x), bottom + 18, f"{x:g}", 'text-anchor="middle"') for x in ticks(x0, x1)]
    for i, name in enumerate(dict.fromkeys(r["run"] for r in rows)):
        own, color = [r for r in rows if r["run"] == name], PALETTE[i % len(PALETTE)]
        at = [(px(r["bytes"] / 1e6), py(r["psnr"])) for r in own]
        out.append(f'<path d="M{"L".join(f"{x:.1f} {y:.1f}" for x, y in at)}" fill="none" stroke="{color}" stroke-width="2"/>')
        out += [f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{3 if k else 5}" fill="{color}"/>' for k, (x, y) in enumerate(at)]
        out.append(f'<text x="{right + 10}" y="{TOP + 16 + 18 * i}" font-size="12" fill="{color}">{escape(name)}</text>')
    return "\n".join([*out, "</svg>"]) + "\n"


def _write(a: argparse.Namespace, name: str, what: str, rows: list[dict]) -> None:
    result_file.write(a.out / f"{name}.json", result_file.result(what, choose_device(a.device)[0], rows))


def study(a: argparse.Namespace) -> list[tuple[str, Path]]:
    """Fit, write the tables, and name the runs whose curves are drawn."""
    from warpgs.pipeline.runs.request import SceneRequest
    from warpgs.pipeline.study.compare import preset_variants, run_study
    from warpgs.pipeline.study.study import StudyRequest, scene_name

    base = preset_variants([a.preset], a.steps)[a.preset]
    variants = {"fixed": base, "adaptive": training.with_holdout(base)}
    scenes = tuple(SceneRequest(s, a.split, a.downscale) for s in a.inputs)
    for line in run_study(StudyRequest(scenes, variants, a.seeds, a.out, a.device)):
        print(line)
    names = [scene_name(s) for s in scenes]
    rows = run_rows(a.out, names, list(variants), a.seeds)
    _write(a, "complexity", "size and scores of fixed and adaptive fits over seeds", rows)
    table = summary(rows)
    write_text(a.out / "complexity.md", table)
    print(table)
    return [(f"{n}, {v}", a.out / n / v / "0") for n in names for v in variants]


def main(arguments: list[str] | None = None) -> int:
    """Run the study or draw curves of runs; returns an exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("inputs", nargs="+", help="scene folders, or run folders with --from-runs")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--from-runs", action="store_true")
    parser.add_argument("--split", default="llff:3")
    parser.add_argument("--downscale", type=int, default=1)
    parser.add_argument("--preset", default="default")
    parser.add_argument("--steps", type=int)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--device", default="auto")
    a = parser.parse_args(arguments)
    try:
        a.out.mkdir(parents=True, exist_ok=True)
        runs = [(Path(r).name, Path(r)) for r in a.inputs] if a.from_runs else study(a)
        rows = [row for name, folder in runs for row in curve_rows(folder, name, a.device)]
    except WarpgsError as e:
        print(f"bench.experiments.complexity: {e}", file=sys.stderr)
        return e.exit_code
    _write(a, "curve", "what is left of a model when it is pruned, by the training PSNR that is given up", rows)
    write_text(a.out / "curve.svg", curve_svg(rows))
    for r in rows:
        print(
            f"{r['run']:20} keep {r['keep_db']:4g} dB {r['gaussians']:9,} Gaussians {r['bytes']:11,} bytes {r['psnr']:6.2f} dB"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
