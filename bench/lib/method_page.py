"""The generated parts of docs/method.md: where fine Gaussians are placed, and what an oracle and the paper's scores gain."""

from __future__ import annotations

import math

from bench.lib import result_file
from bench.lib.arms import SCORES
from bench.lib.tables import markdown, mean_sd
from warpgs.pipeline.study.tables import family_confidence, paired_difference

RESULT = "importance_h200"
ARMS = {
    "own/default:method.events=false": "none",
    "uniform+log/default": "at pixels with consistent depth, sampled uniformly",
    "residual/default": "at these pixels, sampled by the residual",
    "warped/default": "at these pixels, sampled by the gain, as built in",
    "oracle gain/default": "at these pixels, sampled by the gain in the third photograph itself (an oracle)",
}
"""Arms of the study in words."""
SCENES = ("fern", "horns")


def placement() -> str:
    """Return the table of scores of the photograph left out, the mean of three, by where fine Gaussians are placed."""
    rows, body = result_file.read(result_file.FOLDER / f"{RESULT}.json")["rows"], []
    for preset, words in ARMS.items():
        body.append([words])
        for scene in SCENES:
            own = [r for r in rows if r["row"] == f"{scene}:3" and r["preset"] == preset]
            psnr, ssim = (math.fsum(r[k] for r in own) / len(own) for k in ("psnr", "ssim"))
            body[-1].append(f"{psnr:.2f} / {ssim:.3f}")
    head = ["fine Gaussians", *(f"`{scene}`" for scene in SCENES)]
    return markdown(head, body, head[:1]) + f"\nSource: `{RESULT}.json`; means of three photographs left out, one seed.\n"


SCORED = {
    "`fern`, 3 photographs": ("ladder_h200", "fern:3"),
    "`horns`, 3": ("ladder_h200", "horns:3"),
    "`fox`, 8": ("importance_scores_h200", "fox:8"),
    "`temple`, 4": ("importance_scores_h200", "temple:4"),
    "synthetic objects, 8 (before smooth depth)": ("importance_objects_h200", None),
}
"""Result file and row of each scene; the fits of objects differ in the object instead of the seed."""


def _psnr(rows: list[dict], name: str | None, preset: str) -> dict[int, float]:
    """Return held-out PSNR by seed, or by object if there is no row name."""
    if name is None:
        return {r["object"]: r["psnr_white"] for r in rows if r["preset"] == preset}
    return {r["seed"]: r["psnr"] for r in rows if (r["row"], r["preset"], r["left_out"]) == (name, preset, "")}


def scores() -> str:
    """Return the table of `default` with all three importance scores beside `default`, paired."""
    body, confidence = [], family_confidence(len(SCORED))
    for words, (file, name) in SCORED.items():
        rows = result_file.read(result_file.FOLDER / f"{file}.json")["rows"]
        uniform, scored = (_psnr(rows, name, preset) for preset in ("default", f"default:{SCORES}"))
        pairs = sorted(uniform.keys() & scored.keys())
        d = paired_difference([scored[k] for k in pairs], [uniform[k] for k in pairs], confidence)
        means = [mean_sd([values[k] for k in pairs]) for values in (uniform, scored)]
        mean = round(d.mean, 2) + 0.0  # not -0.00
        body.append([words, d.count, *means, f"{mean:+.2f} [{d.low:+.2f}, {d.high:+.2f}]"])
    head = ["scene", "fits", "sampled uniformly", "sampled by all three scores", "difference"]
    files = ", ".join(f"`{file}.json`" for file in dict.fromkeys(file for file, _ in SCORED.values()))
    note = "held-out PSNR [dB]; objects: over white, and measured before `default` smoothed depth with 8 views"
    return markdown(head, body, head[:1]) + f"\nSources: {files}; {note}.\n"
