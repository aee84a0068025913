"""The generated parts of docs/trade.md."""

from __future__ import annotations

from bench.lib import result_file
from bench.lib.tables import markdown
from warpgs.constants import RULES

FASTER = ("balanced", "fast")
FITS = ("quick", "300 steps", "1200 steps", "rule balanced", "rule fast", "half size 0.3", "half size 0.6", "3000 Gaussians")
"""Fits of the table. Others in the results are of presets that are gone, or pairs."""


def rules() -> str:
    """Return error and time of an image with gradients under the faster rules, by scene."""
    result, body = result_file.stored("tradeoff_kernel")["h200"], []
    for name in result["scenes"]:
        rows = {r["setting"]: r for r in result["rows"] if r["scene"] == name}
        cells = [name, f"{rows['exact']['mean']:.1e}"]
        for rule in FASTER:
            cells += [f"{rows[rule]['mean']:.1e}", f"{rows[rule]['both_ms'] / rows['exact']['both_ms']:.2f}"]
        body.append(cells)
    head = ["scene", "`exact`: error", *(cell for rule in FASTER for cell in (f"`{rule}`: error", "time"))]
    return markdown(head, body, head[:1]) + "\n" + result_file.source("tradeoff_kernel_h200")


def fits() -> str:
    """Return time and scores of fits by setting, and the differences to preset `quick`."""
    stems = ("cpu2", "h200")
    results = {stem: result_file.stored("tradeoff_outcome")[f"fern_{stem}"] for stem in stems}
    body = []
    for trial in FITS:
        cells = [trial]
        for stem in stems:
            r = next(r for r in results[stem]["summary"] if r["trial"] == trial)
            cells.append(f"{r['seconds']:.1f}")
            if trial == "quick":
                cells += [f"{r['psnr']:.2f}", f"{r['ssim']:.4f}"]
            else:
                cells += [f"{r['psnr_gain']:+.2f} ± {r['psnr_bar']:.2f}", f"{r['ssim_gain']:+.4f} ± {r['ssim_bar']:.4f}"]
        body.append(cells)
    head = ["fit", "2 cores [s]", "PSNR [dB]", "SSIM", "H200 [s]", "PSNR [dB]", "SSIM"]
    sources = [result_file.source(f"tradeoff_outcome_fern_{stem}") for stem in stems]
    return markdown(head, body, head[:1]) + "\n" + "\n".join(sources)


def error_bound() -> str:
    """Return errors of the rules and the tightness of their bound."""
    result = result_file.stored("error_bound")["cpu2"]
    body = []
    for row in result["rows"]:
        if row["of"] in RULES:
            cells = [f"`{row['of']}`", f"{row['error_mean']:.1e}", f"{row['error_max']:.1e}"]
            cells.append(f"{row['violations']} of {row['pixels']:,}")
            cells += [f"{row[f'tightness_{q}']:.3f}" for q in ("0.5", "0.99", "1")]
            body.append(cells)
    head = ["rule", "mean error", "largest error", "bound below error", "ratio: median", "99 %", "largest"]
    return markdown(head, body, head[:1]) + "\n" + result_file.source("error_bound_cpu2")


def parts() -> dict[str, str]:
    """Return the generated parts of docs/trade.md by name."""
    return {"error bound": error_bound(), "rules": rules(), "fits": fits()}
