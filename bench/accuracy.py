"""Put the measured error budget, the needles and the same bits into docs/accuracy.md.

usage: python -m bench.accuracy

The figures are those of bench/results/budget_*.json (`python -m tests.numerics.report`) and bench/results/needles_*.json
(`python -m bench.needles`), a table for each machine, and of bench/results/same_bits.json (`python -m bench.same_bits`).
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


def budget_text(results: dict[str, dict]) -> str:
    """Two tables a machine: images and gradients."""
    parts = []
    for stem, result in results.items():
        images, gradients = [], []
        for row in result["rows"]:
            name = row["scene"] + ("" if row["rule"] == "exact" else f", `{row['rule']}`")
            rgb, alpha, depth = (row["pictures"][n] for n in ("rgb", "alpha", "depth"))
            both = {k: max(rgb[k], alpha[k]) for k in ("E mean", "E max", "P32 max", "A mean", "A max")}
            images.append([
                name, _e(both["E mean"]), _e(both["E max"]), _e(max(rgb["allowed"], alpha["allowed"])), _e(both["P32 max"]),
                _e(depth["E max"]), _e(both["A mean"]), _e(both["A max"]),
                f"{row['in band']} of {row['pixels']}", str(row["flips"]),
            ])  # fmt: skip
            v = row["gradients"]
            worst = max(v, key=lambda n: v[n]["rel L2"])
            gradients.append([
                name, f"{_e(v[worst]['rel L2'])} ({worst})", _e(max(e["1 - cosine"] for e in v.values())),
                _e(max(e["bias"] for e in v.values())), _e(max(e["E max"] for e in v.values())),
                _e(max(e["P32 max"] for e in v.values())), _e(max(e["A max"] for e in v.values())),
                str(sum(e["wrong zeros"] for e in v.values())),
            ])  # fmt: skip
        kept = "Every line is kept." if not result["broken"] else "Broken: " + "; ".join(result["broken"]) + "."
        head = ["images", "mean E", "max E", "allowed", "max P32", "max E depth", "mean A", "max A", "band", "flips"]
        parts += [f"{_machine(stem, result)} {kept}\n", _table(head, images)]
        head = ["gradients", "relative L2", "1 - cosine", "bias", "max E", "max P32", "max A", "wrong zeros"]
        parts.append(_table(head, gradients))
    return "\n".join(parts)


def needles_text(results: dict[str, dict]) -> str:
    """A table a machine: max and mean errors by length, and how many times the factor form is better."""
    parts = []
    for stem, result in results.items():
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
