"""Size against quality: the default, a fixed set, the same without harmonics, and that pruned, paired by scene and seed.

usage: python -m bench.sizes DATA [--rows fern:3 ...] [--default default] [--fixed default] [--seeds 5] [--jobs 1] [--seconds S]
           [--device auto] --out FILE.json
``--default`` and ``--fixed`` are presets with settings if need be, as bench.presets takes them: while the default is the fixed
fit, ``--default default:holdout.degrees=true,holdout.trim_db=0.1`` is the adaptive one. The file goes on where it was
stopped, and `python -m bench.presets --table` reads it, too.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
from pathlib import Path

from bench import presets, result_file
from bench.one_fit import PRUNED
from bench.preset_table import by_seed
from warpgs.pipeline.study.statistics import paired_difference

ROWS = ("fern:3", "horns:3", "fox:8", "temple:4", "fern:17", "demo")
LIMITS = {"psnr": -0.05, "ssim": -0.002}
"""Mean paired loss of the default against the fixed fit that is allowed over all scenes [dB, SSIM]."""


def kinds(default: str, fixed: str) -> dict[str, str]:
    """Return the four kinds of fits by name."""
    separator = "," if ":" in fixed else ":"
    return {
        "default": default, "fixed": fixed, "fixed, SH 0": f"{fixed}{separator}init.max_sh_degree=0", "pruned": PRUNED + fixed,
    }  # fmt: skip


def table(rows: list[dict], default: str, fixed: str) -> str:
    """Return bytes and scores of each kind by scene, and the paired difference of each kind to the fixed fit over all."""
    found, lines = by_seed(rows), ["| row | fit | seeds | kB | PSNR [dB] | - fixed [dB] | SSIM |", "|---" * 7 + "|"]
    means: dict[str, list[dict[str, float]]] = {}
    for name in dict.fromkeys(name for name, _ in found):
        base = found.get((name, fixed), {})
        for kind, preset in kinds(default, fixed).items():
            own = found.get((name, preset), {})
            both = [s for s in own if s in base]
            if not both:
                continue
            values = {k: [own[s][k] for s in both] for k in ("bytes", "psnr", "ssim")}
            gains = {k: statistics.mean(own[s][k] - base[s][k] for s in both) for k in LIMITS}
            size = math.exp(statistics.mean(math.log(own[s]["bytes"] / base[s]["bytes"]) for s in both))
            means.setdefault(kind, []).append(gains | {"size": size})
            mean = {k: statistics.mean(v) for k, v in values.items()}
            ssim = "" if math.isnan(mean["ssim"]) else f"{mean['ssim']:.4f}"
            head = f"| {name} | {kind} | {len(both)} | {mean['bytes'] / 1000:,.0f} "
            lines.append(f"{head}| {mean['psnr']:.2f} | {gains['psnr']:+.3f} | {ssim} |")
    return "\n".join([*lines, "", *(verdict(kind, own) for kind, own in means.items() if kind != "fixed")])


def verdict(kind: str, scenes: list[dict[str, float]]) -> str:
    """Return a line on one kind against the fixed fit: means over scenes with their 95 % intervals, and the limits."""
    size = math.exp(statistics.mean(math.log(s["size"]) for s in scenes))
    parts, kept = [], True
    for key, unit in (("psnr", " dB"), ("ssim", " SSIM")):
        values = [s[key] for s in scenes if not math.isnan(s[key])]
        if values:
            d = paired_difference(values, [0.0] * len(values))
            parts.append(f"{d.mean:+.4f}{unit} [{d.low:+.4f}, {d.high:+.4f}]")
            kept &= d.mean >= LIMITS[key]
    text = f"- {kind}: {size:.2f} of the bytes, {', '.join(parts)} over {len(scenes)} scenes"
    return f"{text}; {'within' if kept else 'beyond'} limits"


def main(arguments: list[str] | None = None) -> int:
    """Measure what the file lacks and print the table; return the exit code."""
    p = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    p.add_argument("data", type=Path, nargs="?")
    p.add_argument("--rows", nargs="+", default=list(ROWS))
    p.add_argument("--default", default="default")
    p.add_argument("--fixed", default="default")
    p.add_argument("--out", type=Path, required=True)
    p.add_argument("--only-table", action="store_true", help="print the table of the file; nothing is measured")
    a, others = p.parse_known_args(arguments)
    code = 0
    if not a.only_table:
        words = ["--rows", *a.rows, "--presets", *kinds(a.default, a.fixed).values(), "--base", a.default, "--out", str(a.out)]
        code = presets.main([str(a.data), *words, *others])
    if a.out.is_file():
        print(table(result_file.read(a.out)["rows"], a.default, a.fixed))
    return code


if __name__ == "__main__":
    sys.exit(main())
