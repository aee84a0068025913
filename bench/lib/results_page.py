"""The generated parts of docs/results.md."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Callable, Sequence

from bench.lib import result_file, strategy_runs
from bench.lib.preset_table import by_seed
from bench.lib.scenes import ROWS
from bench.lib.tables import markdown, mean_sd
from warpgs.pipeline.study.tables import paired_difference

ABLATED = {
    "no events": "no sampling events: no placement, layers or protection",
    "no agp": "pixels of highest importance, not sampled ones",
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
PRESETS = ("default", "quick", "3dgs", "mcmc", "gsplat")
POSES = {
    "given": "given with the photographs",
    "joint": "found, held-out photographs included",
    "aligned": "found from the training photographs alone",
}
PARITY, REPEATS = "parity_h200", "determinism_h100"
"""Results of the agreement with gsplat, and of the price of repeatable sums."""


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
    body = [["full method", _scores(list(scores["full"].values())), "", ""]]
    for variant, words in ABLATED.items():
        own = scores[variant]
        changes = [_change(own, scores["full"], key, digits) for key, digits in (("psnr", 2), ("ssim", 3))]
        body.append([words, _scores(list(own.values())), *changes])
    return table(["part that is off", "PSNR / SSIM", "change in PSNR", "change in SSIM"], body) + source


def views() -> str:
    """Return the table of held-out scores by scene and preset, `default` from its own run; empty cells were not measured."""
    (others, source), (own, own_source) = _result("presets_h200"), _result("default_h200")
    found = by_seed(others["rows"]) | by_seed(own["rows"])
    body = []
    for name, (scene, count) in CAPTURES.items():
        rows = [list(found.get((name, preset), {}).values()) for preset in PRESETS]
        cells = (_scores(r) if r else "" for r in rows)
        body.append([f"{scene}, {count}", f"`{ROWS[name].split}`", f"{len(rows[0])}", *cells])
    heads = [*(f"`{p}`" for p in PRESETS[:-1]), f"gsplat {others['versions']['gsplat']}"]
    head = ["scene, views", "split", "seeds of `default`", *heads]
    return markdown(head, body, head[:2]) + own_source + source


def coverage() -> str:
    """Return the tables of pixels and errors by how many training views saw them, and of pixels unseen before and now."""
    result, source = _result("coverage_h200")
    body = []
    for scene in ("fern:3", "horns:3"):
        for seen, words in (("0", "no view"), ("1", "one"), ("2+", "two or more")):
            own = [r["classes"][seen] for r in result["rows"] if (r["row"], r["preset"]) == (scene, "default")]
            shares = (statistics.mean(c[k] for c in own) for k in ("share_of_pixels", "share_of_error"))
            psnr = mean_sd([c["psnr"] for c in own])
            body.append([f"{scene.replace(':', ', ')}: {words}", *(f"{100 * share:.0f} %" for share in shares), psnr])
    both = []
    for scene in ("fern:3", "horns:3"):
        own = [r for r in result["unseen_in_both"] if r["row"] == scene]
        share = f"{100 * statistics.mean(r['share_of_pixels'] for r in own):.0f} %"
        both.append([scene.replace(":", ", "), share, *(mean_sd([r[k] for r in own]) for k in ("before", "after"))])
    seen = table(["scene, views: pixels seen by", "pixels", "squared error", "PSNR"], body)
    return f"{seen}\n{table(['unseen in both fits', 'pixels', 'earlier `default`: PSNR', '`default`: PSNR'], both)}{source}"


def strategies() -> str:
    """Return the table of gsplat's strategies on its rasterizer and on ours with rule `exact`."""
    result, source = _result("strategies_fern_h200")
    return strategy_runs.table([r for r in result["rows"] if r["rasterizer"] != "gsplat-1.6"]) + source


def poses() -> str:
    """Return the table of the cost of found poses."""
    result, source = _result("found_poses_fern_cpu2")
    rows = {(r["poses"], r["train"]): r for r in result["rows"]}
    counts = sorted({r["train"] for r in result["rows"]})
    keys = {"psnr": "", "psnr_cameras_refined": ", cameras refined"}
    body = [[words, *(mean_sd(rows[kind, n][key]) for n in counts for key in keys)] for kind, words in POSES.items()]
    return table(["poses", *(f"{n} training photographs{more}" for n in counts for more in keys.values())], body) + source


def same_image() -> str:
    """Return the table of the agreement with gsplat on its largest images."""
    result, source = _result(PARITY)
    width, body = max(r["width"] for r in result["rows"]), []
    for r in result["rows"]:
        if r["width"] == width:
            worst = max(g["rel_l2"] for g in r["gradients"].values())
            differences = (r["image_mean"], r["image_max"], worst)
            body.append([r["case"], *(f"{d:.1e}" for d in differences), r["differs"]])
    head = ["case", "mean difference", "largest", "gradients: largest relative L2", "differs by definition"]
    return table(head, body) + source


def antialiasing() -> str:
    """Return the table of scores at three sizes by the filters of a fit, as differences to a fit without."""
    result, source = _result("antialiased_fern_h200")
    found: dict[tuple[str, str], dict[int, dict]] = defaultdict(dict)
    for r in result["rows"]:
        found[r["split"], r["filters"]][r["seed"]] = r
    body = []
    for (split, filters), own in found.items():
        cells = [f"{split}, {filters}", f"{len(own)}"]
        for size in ("half", "full", "double"):
            key, base = f"psnr_{size}", found[split, "none"]
            cells.append(mean_sd([r[key] for r in own.values()]) if own is base else _change(own, base, key, 2))
        body.append(cells)
    return table(["views, filters", "fits", "half size", "size of the photos", "double size"], body) + source


def meshes() -> str:
    """Return the table of the accuracy of meshes."""
    result, source = _result("demo_mesh_cpu2")
    body = []
    for r in sorted((r for r in result["rows"] if r["row"] == "mesh"), key=lambda r: -r["voxel"]):
        if r["depth"] == "median":
            cells = [f"{r['voxel']:.2g}", f"{r['triangles']:,}"]
            body.append(cells + [f"{100 * r[k]:.2f} %" for k in ("accuracy_mean_of_radius", "completeness_mean_of_radius")])
    return table(["voxel", "triangles", "accuracy", "completeness"], body) + source


def repeats() -> str:
    """Return the table of the price of sums in a fixed order, and of the spread of atomic ones."""
    result, source = _result(REPEATS)
    body = []
    for r in result["rows"]:
        times = [f"{r['price'][mode]['median_ms']:.2f}" for mode in ("deterministic", "atomic")]
        ulps = max(s["max_ulp"] for s in r["spread"].values())
        body.append([f"{r['gaussians']:,}, {r['width']} x {r['height']}", *times, f"{ulps:,}"])
    return table(["Gaussians, image", "fixed order [ms]", "atomic [ms]", "largest difference [ulp]"], body) + source


PARTS: tuple[Callable[[], str], ...] = (
    ablation, views, coverage, strategies, poses, same_image, antialiasing, meshes, repeats,
)  # fmt: skip


def parts() -> dict[str, str]:
    """Return the generated parts of docs/results.md by name."""
    return {part.__name__.replace("_", " "): part() for part in PARTS}
