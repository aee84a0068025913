"""Held-out errors by the number of training views that saw a pixel, under two settings and over seeds, with a picture.

Classes depend on the depth of each fit, so a class has different pixels in different fits. The first and the second of
--presets are therefore also compared over the pixels that are unseen in both fits of a seed.
--picture writes an image of the unseen parts of held-out views with the largest error, from the fits of the first seed; the
renders are in --work. Rows in --out are kept when the command is repeated.
"""

from __future__ import annotations

import functools
import math
import sys
from pathlib import Path

from bench.lib import result_file
from bench.lib.arguments import parse
from bench.lib.coverage_fits import measure, picture, renders_of, unseen_in_both
from bench.lib.one_fit import Fit, compile_all, plan
from bench.lib.pool import measure_all
from bench.lib.scenes import made, row_of, shrunk
from bench.lib.tables import markdown, mean_sd, named
from warpgs.errors import WarpgsError
from warpgs.files import write_bytes
from warpgs.pipeline.run.request import choose_device

WHAT = "scores of held-out views by the number of training views that saw each pixel, as warpgs eval --by-coverage gives them"
BEFORE = "default:method.hier=true,optimizer.opacities_decay=0,loss.smooth_weight=0,init.extrapolate=false,steps=3000"
"""Settings of `default` before decisions 023, 024 and 026, for up to four opaque views."""
COLUMNS = {"share_of_pixels": "pixels [%]", "share_of_error": "error [%]", "psnr": "PSNR [dB]"}
"""Columns of the table."""


def line(row: dict) -> str:
    """Return a result as text."""
    unseen = row["classes"].get("0", {"share_of_pixels": 0, "share_of_error": 0})
    return (
        f"{row['psnr']:.2f} dB  SSIM {row['ssim']:.3f}  {row['gaussians']:,} Gaussians; unseen: "
        f"{100 * unseen['share_of_pixels']:.0f} % of the pixels, {100 * unseen['share_of_error']:.0f} % of the error"
    )


def table(rows: list[dict]) -> str:
    """Return means over seeds by row, preset and class as a Markdown table."""
    lines, good = [], [r for r in rows if "error" not in r]
    for row, preset in dict.fromkeys((r["row"], r["preset"]) for r in good):
        own = [r["classes"] for r in good if (r["row"], r["preset"]) == (row, preset)]
        for seen in dict.fromkeys(c for classes in own for c in classes):
            values = [c[seen] for c in own if seen in c]
            cells = [mean_sd([(1 if k == "psnr" else 100) * v[k] for v in values], 1 + (k == "psnr")) for k in COLUMNS]
            lines.append([row, preset, seen, len(values), *cells])
    return markdown(["row", "preset", "seen by", "fits", *COLUMNS.values()], lines)


def pairs(work: Path, fits: list[Fit], presets: list[str]) -> dict[tuple[str, int], tuple[Path, Path]]:
    """Return the files of both fits, before and after, by row and seed, if both exist."""
    files = {(f.row, f.seed, f.preset): renders_of(work, f) for f in fits}
    found = {(f.row, f.seed): (files[f.row, f.seed, presets[0]], files[f.row, f.seed, presets[1]]) for f in fits}
    return {key: pair for key, pair in found.items() if all(file.is_file() for file in pair)}


def main(arguments: list[str] | None = None) -> int:
    """Measure, print the table and write the image; return the exit code."""
    a = parse(
        __doc__, arguments, {"data": Path}, ("out", "work"), rows=["fern:3", "horns:3"], presets=[BEFORE, "default"], seeds=3,
        jobs=1, seconds=math.inf, shrink=1, device="auto", work=Path, out=Path, picture=Path,
    )  # fmt: skip
    device = choose_device(a.device)[0]
    try:
        rows = {name: shrunk(row_of(name), a.shrink) for name in a.rows}
        a.work.mkdir(parents=True, exist_ok=True)
        folders = {name: made(a.data, row, a.work) for name, row in rows.items()}
        fits = [
            fit for seed in range(a.seeds) for name, row in rows.items() for preset in a.presets
            for fit in plan(name, preset, seed, folders[name], (row.split, row.downscale), 0, str(device))
        ]  # fmt: skip
        first = functools.partial(compile_all, ("default",), str(device))
        found = measure_all(functools.partial(measure, a.work), fits, first, a, WHAT, device, line)
    except WarpgsError as e:
        print(f"bench.fits.coverage: {e}", file=sys.stderr)
        return e.exit_code
    print(table(found))
    both = pairs(a.work, fits, a.presets)
    same = [{"row": row, "seed": seed, **unseen_in_both(*files)} for (row, seed), files in both.items()]
    print("unseen in both fits:", *map(named, same), sep="\n")
    result_file.keep(a.out, WHAT, device, found, unseen_in_both=same)
    first_seed = {row: files for (row, seed), files in both.items() if seed == 0}
    if a.picture and first_seed:
        write_bytes(a.picture, picture(first_seed))
    return int(any("error" in row for row in found))


if __name__ == "__main__":
    sys.exit(main())
