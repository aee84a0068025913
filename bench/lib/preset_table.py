"""Tables of fits by row, preset and seed: means, the worst seed, and the base beside the best other preset."""

from __future__ import annotations

import math
import statistics
from collections import defaultdict

from bench.lib.tables import markdown, mean_sd
from warpgs.pipeline.study.tables import Sample, paired_difference

LIMIT = 0.1
"""Largest allowed loss against the best rival [dB]."""
LIMITS = {"psnr": -0.05, "ssim": -0.002}
"""Largest allowed mean paired loss of a smaller model against the fixed fit, over all scenes [dB, SSIM]."""


def by_seed(rows: list[dict]) -> dict[tuple[str, str], dict[int, dict]]:
    """Return the results of each (row, preset) by seed, without failures; results for left-out views are averaged."""
    groups: dict[tuple, list[dict]] = defaultdict(list)
    for row in rows:
        if "error" not in row:
            groups[row["row"], row["preset"], row["seed"]].append(row)
    found: dict[tuple[str, str], dict[int, dict]] = defaultdict(dict)
    for (name, preset, seed), own in groups.items():
        one = {"ended": own[0].get("ended") or own[0].get("why") or "", "alone": all(r.get("jobs", 1) == 1 for r in own)}
        for key in ("psnr", "ssim", "gaussians", "bytes", "steps", "setup", "training"):
            values = [r[key] for r in own if r.get(key) is not None]
            one[key] = math.fsum(values) / len(values) if values else math.nan
        found[name, preset][seed] = one
    return dict(found)


def rival(scores: dict[str, dict[int, float]], base: str) -> tuple[Sample, list[str]]:
    """Return the paired difference of the base to the best of the others, and the names of the best.

    For each seed with results for all presets, the rival is the preset with the best mean over the other seeds, which avoids
    winner's bias. Seeds without results for some presets are not used, because the best preset could be missing.
    """
    if not scores.get(base):
        raise ValueError(f"no score of {base}: name another with --base, of {', '.join(scores)}")
    ours, theirs, names = [], [], []
    common = set.intersection(*(set(own) for own in scores.values()))
    for seed in sorted(common) if len(common) > 1 else ():
        means = {n: statistics.mean(own[s] for s in common - {seed}) for n, own in scores.items() if n != base}
        names.append(max(means, key=lambda n: means[n]))
        ours.append(scores[base][seed])
        theirs.append(scores[names[-1]][seed])
    return paired_difference(ours, theirs), list(dict.fromkeys(names))


def _spread(values: list[float], digits: int = 2) -> str:
    known = [v for v in values if not math.isnan(v)]
    return mean_sd(known, digits) if known else ""


def _times(own: list[dict]) -> str:
    text = " + ".join(f"{statistics.mean(r[k] for r in own):.1f}" for k in ("setup", "training"))
    return text if all(r["alone"] for r in own) else f"({text})"


def means_table(rows: list[dict]) -> str:
    """Return mean ± deviation over seeds by row and preset; times taken beside other fits are in brackets."""
    heads = "row | preset | seeds | PSNR [dB] | SSIM | worst below median [dB] | Gaussians | kB | setup + training [s] | steps"
    found, lines = by_seed(rows), []
    order = list(dict.fromkeys(name for name, _ in found))
    for (name, preset), seeds in sorted(found.items(), key=lambda item: order.index(item[0][0])):
        own = list(seeds.values())
        psnr = [r["psnr"] for r in own]
        cells = [name, f"`{preset}`", len(own), _spread(psnr), _spread([r["ssim"] for r in own], 4)]
        cells.append(f"{statistics.median(psnr) - min(psnr):.2f}")
        cells += [f"{statistics.mean(r[k] for r in own) / unit:,.0f}" for k, unit in (("gaussians", 1), ("bytes", 1000))]
        cells += [_times(own), f"{statistics.mean(r['steps'] for r in own):,.0f}", "; ".join(sorted({r["ended"] for r in own}))]
        lines.append(cells)
    return markdown([*heads.split(" | "), "ended"], lines)


def rivals_table(rows: list[dict], base: str) -> str:
    """Return, for each row, the base against the best of the others with its 95 % interval, and the worst row last."""
    found, lines = by_seed(rows), []
    worst: tuple[float, str] = (math.inf, "")
    for name in dict.fromkeys(name for name, _ in found):
        scores = {p: {s: r["psnr"] for s, r in seeds.items()} for (n, p), seeds in found.items() if n == name}
        if base not in scores or len(scores) < 2:
            continue
        d, names = rival(scores, base)
        if not d.values:
            lines.append([name, 0, "two seeds of each are needed", "", ""])
            continue
        worst = min(worst, (d.mean, name))
        lines.append([name, len(d.values), ", ".join(names), f"{d.mean:+.2f}", f"[{d.low:+.2f}, {d.high:+.2f}]"])
    if not lines:
        return ""
    text = markdown(["row", "seeds", "best of the others", f"{base} - best [dB]", "95 % interval"], lines)
    kept = "within" if worst[0] >= -LIMIT else "beyond"
    return text + (f"\nWorst row: {worst[1]}, {worst[0]:+.2f} dB, {kept} the {LIMIT} dB that are allowed." if worst[1] else "")


def sizes_table(rows: list[dict], fixed: str) -> str:
    """Return bytes and scores by row and preset, compared with one preset, and a line over all rows for each other preset."""
    found, lines = by_seed(rows), []
    means: dict[str, list[dict[str, float]]] = {}
    for (name, preset), own in found.items():
        base = found.get((name, fixed), {})
        both = [s for s in own if s in base]
        if not both:
            continue
        gains = {k: statistics.mean(own[s][k] - base[s][k] for s in both) for k in LIMITS}
        size = math.exp(statistics.mean(math.log(own[s]["bytes"] / base[s]["bytes"]) for s in both))
        means.setdefault(preset, []).append(gains | {"size": size})
        mean = {k: statistics.mean(own[s][k] for s in both) for k in ("bytes", "psnr", "ssim")}
        ssim = "" if math.isnan(mean["ssim"]) else f"{mean['ssim']:.4f}"
        lines.append([name, f"`{preset}`", len(both), f"{mean['bytes'] / 1000:,.0f}", f"{mean['psnr']:.2f}"])
        lines[-1] += [f"{gains['psnr']:+.3f}", ssim]
    text = markdown(["row", "preset", "seeds", "kB", "PSNR [dB]", f"- {fixed} [dB]", "SSIM"], lines)
    return "\n".join([text, *(_verdict(preset, own) for preset, own in means.items() if preset != fixed)])


def _verdict(preset: str, scenes: list[dict[str, float]]) -> str:
    """Return a line on one preset: means over scenes with their 95 % intervals, and the limits."""
    size = math.exp(statistics.mean(math.log(s["size"]) for s in scenes))
    parts, kept = [], True
    for key, unit in (("psnr", " dB"), ("ssim", " SSIM")):
        values = [s[key] for s in scenes if not math.isnan(s[key])]
        if values:
            d = paired_difference(values, [0.0] * len(values))
            parts.append(f"{d.mean:+.4f}{unit} [{d.low:+.4f}, {d.high:+.4f}]")
            kept &= d.mean >= LIMITS[key]
    text = f"- {preset}: {size:.2f} of the bytes, {', '.join(parts)} over {len(scenes)} scenes"
    return f"{text}; {'within' if kept else 'beyond'} limits"


def tables(rows: list[dict], base: str, fixed: str | None = None) -> str:
    """Return the tables, including that of sizes if a fixed preset is given, and a line for each failed fit."""
    failed = [f"- failed: {r['row']}, `{r['preset']}`, seed {r['seed']}: {r['error']}" for r in rows if "error" in r]
    sizes = [] if fixed is None else [sizes_table(rows, fixed)]
    return "\n\n".join(filter(None, [means_table(rows), rivals_table(rows, base), *sizes, "\n".join(failed)]))
