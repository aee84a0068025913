"""The generated parts of docs/results.md."""

from __future__ import annotations

import statistics
from collections import defaultdict
from collections.abc import Callable, Sequence

from bench.lib import result_file, strategy_runs
from bench.lib.preset_table import by_seed
from bench.lib.scenes import ROWS
from bench.lib.tables import markdown, mean_sd
from warpgs.pipeline.study.statistics import paired_difference

RUNGS = (
    ("3dgs", "", "`3dgs`, random points"),
    ("3dgs sweep 8 px", "3dgs", "+ start from the depth sweep"),
    ("strong-3dgs", "3dgs sweep 8 px", "+ dropout, with the method's learning rates, degree and schedule"),
    ("paper", "strong-3dgs", "+ placement by importance"),
)
"""Presets of the ladder, the preset below each, and words."""
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
ONE_LAYER = "default:method.hier=false,optimizer.opacities_decay=0.001"
"""`default` with up to 9 views with alpha, as it was measured before it became so."""
PRESETS = ("default", "quick", "3dgs", "mcmc", "gsplat")
POSES = {
    "given": "given with the photographs",
    "joint": "found, held-out photographs included",
    "aligned": "found from the training photographs alone",
}
MCMC = {
    "warpgs mcmc": "preset `mcmc`",
    "gsplat mcmc": "gsplat's MCMC, our scene units",
    "gsplat mcmc, own units": "gsplat's MCMC, units of its parser",
    "warpgs 3dgs": "preset `3dgs`, which sets the cap",
}
PARITY, REPEATS = "parity_h200", "determinism_h100"
"""Results of the agreement with gsplat, and of the price of repeatable sums."""
MODES = {
    "deterministic": "ours, fixed order",
    "atomic": "ours, atomic",
    "naive atomic": "naive kernels, atomic",
    "naive, Warp's run to run": "naive kernels, `RUN_TO_RUN`",
    "naive, Warp's GPU to GPU": "naive kernels, `GPU_TO_GPU`",
}
"""Ways to sum gradients, in words."""


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


def ladder() -> str:
    """Return the table of the method's steps from plain 3DGS, each beside the one below it."""
    result, source = _result("presets_llff3_h200")
    found: dict[tuple, dict[int, dict]] = defaultdict(dict)
    for r in result["rows"]:
        found[r["scene"], r["preset"]][r["seed"]] = r
    body = []
    for preset, below, words in RUNGS:
        body.append([words])
        for scene in ("fern", "horns"):
            own, base = found[scene, preset], found[scene, below]
            body[-1] += [_scores(list(own.values())), _change(own, base, "psnr", 2) if base else ""]
    return table(["step", "fern", "change in PSNR", "horns", "change in PSNR"], body) + source + "\n" + placement_again()


def placement_again() -> str:
    """Return the last step of the ladder as another run has it."""
    lines = []
    for scene in ("fern", "horns"):
        result, source = _result(f"compare_{scene}_llff3_h200")
        own, base = ({r["seed"]: r for r in result["rows"] if r["variant"] == name} for name in ("paper", "strong-3dgs"))
        lines.append(f"Placement on `{scene}` in another run: {_change(own, base, 'psnr', 2)} dB. {source.strip()}\n")
    return "\n".join(lines)


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
    """Return the table of held-out scores by scene, number of training views and preset; empty cells were not measured."""
    result, source = _result("presets_h200")
    found, body = by_seed(result["rows"]), []
    for name, (scene, count) in CAPTURES.items():
        own = [list(found.get((name, preset), {}).values()) for preset in PRESETS]
        body.append([f"{scene}, {count}", f"`{ROWS[name].split}`", *(_scores(rows) if rows else "" for rows in own)])
    heads = [*(f"`{p}`" for p in PRESETS[:-1]), f"gsplat {result['versions']['gsplat']}"]
    return markdown(["scene, views", "split", *heads], body, ["scene, views", "split"]) + source


def default_now() -> str:
    """Return the table of `default` beside its scores in the table of all presets, which is older."""
    result, source = _result("default_h200")
    old, new = (by_seed(r["rows"]) for r in (_result("presets_h200")[0], result))
    body = []
    for row, (scene, count) in CAPTURES.items():
        own = new.get((row, "default"))
        if own:
            before, now = (list(of.values()) for of in (old[row, "default"], own))
            change = statistics.mean(r["psnr"] for r in now) - statistics.mean(r["psnr"] for r in before)
            body.append([f"{scene}, {count}", str(len(now)), _scores(before), _scores(now), f"{change:+.2f}"])
    return table(["scene, views", "seeds", "before", "`default`", "change in PSNR"], body) + source


def coverage() -> str:
    """Return the tables of pixels and errors by how many training views saw them, and of pixels unseen in both fits."""
    result, source = _result("coverage_h200")
    before, body = result["rows"][0]["preset"], []
    for scene in ("fern:3", "horns:3"):
        for seen, words in (("0", "no view"), ("1", "one"), ("2+", "two or more")):
            body.append([f"{scene.replace(':', ', ')}: {words}"])
            for preset in (before, "default"):
                own = [r["classes"][seen] for r in result["rows"] if (r["row"], r["preset"]) == (scene, preset)]
                body[-1] += [f"{100 * statistics.mean(c[k] for c in own):.0f} %" for k in ("share_of_pixels", "share_of_error")]
                body[-1].append(mean_sd([c["psnr"] for c in own]))
    head = [
        "scene, views: pixels seen by",
        "before: pixels",
        "error",
        "PSNR",
        "`default`: pixels",
        "error",
        "PSNR",
    ]
    unseen = []
    for scene in ("fern:3", "horns:3"):
        own = [r for r in result["unseen_in_both"] if r["row"] == scene]
        share = 100 * statistics.mean(r["share_of_pixels"] for r in own)
        scores = [mean_sd([r[k] for r in own]) for k in ("before", "after")]
        unseen.append([scene.replace(":", ", "), f"{share:.0f} %", *scores])
    both = table(["scene, views: unseen in both fits", "pixels", "before: PSNR", "`default`: PSNR"], unseen)
    return table(head, body) + "\n" + both + source


def mcmc() -> str:
    """Return the table of MCMC beside gsplat's."""
    result, source = _result("mcmc_h200")
    body = []
    for program, words in MCMC.items():
        rows = [r for r in result["rows"] if r["program"] == program]
        body.append([words, _scores(rows), f"{statistics.mean(r['gaussians'] for r in rows):,.0f}"])
    return table(["program", "PSNR / SSIM", "Gaussians"], body) + source


def strategies() -> str:
    """Return the table of gsplat's strategies on its rasterizer and on ours."""
    result, source = _result("strategies_fern_h200")
    return strategy_runs.table(result["rows"]) + source


def objects() -> str:
    """Return the table on objects cut out: by the format of the scene, and with one layer beside two on the same objects."""
    result, source = _result("objects_h200")
    body = [[form, *_object_cells([r for r in result["rows"] if r["format"] == form])] for form in ("transforms", "colmap")]
    head = ["PSNR over white", "alpha in the object", "alpha outside"]
    by_format = table(["scene format", *head], body) + source
    result, source = _result("one_layer_objects_h100")
    one = {r["object"]: r for r in result["rows"] if r["preset"] == ONE_LAYER}
    two = {r["object"]: r for r in result["rows"] if r["preset"] == "default" and r["object"] in one}
    body = [[words, str(len(of)), *_object_cells(list(of.values()))] for words, of in (("two", two), ("one: `default`", one))]
    layers = table(["layers", "objects", *head], body) + source
    result, source = _result("importance_objects_h200")
    own = [r for r in result["rows"] if r["preset"] == "default"]
    seeds = sorted(r["object"] for r in own)
    now = [[f"{len(seeds)}, seeds {seeds[0]} to {seeds[-1]}", *_object_cells(own)]]
    return "\n".join((by_format, layers, table(["`default`: objects", *head], now) + source))


def _object_cells(rows: list[dict]) -> list[str]:
    psnr, alpha, empty = (statistics.mean(r[k] for r in rows) for k in ("psnr_white", "alpha_object", "alpha_empty"))
    return [f"{psnr:.2f}", f"{alpha:.4f}", f"{empty:.4f}"]


def poses() -> str:
    """Return the table of the cost of found poses."""
    result, source = _result("found_poses_fern_cpu2")
    rows = {(r["poses"], r["train"]): r for r in result["rows"]}
    counts = sorted({r["train"] for r in result["rows"]})
    body = [[words, *(mean_sd(rows[kind, n]["psnr"]) for n in counts)] for kind, words in POSES.items()]
    return table(["poses", *(f"{n} training photographs" for n in counts)], body) + source


def same_image() -> str:
    """Return the table of the agreement with gsplat."""
    result, source = _result(PARITY)
    body = []
    for r in result["rows"]:
        worst = max(g["rel_l2"] for g in r["gradients"].values())
        size, differences = f"{r['case']}, {r['width']} x {r['height']}", (r["image_mean"], r["image_max"], worst)
        body.append([size, *(f"{d:.1e}" for d in differences), r["differs"]])
    head = ["case, image", "mean difference", "largest", "gradients: largest relative L2", "differs by definition"]
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
    result, source = _result("mesh_cpu2")
    body = []
    for r in sorted((r for r in result["rows"] if r["row"] == "mesh"), key=lambda r: -r["voxel"]):
        if r["depth"] == "median":
            cells = [f"{r['voxel']:.2g}", f"{r['triangles']:,}"]
            body.append(cells + [f"{100 * r[k]:.2f} %" for k in ("accuracy_mean_of_radius", "completeness_mean_of_radius")])
    return table(["voxel", "triangles", "accuracy", "completeness"], body) + source


def repeats() -> str:
    """Return the table of the price of sums in a fixed order, ours and Warp's, and of the spread of atomic ones."""
    result, source = _result(REPEATS)
    body = []
    for r in result["rows"]:
        size = f"{r['gaussians']:,}, {r['width']} x {r['height']}"
        ulps = max((s["max_ulp"] for s in r["spread"].values()), default=0)
        for mode, price in r["price"].items():
            if "reason" in price:
                body.append([size, MODES[mode], "", price["reason"], ""])
                continue
            differ = price["repeats_that_differ"]
            bits = "same" if differ == 0 else f"{differ} of 9 differ"
            body.append([size, MODES[mode], f"{price['median_ms']:.2f}", bits, f"{ulps:,}" if mode == "atomic" else ""])
    return table(["Gaussians, image", "sums", "wall [ms]", "bits of repeats", "largest [ulp]"], body) + source


PARTS: tuple[Callable[[], str], ...] = (
    ladder, ablation, views, default_now, coverage, mcmc, strategies, objects, poses, same_image, antialiasing,
    meshes, repeats,
)  # fmt: skip


def parts() -> dict[str, str]:
    """Return the generated parts of docs/results.md by name."""
    return {part.__name__.replace("_", " "): part() for part in PARTS}
