"""The generated parts of the pages on use: farms, several GPUs, formats."""

from __future__ import annotations

import re

from bench.lib import result_file
from bench.lib.results_page import table
from bench.lib.tables import markdown

MODELS = {
    "horns": "horns, 54 views of 504 x 378 px, {:,} Gaussians",
    "garden": "garden, 1920 x 1080 px, {:,} Gaussians",
}
FORMATS = {
    ".ply": ("Kerbl et al. 2023, float32", "0 to 4", "every tool"),
    ".compressed.ply": ("PlayCanvas, 8 to 11 bits", "0 to 3", "SuperSplat, PlayCanvas"),
    ".spz": ("Niantic, fixed point and 8 bits, gzip", "0 to 4", "Scaniverse, Babylon.js, SuperSplat"),
    ".sog": ("PlayCanvas, 8-bit images in a zip archive", "0 to 3", "SuperSplat, PlayCanvas"),
    ".glb": ("glTF 2.0, `KHR_gaussian_splatting`, float32", "0 to 3", "Cesium, 3D engines"),
    ".gltf": ("the same as text", "0 to 3", "Cesium, 3D engines"),
    ".splat": ("antimatter15, 8 bits", "0", "small viewers"),
}
"""Encoding, SH degrees and programs of each file format."""


def _result(name: str) -> tuple[dict, str]:
    return result_file.read(result_file.FOLDER / f"{name}.json"), "\n" + result_file.source(name)


def packing() -> str:
    """Return the table of fits that share GPUs: one scene many times, then captures of different sizes."""
    body, sources = [], ""
    names = {
        "farm_h200": "fern, 3000 steps",
        "farm_gpus_h200": "fern, 1500 steps",
        "farm_captures_h200": "40 captures, 1500 steps",
    }
    for file, jobs in names.items():
        result, source = _result(file)
        sources += source
        for r in result["rows"]:
            cells = [f"{r['gpus']}", f"{r['per_gpu']}", f"{r['fits_per_hour']:,.0f}", f"{r['mean_seconds_of_a_fit']:.1f}"]
            body.append([jobs if r is result["rows"][0] else "", *cells, f"{r['seconds']:.0f}"])
    return table(["jobs", "GPUs", "`--per-gpu`", "fits per hour", "one fit [s]", "all [s]"], body) + sources


def ranks() -> str:
    """Return the table of steps by the number of GPUs."""
    result, source = _result("ranks_h200")
    body = []
    for case, words in MODELS.items():
        rows = sorted((r for r in result["rows"] if r["case"] == case), key=lambda r: r["ranks"])
        for r in rows:
            name = words.format(r["gaussians"]) if r is rows[0] else ""
            body.append(
                [name, f"{r['ranks']}", f"{r['step_ms']:.1f} ms", f"{r['collectives_ms']:.1f} ms", f"{r['efficiency']:.2f}"]
            )
    return table(["model", "GPUs", "step", "in collectives", "scaling efficiency"], body) + source


def formats() -> str:
    """Return the table of file formats: encoding, bytes of a Gaussian, loss; without filters, SPZ in its default version."""
    result, source = _result("formats_fern_cpu2")
    rows = {r["format"]: r for r in result["rows"] if not r["clean"]}
    body = []
    for name, (encoding, degrees, programs) in FORMATS.items():
        r = rows[name]
        cells = [f"{r['bytes'] / r['gaussians']:.0f}", f"{r['loss_db']:.3f}"]
        body.append([f"`{name}`", encoding, degrees, *cells, programs])
    body.append(["`.html`", "compressed, with a viewer of 0.8 MB", "0", "about 35", "", "any browser"])
    head = ["file", "encoding", "SH degrees", "bytes per Gaussian", "loss [dB]", "opens in"]
    return markdown(head, body, ("file", "encoding", "SH degrees", "opens in")) + source


def programs() -> str:
    """Return the largest difference in steps, and the table of other programs: formats in both directions, exceptions."""
    result, source = _result("third_party")
    body, steps = [], []
    for program in (name for name, state in result["programs"].items() if not state.startswith("not run")):
        cells, exceptions = [program], {}
        for way in ("to", "from"):
            rows = [r for r in result["rows"] if (r["program"], r["direction"]) == (program, way) and r["scene"] != "files"]
            names = [re.sub(r"^(m|v\d)(?=\.)", "", r["format"]) for r in rows]
            steps += [d / (r["steps"][k] or 1) for r in rows if r["verdict"] == "same" for k, d in r["largest"].items()]
            cells.append(", ".join(dict.fromkeys(f"`{n}`" for n, r in zip(names, rows) if r["verdict"] == "same")))
            for n, r in zip(names, rows):
                if r["verdict"] != "same":
                    exceptions.setdefault(r["verdict"], {})[f"`{r['format'] if 'read' in r['verdict'] else n}`"] = None
        body.append([*cells, "; ".join(f"{', '.join(n)} {verdict}" for verdict, n in exceptions.items())])
    head = ["program", "reads", "writes", "exceptions"]
    return f"Largest difference to what warpgs reads: {max(steps):.2g} step.\n\n" + markdown(head, body, head) + source
