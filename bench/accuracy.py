"""Put the measured error budget, the needles and the same bits into docs/accuracy.md.

usage: python -m bench.accuracy

The figures are those of bench/results/budget_*.json (`python -m tests.numerics.report`) and bench/results/needles_*.json
(`python -m bench.needles`), tables of the first machine, and of bench/results/same_bits.json (`python -m bench.same_bits`).
"""

from __future__ import annotations

from bench import result_file, same_bits

PAGE = result_file.ROOT / "docs/accuracy.md"


def _table(head: list[str], rows: list[list[str]]) -> str:
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def _e(value: float) -> str:
    return f"{value:.1e}" if value else "0"


def _machine(stem: str, result: dict) -> str:
    return f"**{result['machine']['name']}** ({stem}, commit {result['commit']}, {result['date']})."


def _worst(row: dict) -> dict[str, float]:
    """Return the largest figures of images and gradients in a row."""
    rgb, alpha, depth = (row["pictures"][n] for n in ("rgb", "alpha", "depth"))
    found = {k: max(rgb[k], alpha[k]) for k in ("E mean", "E max", "P32 max", "A mean", "A max", "allowed")}
    return found | {"E depth": depth["E max"], "rel L2": max(g["rel L2"] for g in row["gradients"].values())}


def budget_text(results: dict[str, dict]) -> str:
    """Two tables of the first machine, images and gradients; a sentence on each of the others."""
    parts = []
    for stem, result in results.items():
        images, gradients = [], []
        for row in result["rows"]:
            name = row["scene"] + ("" if row["rule"] == "exact" else f", `{row['rule']}`")
            both, v = _worst(row), row["gradients"]
            images.append([
                name, *(_e(both[k]) for k in ("E mean", "E max", "allowed", "P32 max", "E depth", "A mean", "A max")),
                f"{row['in band']} of {row['pixels']}", str(row["flips"]),
            ])  # fmt: skip
            name_of_worst = max(v, key=lambda n: v[n]["rel L2"])
            gradients.append([
                name, f"{_e(both['rel L2'])} ({name_of_worst})",
                *(_e(max(e[k] for e in v.values())) for k in ("1 - cosine", "bias", "E max", "P32 max", "A max")),
                str(sum(e["wrong zeros"] for e in v.values())),
            ])  # fmt: skip
        kept = "Every line is kept." if not result["broken"] else "Broken: " + "; ".join(result["broken"]) + "."
        if parts:
            most = {k: max(_worst(row)[k] for row in result["rows"]) for k in ("E mean", "E max", "rel L2")}
            parts.append(
                f"{_machine(stem, result)} {kept} Largest over all scenes: mean E {_e(most['E mean'])}, max E "
                f"{_e(most['E max'])}, relative L2 of a gradient {_e(most['rel L2'])}; each: "
                f"`bench/results/budget_{stem}.json`.\n"
            )
            continue
        head = ["images", "mean E", "max E", "allowed", "max P32", "max E depth", "mean A", "max A", "band", "flips"]
        parts += [f"{_machine(stem, result)} {kept}\n", _table(head, images)]
        head = ["gradients", "relative L2", "1 - cosine", "bias", "max E", "max P32", "max A", "wrong zeros"]
        parts.append(_table(head, gradients))
    return "\n".join(parts)


def needles_text(results: dict[str, dict]) -> str:
    """A table of the first machine: max and mean errors by length, and how many times the factor form is better."""
    parts = []
    for stem, result in list(results.items())[:1]:
        rows = []
        for row in result["rows"]:
            line = [f"{row['sigma']:,}"]
            for what, peers in (("weight", ("conic", "plain")), ("image", ("conic", "plain")), ("gradient", ("plain",))):
                e = row[what]
                line += [" / ".join(_e(e[n][k]) for k in ("max", "mean")) for n in ("factor", *peers)]
                line.append(f"{min(e[n]['max'] / e['factor']['max'] for n in peers):,.0f}")
            rows.append(line)
        head = ["length [px]", "weight: factor", "conic", "plain", "times", "image: factor", "conic", "plain", "times"]
        of = f"Max / mean over {result['needles']} needles (weight) and {result['images']} (image, gradient)."
        parts += [f"{_machine(stem, result)} {of}\n", _table([*head, "gradient: factor", "plain", "times"], rows)]
    parts += [f"The same of another machine: `bench/results/needles_{stem}.json`.\n" for stem in list(results)[1:]]
    return "\n".join(parts)


def filled(page: str) -> str:
    """The page with the text between each pair of marks made anew."""
    bits = same_bits.table(result_file.read(same_bits.RESULTS)["rows"])
    for name, text in (
        ("budget", budget_text(result_file.stored("budget"))),
        ("needles", needles_text(result_file.stored("needles"))),
        ("same bits", bits),
    ):
        begin, end = f"<!-- {name}: written by bench.accuracy -->\n", f"<!-- end of {name} -->"
        before, rest = page.split(begin)
        page = before + begin + "\n" + text + "\n" + end + rest.split(end)[1]
    return page


def main() -> None:
    """Rewrite the page."""
    PAGE.write_text(filled(PAGE.read_text("utf-8")), "utf-8", newline="\n")


if __name__ == "__main__":
    main()
