"""Coverage of a run's held-out views: scores split by coverage, an image of each view, and the section of the report page."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from warpgs.files import make_folder, read_file, write_bytes
from warpgs.io.decoding import decode
from warpgs.pipeline.metrics.coverage_scores import CLASSES, score_by_coverage
from warpgs.render.options import RasterizeOptions
from warpgs.report.coverage_image import LEGEND, coverage_image
from warpgs.report.images import png, webp
from warpgs.report.page import CoverageReport
from warpgs.scene import Gaussians, View

FOLDER = "coverage"
"""Folder in a run folder with an image of each held-out view."""
EXPECTED = (
    "The expected PSNR is an estimate from training data, not a bound. It is the PSNR between training photographs where the "
    "depths of two views differ as much as at the scored pixels."
)
"""Meaning of the expected PSNR, as text for the user."""


def coverage_of_run(
    out: Path | None,
    gaussians: Gaussians,
    train: list[View],
    test: list[View],
    options: RasterizeOptions,
    *,
    names: Mapping[str, str],
    tell: Callable[[str], object] = lambda line: None,
) -> dict[str, Any]:
    """Split the scores of held-out views by coverage, and save an image of each view.

    Args:
        out: The run folder; None to write nothing.
        gaussians: N Gaussians in scene units [u].
        train: Training views.
        test: Held-out views, at least one.
        options: Options of the rasterizer.
        names: Names of image files by view, from `image_names` for the whole scene.
        tell: Called with a line for each view before it is rendered.

    Returns:
        The result of `score_by_coverage`.

    Raises:
        ResourceError: An image cannot be written.
    """
    if out is not None:
        make_folder(out / FOLDER)

    def show(view: View, image: np.ndarray, classes: dict[str, np.ndarray]) -> None:
        if out is not None:
            write_bytes(out / FOLDER / f"{names[view.name]}.png", png(coverage_image(image, classes["0"], classes["1"])))

    return score_by_coverage(gaussians, train, test, options, show, tell)


def coverage_table(coverage: dict[str, Any]) -> list[list[str]]:
    """Return a header row and a row for each class of pixels of each view, then of all views together, as texts."""
    rows = [["view", "pixels", "share", "squared error", "PSNR [dB]", "SSIM", "expected PSNR [dB]"]]
    for name, classes in [*((v["name"], v["classes"]) for v in coverage["views"]), ("all views", coverage["classes"])]:
        for key, r in classes.items():
            expected = "-" if r["expected_psnr"] is None else f"{r['expected_psnr']:.2f}"
            shares = (f"{100 * r[f'share_of_{what}']:.1f} %" for what in ("pixels", "error"))
            rows.append([name, CLASSES[key], *shares, f"{r['psnr']:.2f}", f"{r['ssim']:.3f}", expected])
    return rows


def coverage_lines(coverage: dict[str, Any]) -> list[str]:
    """Return the table as lines for the user, then a summary, and a legend of the images."""
    rows = coverage_table(coverage)
    widths = [max(map(len, column)) for column in zip(*rows)]
    lines = ["  ".join(c.ljust(w) if i < 2 else c.rjust(w) for i, (c, w) in enumerate(zip(r, widths))) for r in rows]
    return [*lines, coverage["summary"], EXPECTED, f"images in {FOLDER}/: {LEGEND}"]


def coverage_section(out: Path, coverage: dict[str, Any], shown: list[str], names: Mapping[str, str]) -> CoverageReport:
    """Return the section of the report page.

    Args:
        out: The run folder, with the images.
        coverage: Result of `coverage_of_run`.
        shown: Names of the views whose images are shown.
        names: Names of image files by view.
    """
    files = {n: out / FOLDER / f"{names[n]}.png" for n in shown}
    head, *rows = coverage_table(coverage)
    return CoverageReport(
        f"{coverage['summary'][0].upper()}{coverage['summary'][1:]}. {EXPECTED}", LEGEND,
        [(n, webp(decode(f, data=read_file(f, out))[0], 640)) for n, f in files.items() if f.is_file()],
        [head[1:], *(r[1:] for r in rows if r[0] == "all views")],
    )  # fmt: skip
