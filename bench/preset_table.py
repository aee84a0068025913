"""Tables of fits by row, preset and seed: means, the worst seed, and the base beside the best of the others."""

from __future__ import annotations

import math
import statistics
from collections import defaultdict

from warpgs.pipeline.study.statistics import Difference, paired_difference, sample

LIMIT = 0.1
"""Loss against the best rival that is allowed [dB]."""


def by_seed(rows: list[dict]) -> dict[tuple[str, str], dict[int, dict]]:
    """Return the results of each (row, preset) by seed, those of views left out one at a time averaged; failures left out."""
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


def rival(scores: dict[str, dict[int, float]], base: str) -> tuple[Difference, list[str]]:
    """Return the paired difference of the base to the best of the others, and who that was.

    For each seed that all have, the rival is the preset of the best mean over the other seeds: picked on the seeds that are
    compared it would owe part of its lead to luck. With seeds that some lack, a weaker one could stand for a missing best.

    Args:
        scores: PSNR by preset and seed [dB].
        base: The preset that is compared.

    Raises:
        ValueError: The base has no score.
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
    s = sample([v for v in values if not math.isnan(v)])
    return "" if not s.count else f"{s.mean:.{digits}f}" + (f" ± {s.sd:.{digits}f}" if s.count > 1 else "")


def _times(own: list[dict]) -> str:
    text = " + ".join(f"{statistics.mean(r[k] for r in own):.1f}" for k in ("setup", "training"))
    return text if all(r["alone"] for r in own) else f"({text})"


def means_table(rows: list[dict]) -> str:
    """Return mean ± deviation over seeds by row and preset; times taken beside other fits are in brackets."""
    heads = "row | preset | seeds | PSNR [dB] | SSIM | worst below median [dB] | Gaussians | kB | setup + training [s] | steps"
    lines = [f"| {heads} | ended |", "|---" * 11 + "|"]
    found = by_seed(rows)
    order = list(dict.fromkeys(name for name, _ in found))
    for (name, preset), seeds in sorted(found.items(), key=lambda item: order.index(item[0][0])):
        own = list(seeds.values())
        psnr = [r["psnr"] for r in own]
        cells = [name, f"`{preset}`", len(own), _spread(psnr), _spread([r["ssim"] for r in own], 4)]
        cells.append(f"{statistics.median(psnr) - min(psnr):.2f}")
        cells += [f"{statistics.mean(r[k] for r in own) / unit:,.0f}" for k, unit in (("gaussians", 1), ("bytes", 1000))]
        cells += [_times(own), f"{statistics.mean(r['steps'] for r in own):,.0f}", "; ".join(sorted({r["ended"] for r in own}))]
        lines.append("| " + " | ".join(str(c) for c in cells) + " |")
    return "\n".join(lines)


def rivals_table(rows: list[dict], base: str) -> str:
    """Return, for each row, the base against the best of the others with its 95 % interval, and the worst row last."""
    found, lines = (
        by_seed(rows),
        [f"| row | seeds | best of the others | {base} - best [dB] | 95 % interval |", "|---" * 5 + "|"],
    )
    worst: tuple[float, str] = (math.inf, "")
    for name in dict.fromkeys(name for name, _ in found):
        scores = {p: {s: r["psnr"] for s, r in seeds.items()} for (n, p), seeds in found.items() if n == name}
        if base not in scores or len(scores) < 2:
            continue
        d, names = rival(scores, base)
        if not d.count:
            lines.append(f"| {name} | 0 | two seeds of each are needed | | |")
            continue
        worst = min(worst, (d.mean, name))
        lines.append(f"| {name} | {d.count} | {', '.join(names)} | {d.mean:+.2f} | [{d.low:+.2f}, {d.high:+.2f}] |")
    if worst[1]:
        kept = "within" if worst[0] >= -LIMIT else "beyond"
        lines += ["", f"Worst row: {worst[1]}, {worst[0]:+.2f} dB, {kept} the {LIMIT} dB that are allowed."]
    return "\n".join(lines)


def tables(rows: list[dict], base: str) -> str:
    """Return both tables, and a line for each fit that failed."""
    failed = [f"- failed: {r['row']}, `{r['preset']}`, seed {r['seed']}: {r['error']}" for r in rows if "error" in r]
    return "\n".join([means_table(rows), "", rivals_table(rows, base), *([""] if failed else []), *failed])
