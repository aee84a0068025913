"""The generated parts of docs/results.md but rivals and ladder, and what the importance scores gain, of docs/method.md."""

from __future__ import annotations

import statistics
from collections.abc import Sequence

from bench.lib import result_file
from bench.lib.arms import SCORES
from bench.lib.preset_table import by_seed
from bench.lib.tables import markdown, mean_sd
from warpgs.pipeline.study.tables import family_confidence, paired_difference

ABLATED = {
    "no events": "no sampling events",
    "no agp": "pixels of highest importance",
    "no ra": "pixels without consistent depth too",
    "no hier": "one layer",
    "no s_render": "no residual in the importance",
    "no s_semantic": "no semantics in the importance",
    "no s_geometry": "no geometry in the importance",
    "no pm": "no protection of new Gaussians",
}
"""Rows of the ablation in the words of the page."""
CAPTURES = {
    "fern:3": ("fern", 3), "fern:6": ("fern", 6), "fern:9": ("fern", 9), "fern:17": ("fern", 17),
    "horns:3": ("horns", 3), "horns:6": ("horns", 6), "horns:9": ("horns", 9), "horns:54": ("horns", 54),
    "fox:8": ("fox", 8), "fox:all": ("fox", 43), "temple:4": ("temple", 4), "temple:12": ("temple", 12),
}  # fmt: skip
"""Scene and number of training views of each row of the presets' result."""
PRESETS = ("default", "quick", "3dgs", "gsplat")
UNTOUCHED = {
    "flower@llff:3": "flower, 3", "fortress@llff:3": "fortress, 3", "dino@llff:4": "dino, 4",
    "lego@blender:8@2": "lego, 8", "mic@blender:8@2": "mic, 8",
}  # fmt: skip
"""Rows of the scenes that chose no setting, in the words of the page; two others of the result have since."""
SCORED = {
    "`fern`, 3 photographs": ("ladder_h200", "fern:3"),
    "`horns`, 3": ("ladder_h200", "horns:3"),
    "`fox`, 8": ("importance_scores_h200", "fox:8"),
    "`temple`, 4": ("importance_scores_h200", "temple:4"),
    "synthetic objects, 8 (before smooth depth)": ("importance_objects_h200", None),
}
"""Result file and row of each scene; the fits of objects differ in the object instead of the seed."""


def table(head: Sequence[str], rows: list[list[str]]) -> str:
    """Return a Markdown table: the first column to the left, the others to the right."""
    return markdown(head, rows, head[:1])


def _result(name: str) -> tuple[dict, str]:
    return result_file.read(result_file.FOLDER / f"{name}.json"), "\n" + result_file.source(name)


def _scores(rows: list[dict]) -> str:
    return f"{mean_sd([r['psnr'] for r in rows])} / {statistics.mean(r['ssim'] for r in rows):.3f}"


def _change(own: dict[int, dict], base: dict[int, dict], key: str, digits: int) -> str:
    """Return the mean difference over the seeds that both have, with its 95 % interval; words where no seed differs."""
    seeds = sorted(own.keys() & base)
    if all(own[s][key] == base[s][key] for s in seeds):
        return "not exercised"
    d = paired_difference([own[s][key] for s in seeds], [base[s][key] for s in seeds])
    return f"{d.mean:+.{digits}f} [{d.low:+.{digits}f}, {d.high:+.{digits}f}]"


def ablation() -> str:
    """Return the table of the method with one part off: means over both scenes, differences to the full method by seed."""
    result, source = _result("ablation_llff3_h200")
    scores: dict[str, dict[int, dict]] = {}
    for variant in ("full", *ABLATED):
        rows = [r for r in result["rows"] if r["variant"] == variant]
        scores[variant] = {
            seed: {k: statistics.mean(r[k] for r in rows if r["seed"] == seed) for k in ("psnr", "ssim")}
            for seed in {r["seed"] for r in rows}
        }
    body = [["retired preset `paper`", _scores(list(scores["full"].values())), ""]]
    for variant, words in ABLATED.items():
        own = scores[variant]
        body.append([words, _scores(list(own.values())), _change(own, scores["full"], "psnr", 2)])
    return table(["part that is off", "PSNR / SSIM", "change in PSNR"], body) + source


def views() -> str:
    """Return the table of held-out scores by scene and preset, `default` from its own run; empty cells were not measured."""
    (others, source), (own, own_source) = _result("presets_h200"), _result("default_h200")
    found = by_seed(others["rows"]) | by_seed(own["rows"])
    body = []
    for name, (scene, count) in CAPTURES.items():
        rows = [list(found.get((name, preset), {}).values()) for preset in PRESETS]
        cells = (_scores(r) if r else "" for r in rows)
        body.append([f"{scene}, {count}", *cells])
    head = ["scene, views", *(f"`{p}`" for p in PRESETS[:-1]), f"gsplat {others['versions']['gsplat']}"]
    return table(head, body) + own_source + source


def untouched() -> str:
    """Return the table of scenes that chose no setting of their commit, by preset."""
    result, source = _result("untouched_h200")
    found = by_seed(result["rows"])
    body = [
        [words, *(_scores(list(found[name, p].values())) if (name, p) in found else "" for p in PRESETS)]
        for name, words in UNTOUCHED.items()
    ]
    return table(["scene, views", *(p if p == "gsplat" else f"`{p}`" for p in PRESETS)], body) + source


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
        body.append([words, len(d.values), *means, f"{mean:+.2f} [{d.low:+.2f}, {d.high:+.2f}]"])
    head = ["scene", "fits", "sampled uniformly", "sampled by all three scores", "difference"]
    files = ", ".join(f"`{file}.json`" for file in dict.fromkeys(file for file, _ in SCORED.values()))
    note = "held-out PSNR [dB]; objects: over white"
    return markdown(head, body, head[:1]) + f"\nSources: {files}; {note}.\n"
