"""The measured parts of docs/numerics.md: the error budget (`python -m tests.numerics.report`) and the same bits."""

from __future__ import annotations

from bench.lib import result_file, same_bits
from bench.lib.tables import markdown


def _e(value: float) -> str:
    return f"{value:.1e}" if value else "0"


def _machine(stem: str, result: dict) -> str:
    return f"**{result['machine']['name']}** ({stem}, commit {result['commit']}, {result['date']})."


def _worst(row: dict) -> dict[str, float]:
    """Return the largest figures of images and gradients in a row."""
    rgb, alpha, depth = (row["pictures"][n] for n in ("rgb", "alpha", "depth"))
    found = {k: max(rgb[k], alpha[k]) for k in ("E mean", "E max", "P32 max", "A max", "allowed")}
    return found | {"E depth": depth["E max"], "rel L2": max(g["rel L2"] for g in row["gradients"].values())}


def _most(rows: list[dict]) -> str:
    """Return the largest values over all scenes of what has no column in the table."""
    gradients = [e for row in rows for e in row["gradients"].values()]
    of = {k: _e(max(e[k] for e in gradients)) for k in ("1 - cosine", "bias")}
    return (
        f"Largest errors: depth {_e(max(_worst(row)['E depth'] for row in rows))}; gradients: 1 - cosine {of['1 - cosine']}, "
        f"bias {of['bias']}, wrong zeros {sum(e['wrong zeros'] for e in gradients)}; "
        f"flipped pixels: {sum(row['flips'] for row in rows)}."
    )


def budget_text(results: dict[str, dict]) -> str:
    """Return a table of the first machine, images and gradients by scene under `exact`, and whether each meets the limits."""
    parts = []
    for stem, result in results.items():
        kept = "All limits are met." if not result["broken"] else "Broken: " + "; ".join(result["broken"]) + "."
        most = "" if parts else f" {_most(result['rows'])}"
        parts.append(f"{_machine(stem, result)} {kept}{most} All: `bench/results/budget_{stem}.json`.\n")
        if len(parts) > 1:
            continue
        lines = []
        for row in (r for r in result["rows"] if r["rule"] == "exact"):
            both = _worst(row)
            lines.append([row["scene"], *(_e(both[k]) for k in ("E mean", "E max", "P32 max", "A max", "rel L2"))])
        parts.append(markdown(["scene", "image: mean E", "max E", "max P32", "max A", "gradient: relative L2"], lines))
    return "\n".join(parts)


def parts() -> dict[str, str]:
    """Return the generated parts of docs/numerics.md by name."""
    return {
        "budget": budget_text(result_file.stored("budget")),
        "same bits": same_bits.table(result_file.read(same_bits.RESULTS)["rows"]),
    }
