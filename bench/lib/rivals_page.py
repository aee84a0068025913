"""The generated parts of docs/results.md on rivals and on the ladder."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from bench.lib import result_file
from bench.lib.arms import LADDER, RIVALS, Arm, chosen_steps, steps_in
from bench.lib.preset_table import by_seed
from bench.lib.tables import markdown, mean_sd
from warpgs.pipeline.study.statistics import family_confidence, paired_difference

STEPS_FILE, RIVALS_FILES, LADDER_FILE = "rivals_steps_h100", ("rivals_h100", "gsplat_30000_h100"), "ladder_h100"
"""Results of `bench.fits.rivals`: scores on training views left out, those of both sets, and gsplat's longest fits."""
SEEDS = 2
"""Fewest seeds of an interval."""


def preset_in(rows: list[dict], tuned: list[dict], row: str, arm: Arm) -> str | None:
    """Return the preset that an arm has on a row; None where it was not measured."""
    preset = arm.with_steps(chosen_steps(tuned, row, arm)) if arm.steps else arm.preset
    return preset if any((r["row"], r["preset"]) == (row, preset) and "error" not in r for r in rows) else None


def arms_table(arms: Sequence[Arm], rows: list[dict], tuned: list[dict], names: Sequence[str], above: bool) -> str:
    """Return PSNR and SSIM of each arm on each row, with its steps, and the difference in PSNR to the base by seed.

    Args:
        arms: Rows of the table.
        rows: Results on held-out views.
        tuned: Results on training views left out.
        names: Rows of the comparison, a group of columns each.
        above: The base of an arm is the one above it, else the first arm.
    """
    found, confidence, body = by_seed(rows), family_confidence(len(arms) - 1), []
    for place, arm in enumerate(arms):
        body.append([arm.words])
        for name in names:
            preset = preset_in(rows, tuned, name, arm)
            if preset is None:
                body[-1] += ["", "", ""]
                continue
            own = found[name, preset]
            base = arms[place - 1] if above else arms[0]
            theirs = found.get((name, preset_in(rows, tuned, name, base) or ""), {}) if place else {}
            seeds = sorted(own.keys() & theirs.keys())
            d = paired_difference([own[s]["psnr"] for s in seeds], [theirs[s]["psnr"] for s in seeds], confidence)
            change = (
                f"{d.mean:+.2f} [{d.low:+.2f}, {d.high:+.2f}]" if len(seeds) >= SEEDS else f"{d.mean:+.2f}" if seeds else ""
            )
            count = "" if len(own) == max(len(s) for s in found.values()) else f" ({len(own)} seed{'s' * (len(own) > 1)})"
            score = f"{mean_sd([r['psnr'] for r in own.values()])} / {statistics.mean(r['ssim'] for r in own.values()):.3f}"
            body[-1] += [f"{steps_in(preset):,}", score + count, change]
    scenes = [name.split(":")[0] for name in names]
    what = "change" if above else "difference to it"
    head = [heading for s in scenes for heading in (f"{s}: steps", f"{s}: PSNR / SSIM", what)]
    return markdown(["step" if above else "method", *head], body, ["step" if above else "method"])


def _rows(*names: str) -> list[dict]:
    return [row for name in names for row in result_file.read(result_file.FOLDER / f"{name}.json")["rows"]]


def _names(rows: list[dict]) -> list[str]:
    return list(dict.fromkeys(sorted(r["row"] for r in rows)))


def _sources(*names: str) -> str:
    return "\n" + "\n".join(result_file.source(name) for name in names)


def rivals() -> str:
    """Return the table of methods under one rule."""
    rows = _rows(*RIVALS_FILES)
    return arms_table(RIVALS, rows, _rows(STEPS_FILE), _names(rows), above=False) + _sources(*RIVALS_FILES, STEPS_FILE)


def ladder() -> str:
    """Return the table of the method's steps from plain 3DGS, each beside the one above it."""
    rows = _rows(LADDER_FILE)
    return arms_table(LADDER, rows, _rows(STEPS_FILE), _names(rows), above=True) + _sources(LADDER_FILE)
