"""The page docs/measured.md, accuracy and speed in short, from bench/results; the same results give the same bytes."""

from __future__ import annotations

import statistics

from bench.lib import result_file
from bench.lib.preset_table import by_seed
from bench.lib.tables import figure, markdown, mean_sd

CAPTURES = {
    "fern:3": ("fern", 3), "fern:6": ("fern", 6), "fern:9": ("fern", 9), "fern:17": ("fern", 17),
    "horns:3": ("horns", 3), "horns:6": ("horns", 6), "horns:9": ("horns", 9), "horns:54": ("horns", 54),
    "fox:8": ("fox", 8), "fox:all": ("fox", 43), "temple:4": ("temple", 4), "temple:12": ("temple", 12),
}  # fmt: skip
"""Scene and number of training views of each row of the presets' result."""
PRESETS = ("default", "quick", "3dgs", "mcmc", "gsplat")
POINTS = ((10_000, 504), (100_000, 504), (1_000_000, 504), (1_000_000, 1920))
"""Gaussians and widths [px] of the table of times."""
POSES = {
    "given": "given with the photographs",
    "joint": "found, held-out photographs among them",
    "aligned": "found of the training photographs alone",
}
HEAD = """# How accurate, how fast

Written by `python -m bench.document` from the files in `bench/results`, each of which holds its command, commit and
machine. "H200" is one NVIDIA H200; "2 cores" are two cores of a shared virtual machine without a GPU. Scenes: `fern` and
`horns` of LLFF, `fox` of instant-ngp, `temple` (`templeSparseRing`) of Middlebury, and the demo, which `warpgs demo` writes.
"""


def table(head: list[str], rows: list[list[str]]) -> str:
    """Return a Markdown table: the first column to the left, the others to the right."""
    return markdown(head, rows, head[:1])


def _only(kind: str, machine: str) -> dict:
    return result_file.stored(kind)[machine]


def _where(result: dict) -> str:
    name = "2 cores" if result["machine"]["device"] == "cpu" else result["machine"]["name"].removeprefix("NVIDIA ")
    return f"{name}, commit {result['commit'][:12]}"


def _range(counts: set[int]) -> str:
    return " to ".join(map(str, sorted({min(counts), max(counts)})))


def captures() -> str:
    """Return the table of held-out scores by scene, number of training views and preset; empty cells were not measured."""
    result = _only("presets", "h200")
    found, body, seeds = by_seed(result["rows"]), [], set()
    for name, (scene, views) in CAPTURES.items():
        cells = [scene, str(views)]
        for preset in PRESETS:
            own = list(found.get((name, preset), {}).values())
            seeds.add(len(own))
            ssim = f" / {statistics.mean(r['ssim'] for r in own):.3f}" if own else ""
            cells.append(mean_sd([r["psnr"] for r in own]) + ssim if own else "")
        body.append(cells)
    heads = [*(f"`{p}`" for p in PRESETS[:-1]), f"gsplat {result['versions']['gsplat']}"]
    words = table(["scene", "training views", *heads], body)
    older = {r["preset"]: r["commit"] for r in result["rows"] if "commit" in r}
    older = "".join(f" {preset}: commit {commit}." for preset, commit in older.items())
    return f"""## New views

Held-out photographs: PSNR [dB], mean and standard deviation over {_range(seeds - {0})} seeds, / SSIM. 504 x 378 px
(fox 270 x 480, temple 640 x 480 by its foreground). {_where(result)}. Settings were chosen on these scenes by leaving training
views out, but those of the first points, which were compared on three views with their held-out ones ([decision
007](decisions/007-coarse-start.md)). `gsplat` is that package's default strategy in 7000 steps, from the first points
of `default`.{older}

{words}
What `default` is and how it was chosen: [decision 013](decisions/013-any-capture.md). Synthetic scenes of smooth surfaces
whose points are exact, such as that of `warpgs demo`, are better with `3dgs` and `mcmc`. Other measurements, older commits,
ablations: [results](results.md).
"""


def objects() -> str:
    """Return the paragraph on objects cut out."""
    result = _only("objects", "h200")
    text = []
    for form in ("transforms", "colmap"):
        rows = [r for r in result["rows"] if r["format"] == form]
        psnr, alpha, empty = (statistics.mean(r[k] for r in rows) for k in ("psnr_white", "alpha_object", "alpha_empty"))
        text.append(f"{psnr:.2f} dB over white, alpha {alpha:.4f} in the object and {empty:.4f} outside ({form})")
    count, listed = len({r["object"] for r in result["rows"]}), ";\n".join(text)
    return f"""## Objects cut out

{count} synthetic objects of `warpgs demo --object`, 8 training views of 400 x 400 px, one fit each ({_where(result)}):
{listed}.
"""


def poses() -> str:
    """Return the table of what found poses cost."""
    result = _only("found_poses", "fern_cpu2")
    rows = {(r["poses"], r["train"]): r for r in result["rows"]}
    counts = sorted({r["train"] for r in result["rows"]})
    body = [[words, *(mean_sd(rows[kind, n]["psnr"]) for n in counts)] for kind, words in POSES.items()]
    return f"""## Photographs without cameras

Poses found by `warpgs poses`, then a fit with preset `quick`; fern at 126 x 94 px, held-out PSNR [dB] over three
seeds, by training views. {_where(result)}.

{table(["poses", *map(str, counts)], body)}
Causes, registration and times: [decision 017](decisions/017-poses-from-photos.md).
"""


def whole_fits() -> str:
    """Return the table of whole commands on two cores."""
    body = []
    for scene, words in (("fern", "fern, 3 views of 504 x 378 px"), ("temple", "temple, 12 views of 640 x 480 px")):
        rows = [r for r in _only("turns", f"{scene}_cpu2")["rows"] if r["side"] == "new"]
        middle = {key: statistics.median(r[key] for r in rows) for key in ("setup", "training", "wall", "psnr")}
        body.append([words, f"{rows[0]['steps']:,}", *(f"{middle[k]:.0f}" for k in ("setup", "training", "wall"))])
        body[-1].append(f"{middle['psnr']:.2f}")
    return f"""## A whole fit on two cores

`warpgs fit` with the default preset, kernels compiled before; other programs used the other two cores.

{table(["capture", "steps", "start [s]", "training [s]", "whole command [s]", "PSNR [dB]"], body)}
With nothing beside it a fit is faster; the first fit on a machine compiles kernels, too. Alone on an H200 the default
took 3 s to start and 11 s to train with 3 views of fern ([decision 013](decisions/013-any-capture.md)).
"""


def kernels() -> str:
    """Return the tables of rendering and training steps by size, and beside gsplat."""
    results, body = result_file.stored("ops"), []
    for count, width in POINTS:
        for machine in ("h200", "cpu2"):
            cells = []
            for op, direction in (("render", "forward"), ("render", "both"), ("step", "step")):
                times = [
                    r["median_ms"] for r in results[machine]["rows"]
                    if (r["op"], r["direction"], r["program"], r.get("N"), r.get("width"), r.get("degree")) ==
                    (op, direction, "warpgs", count, width, 3) and r.get("cameras", 1) == 1 and r.get("threads") in (None, 2)
                ]  # fmt: skip
                cells.append(figure(times[0]) if times else "")
            if any(cells):
                height = {504: 378, 1920: 1080}[width]
                body.append([f"{count:,}", f"{width} x {height}", {"h200": "H200", "cpu2": "2 cores"}[machine], *cells])
    sizes = table(["Gaussians", "image", "machine", "render [ms]", "with gradients [ms]", "training step [ms]"], body)
    gsplat, body = _only("gsplat", "h200"), []
    for r in gsplat["rows"]:
        ours, theirs, steps = r["wall_ms"]["warpgs"], r["wall_ms"]["gsplat dense"], r["step_wall_ms"]
        cells = [figure(t["median"]) for t in (ours, theirs, steps["warpgs graph"], steps["gsplat"])]
        body.append([r["configuration"].replace(" at ", ", ").replace("x", " x "), *cells])
    beside = table(["Gaussians, image", "warpgs [ms]", "gsplat [ms]", "step, warpgs [ms]", "step, gsplat + torch [ms]"], body)
    return f"""## Rendering and training steps

Medians of wall time of single calls with degree 3, from an idle device to an idle device; small sizes on the GPU are
bound by the launch of kernels, which a fit does not pay: it replays whole steps as CUDA graphs. Commits
{results["h200"]["commit"]} and {results["cpu2"]["commit"]}.

{sizes}
Beside gsplat {gsplat["versions"]["gsplat"]} on its garden scene, same inputs, same run: rendering with all gradients,
and a training step. {_where(gsplat)}.

{beside}
warpgs gives the same bits at each call, and takes up to 2.6 times gsplat's memory for it at the smaller sizes. Every
op over sizes, other programs, and the limits of the machine: [performance](performance.md). What speed costs in
accuracy: [trade](trade.md).
"""


def same_image() -> str:
    """Return the table of the agreement with gsplat."""
    result, body = _only("parity", "h200"), []
    for r in result["rows"]:
        worst = max(g["rel_l2"] for g in r["gradients"].values())
        size, differences = f"{r['sh_degree']}, {r['width']} x {r['height']}", (r["image_mean"], r["image_max"], worst)
        body.append([size, *(f"{d:.1e}" for d in differences)])
    return f"""## The same image as gsplat

Rule `gsplat-1.5` against gsplat {result["versions"]["gsplat"]}, {_where(result)}:

{table(["degree, image", "mean difference", "largest", "largest relative difference of a gradient"], body)}
How far images and gradients are from float64, line by line: [accuracy](accuracy.md).
"""


def meshes() -> str:
    """Return the table of the accuracy of meshes."""
    result, body = _only("mesh", "cpu2"), []
    for r in sorted((r for r in result["rows"] if r["row"] == "mesh"), key=lambda r: -r["voxel"]):
        if r["depth"] == "median":
            cells = [f"{r['voxel']:.2g}", f"{r['triangles']:,}"]
            body.append(cells + [f"{100 * r[k]:.2f} %" for k in ("accuracy_mean_of_radius", "completeness_mean_of_radius")])
    return f"""## Meshes

The demo from its default fit of {result["views"]} images, against the surfaces that its images were ray cast from; in
per cent of the scene's radius. {_where(result)}.

{table(["voxel", "triangles", "from mesh to surface, mean", "from seen surface to mesh, mean"], body)}
More: [mesh](mesh.md). What each file format costs: [files to send](formats.md).
"""


def page() -> str:
    """Return the page."""
    parts = (HEAD, captures(), objects(), poses(), whole_fits(), kernels(), same_image(), meshes())
    return "\n".join(parts)
