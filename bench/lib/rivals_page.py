"""The generated parts of docs/results.md on rivals and on the ladder."""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from pathlib import Path

from bench.lib import result_file
from bench.lib.arms import DTU, LADDER, PAPERS, RERUNS, Arm, chosen_steps
from bench.lib.preset_table import by_seed
from bench.lib.scenes import ROWS, row_of
from bench.lib.tables import markdown
from warpgs.pipeline.study.tables import family_confidence, paired_difference

SEEDS = 3
"""Fewest seeds of an interval."""
REPRODUCED = 0.4
"""Largest loss of PSNR against the authors' own code [dB] at which a method counts as reproduced."""


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


def headings(names: Sequence[str]) -> list[str]:
    """Return a short name of each row: its scene, or its split where all have one scene."""
    scenes = [scene_of(name) for name in names]
    return scenes if len(set(scenes)) > 1 or len(names) == 1 else [row_of(name).split for name in names]


def arms_table(arms: Sequence[Arm], rows: list[dict], names: Sequence[str], above: bool) -> str:
    """Return PSNR and SSIM of each arm on each row, its steps, and the difference in PSNR to the base."""
    held_out = [r for r in rows if not r.get("left_out")]
    found, confidence, body = by_seed(held_out), family_confidence(len(arms) - 1), []
    usual = statistics.mode(len(seeds) for (name, _), seeds in found.items() if name in names)
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
            count = "" if len(own) == usual else f" ({len(own)} seed{'s' * (len(own) > 1)})"
            score = " / ".join(f"{statistics.mean(r[k] for r in own.values()):.{n}f}" for k, n in (("psnr", 2), ("ssim", 3)))
            body[-1] += [f"{statistics.mean(r['steps'] for r in own.values()):,.0f}", score + count, change]
    head = [h for s in headings(names) for h in (f"{s}: steps", "PSNR / SSIM", "change" if above else "difference")]
    return markdown(["step" if above else "method", *head], body, ["step" if above else "method"])


def _stored(kind: str) -> dict[str, dict]:
    """Return the kept results of a kind by machine, without those of kinds with a longer name."""
    return {machine: values for machine, values in result_file.stored(kind).items() if "_" not in machine}


def _page_table(name: str, arms: Sequence[Arm], above: bool, command: str = "", width: int = 2) -> str:
    """Return tables of the kept results of a set, ``width`` rows of scenes in each; where there are none, the command."""
    tables = []
    for machine, result in _stored(name).items():
        rows = result["rows"]
        names = rows_of(rows)
        parts = [names[i : i + width] for i in range(0, len(names), width)]
        for part in parts:
            shown = [arm for arm in arms if any(preset_in(rows, n, arm) for n in part)]
            tables.append(arms_table(shown, rows, part, above))
        tables.append(result_file.source(f"{name}_{machine}"))
    command = command or f"--rows fern:3 horns:3 --set {name}"
    return "\n".join(tables) or f"Not measured yet: `python -m bench.fits.rivals DATA {command} --out FILE`.\n"


def papers() -> str:
    """Return the table of the methods of papers."""
    command = "--rows fern:3 horns:3 llff/room@llff:3 llff/trex@llff:3 --set papers"
    return _page_table("rivals_papers", PAPERS, above=False, command=command)


def dtu() -> str:
    """Return the table of an object of DTU."""
    command = "--rows dtu_scan37@dtu:3@4 dtu_scan37@dtu:6@4 dtu_scan37@dtu:9@4 --set dtu"
    return _page_table("rivals_dtu", DTU, above=False, command=command, width=3)


def reruns_table(arms: Sequence[Arm], rows: list[dict], names: Sequence[str]) -> str:
    """Return what the authors' code reached on our scenes, in PSNR and SSIM, and the distance of ours in PSNR."""
    held_out, body = by_seed([r for r in rows if not r.get("left_out")]), []
    for arm in (a for a in arms if a.words in RERUNS):
        body.append([arm.words])
        distances = []
        for name in names:
            theirs, preset = RERUNS[arm.words][scene_of(name)], preset_in(rows, name, arm)
            if preset:
                distances.append(statistics.mean(r["psnr"] for r in held_out[name, preset].values()) - theirs[0])
            body[-1] += [f"{theirs[0]:.2f} / {theirs[1]:.3f}", f"{distances[-1]:+.2f}" if preset else ""]
        lost = min(distances, default=0) < -REPRODUCED
        body[-1].append("not reproduced" if lost else "reproduced" if distances else "")
    head = ["method", *(h for n in names for h in (f"{scene_of(n)}: authors' code", "ours")), ""]
    return markdown(head, body, head[:1])


def reruns() -> str:
    """Return the table of scores of the authors' code beside those of the plug-ins."""
    stored = list(_stored("rivals_papers").values())
    return reruns_table(PAPERS, stored[0]["rows"] if stored else [], ["fern:3", "horns:3"])


def ladder_of_default() -> str:
    """Return the table of the method's steps from plain 3DGS, each beside the one above it."""
    return _page_table("ladder", LADDER, above=True)
