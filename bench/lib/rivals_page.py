"""The generated parts of docs/results.md on rivals and on the ladder."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path

from bench.lib import result_file
from bench.lib.arms import LADDER, RIVALS, Arm, chosen_steps, steps_in
from bench.lib.preset_table import by_seed
from bench.lib.scenes import ROWS
from bench.lib.tables import markdown, mean_sd
from warpgs.pipeline.study.tables import family_confidence, paired_difference

SEEDS = 3
"""Fewest seeds of an interval."""


def preset_in(rows: list[dict], row: str, arm: Arm) -> str | None:
    """Return the preset that an arm has on a row, with the chosen steps; None where it was not measured."""
    held_out = {r["preset"] for r in rows if r["row"] == row and not r.get("left_out") and "error" not in r}
    if arm.steps and not any(arm.with_steps(n) in held_out for n in arm.steps):
        return None
    preset = arm.with_steps(chosen_steps(rows, row, arm)) if arm.steps else arm.preset
    return preset if preset in held_out else None


def rows_of(rows: list[dict]) -> list[str]:
    """Return the names of the rows of results: those that have a name in their order, then others."""
    found = dict.fromkeys(r["row"] for r in rows)
    return [*(n for n in ROWS if n in found), *sorted(found.keys() - ROWS.keys())]


def scene_of(name: str) -> str:
    """Return the scene of a row for a heading: fern of fern:3, room of llff/room@llff:3."""
    return Path(name.partition("@")[0]).name.partition(":")[0]


def arms_table(arms: Sequence[Arm], rows: list[dict], names: Sequence[str], above: bool) -> str:
    """Return PSNR and SSIM of each arm on each row, its steps, the difference in PSNR to the base, and published scores."""
    held_out = [r for r in rows if not r.get("left_out")]
    found, confidence, body = by_seed(held_out), family_confidence(len(arms) - 1), []
    published = any(arm.published for arm in arms)
    for place, arm in enumerate(arms):
        body.append([arm.words])
        for name in names:
            preset = preset_in(rows, name, arm)
            if preset is None:
                body[-1] += ["", "", ""]
                continue
            own = found[name, preset]
            base = arms[place - 1] if above else arms[0]
            theirs = found.get((name, preset_in(rows, name, base) or ""), {}) if place else {}
            seeds = sorted(own.keys() & theirs.keys())
            d = paired_difference([own[s]["psnr"] for s in seeds], [theirs[s]["psnr"] for s in seeds], confidence)
            change = (
                f"{d.mean:+.2f} [{d.low:+.2f}, {d.high:+.2f}]" if len(seeds) >= SEEDS else f"{d.mean:+.2f}" if seeds else ""
            )
            count = "" if len(own) == max(len(s) for s in found.values()) else f" ({len(own)} seed{'s' * (len(own) > 1)})"
            score = " / ".join(f"{statistics.mean(r[k] for r in own.values()):.{n}f}" for k, n in (("psnr", 2), ("ssim", 3)))
            body[-1] += [f"{steps_in(preset):,}", score + count, change]
        if published:
            body[-1].append(
                "" if arm.published is None else f"{arm.published[0]:.2f} / {arm.published[1]:.3f}, {arm.published[2]}"
            )
    scenes = [scene_of(name) for name in names]
    head = [heading for s in scenes for heading in (f"{s}: steps", "PSNR / SSIM", "change" if above else "difference")]
    head += ["published, LLFF of 3 views"] * published
    return markdown(["step" if above else "method", *head], body, ["step" if above else "method"])


def _page_table(name: str, arms: Sequence[Arm], above: bool) -> str:
    """Return the table of the kept results of a set, by machine; where there are none, the command that makes them."""
    tables = []
    for machine, result in result_file.stored(name).items():
        rows = result["rows"]
        names = rows_of(rows)
        measured = [arm for arm in arms if any(preset_in(rows, n, arm) for n in names)]
        tables.append(arms_table(measured, rows, names, above) + "\n" + result_file.source(f"{name}_{machine}"))
    command = f"python -m bench.fits.rivals DATA --rows fern:3 horns:3 --set {name} --out FILE"
    return "\n".join(tables) or f"Not measured yet: `{command}`.\n"


def rivals() -> str:
    """Return the table of methods under one rule."""
    return _page_table("rivals", RIVALS, above=False)


def ladder_of_default() -> str:
    """Return the table of the method's steps from plain 3DGS, each beside the one above it."""
    return _page_table("ladder", LADDER, above=True)


def other_steps_table(arms: Sequence[Arm], rows: list[dict], names: Sequence[str]) -> str:
    """Return held-out PSNR of the arms with numbers of steps that were not chosen; arguments are those of `arms_table`."""
    found, body = by_seed([r for r in rows if not r.get("left_out")]), []
    for name in names:
        first = found.get((name, preset_in(rows, name, arms[0]) or ""), {})
        for arm in arms:
            for preset in (arm.with_steps(n) for n in arm.steps):
                own = found.get((name, preset))
                if own and preset != preset_in(rows, name, arm):
                    psnr = [r["psnr"] for r in own.values()]
                    body.append([scene_of(name), arm.words, f"{steps_in(preset):,}", f"{mean_sd(psnr)} ({len(psnr)} seeds)"])
                    seeds = sorted(own.keys() & first.keys())
                    body[-1].append(
                        f"{statistics.mean(own[s]['psnr'] - first[s]['psnr'] for s in seeds):+.2f}" if seeds else ""
                    )
    head = ["scene", "method", "steps", "PSNR", "difference"]
    return markdown(head, body, ["scene", "method"])


def other_steps() -> str:
    """Return the table of the kept results of rivals with numbers of steps that were not chosen."""
    tables = []
    for machine, result in result_file.stored("rivals").items():
        rows = result["rows"]
        names = rows_of(rows)
        table = other_steps_table(RIVALS, rows, names)
        if len(table.splitlines()) > 2:  # more than the heading
            tables.append(table + f"\nSource: `rivals_{machine}.json`.\n")
    return "\n".join(tables)
