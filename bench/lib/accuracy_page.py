"""The measured parts of docs/accuracy.md: the error budget, the needles, the same bits, and gradients of other programs.

The figures are those of bench/results/budget_*.json (`python -m tests.numerics.report`) and bench/results/needles_*.json
(`python -m bench.studies.needles`), tables of the first machine, of bench/results/same_bits.json
(`python -m bench.fits.same_bits`), and of bench/results/gradients_*.json (`python -m bench.peers.gradient_accuracy`).
"""

from __future__ import annotations

from bench.lib import rasterizers_page, result_file, same_bits
from bench.lib.tables import markdown

RENAMED = {"gsplat": "gsplat-1.5"}
"""Current names of rules that had other names when results were stored."""


def _e(value: float) -> str:
    return f"{value:.1e}" if value else "0"


def _machine(stem: str, result: dict) -> str:
    return f"**{result['machine']['name']}** ({stem}, commit {result['commit']}, {result['date']})."


def _worst(row: dict) -> dict[str, float]:
    """Return the largest figures of images and gradients in a row."""
    rgb, alpha, depth = (row["pictures"][n] for n in ("rgb", "alpha", "depth"))
    found = {k: max(rgb[k], alpha[k]) for k in ("E mean", "E max", "P32 max", "A mean", "A max", "allowed")}
    return found | {"E depth": depth["E max"], "rel L2": max(g["rel L2"] for g in row["gradients"].values())}


def _most(rows: list[dict]) -> str:
    """Return the largest values over all scenes, including those without a column in the table."""
    gradients = [e for row in rows for e in row["gradients"].values()]
    images = {k: max(_worst(row)[k] for row in rows) for k in ("E mean", "E max", "E depth")}
    of = {k: _e(max(e[k] for e in gradients)) for k in ("rel L2", "1 - cosine", "bias")}
    return (
        f"Largest errors over all scenes. Images: mean E {_e(images['E mean'])}, max E {_e(images['E max'])}, depth "
        f"{_e(images['E depth'])}. Gradients: relative L2 {of['rel L2']}, 1 - cosine {of['1 - cosine']}, bias {of['bias']}, "
        f"wrong zeros {sum(e['wrong zeros'] for e in gradients)}. "
        f"Pixels with a flipped decision: {sum(row['flips'] for row in rows)}."
    )


def budget_text(results: dict[str, dict]) -> str:
    """Return a table of the first machine, images and gradients by scene, and a sentence on each machine."""
    parts = []
    for stem, result in results.items():
        kept = "All limits are met." if not result["broken"] else "Broken: " + "; ".join(result["broken"]) + "."
        parts.append(f"{_machine(stem, result)} {kept} {_most(result['rows'])} All: `bench/results/budget_{stem}.json`.\n")
        if len(parts) > 1:
            continue
        lines = []
        for row in result["rows"]:
            rule = RENAMED.get(row["rule"], row["rule"])
            name = row["scene"] + ("" if rule == "exact" else f", `{rule}`")
            both, v = _worst(row), row["gradients"]
            worst = max(v, key=lambda n: v[n]["rel L2"])
            lines.append([
                name, *(_e(both[k]) for k in ("E mean", "E max", "allowed", "P32 max", "A mean", "A max")),
                f"{row['in band']}/{row['pixels']}", f"{_e(both['rel L2'])} ({worst})",
                _e(max(e["A max"] for e in v.values())),
            ])  # fmt: skip
        head = ["scene", "image: mean E", "max E", "allowed", "max P32", "mean A", "max A", "in band"]
        parts.append(markdown([*head, "gradient: relative L2", "max A"], lines))
    return "\n".join(parts)


def needles_text(results: dict[str, dict]) -> str:
    """Return a table of the first machine: largest errors by length, and ratios of errors to those of the factor form."""
    parts = []
    for stem, result in list(results.items())[:1]:
        rows = []
        for row in result["rows"]:
            line = [f"{row['sigma']:,}"]
            for what, peers in (("weight", ("conic", "plain")), ("image", ("conic", "plain")), ("gradient", ("plain",))):
                e = row[what]
                line += [_e(e[n]["max"]) for n in ("factor", *peers)]
                line.append(f"{min(e[n]['max'] / e['factor']['max'] for n in peers):,.0f}")
            rows.append(line)
        head = ["length [px]", "weight: factor", "conic", "plain", "times", "image: factor", "conic", "plain", "times"]
        of = f"Largest over {result['needles']} needles (weight) and {result['images']} (image, gradient)."
        parts += [f"{_machine(stem, result)} {of}\n", markdown([*head, "gradient: factor", "plain", "times"], rows)]
    files = ", ".join(f"`bench/results/needles_{stem}.json`" for stem in results)
    parts.append(f"With means, and of every machine: {files}.\n")
    return "\n".join(parts)


def gradients_text(results: dict[str, dict]) -> str:
    """Return the table of gradients beside other programs, and the source of its figures."""
    stems = sorted(results, key=len)  # that of all programs first, then the one of fast math
    sources = "\n".join(result_file.source(f"gradients_{stem}") for stem in stems)
    return f"{rasterizers_page.gradients_table([results[stem] for stem in stems])}\n{sources}"


def parts() -> dict[str, str]:
    """Return the generated parts of docs/accuracy.md by name."""
    return {
        "budget": budget_text(result_file.stored("budget")),
        "needles": needles_text(result_file.stored("needles")),
        "gradients": gradients_text(result_file.stored("gradients")),
        "same bits": same_bits.table(result_file.read(same_bits.RESULTS)["rows"]),
    }
