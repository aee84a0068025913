"""Errors of a fit's held-out views by coverage, and an image of unseen areas under two settings."""

from __future__ import annotations

import gc
import io
from pathlib import Path

import numpy as np

import warpgs
from bench.lib.one_fit import Fit, config_of
from bench.lib.scenes import scene_at
from warpgs.pipeline.metrics.coverage import score_by_coverage
from warpgs.pipeline.metrics.scores import psnr_of
from warpgs.report.images import Cell, Strip, coverage_image, crops, sheet

PARTS = 3
"""Side of a crop as a fraction of the image's side."""
HEADINGS = ["before", "after", "photograph", "striped: seen by no training view"]
"""Headings of the columns of the image."""
QUALITY = 75
"""Quality of the JPEG file, from 0 to 100."""


def renders_of(folder: Path, fit: Fit) -> Path:
    """Return the file of the held-out views of a fit."""
    name = f"{fit.row}-{fit.preset}-{fit.seed}"
    return folder / ("".join(c if c.isalnum() or c in "-." else "_" for c in name) + ".npz")


def measure(folder: Path, fit: Fit) -> dict:
    """Fit, and return scores, size and errors by coverage; the held-out views are written to a folder."""
    scene = scene_at(fit.folder, fit.downscale)
    try:
        fitted = warpgs.fit(scene, config_of(fit.preset, fit.seed), split=fit.split, device=fit.device, verbose=False)
        views: list[dict[str, np.ndarray]] = []

        def keep(view: warpgs.View, image: np.ndarray, classes: dict[str, np.ndarray]) -> None:
            colors = {"photo": view.image, "render": image}
            pixels = {k: np.round(255 * np.clip(v, 0, 1)).astype(np.uint8) for k, v in colors.items()}
            views.append({"name": np.array(view.name), **pixels, "unseen": classes["0"]})

        train, test = ([scene.view(n) for n in names] for names in (fitted.train, fitted.test))
        found = score_by_coverage(fitted.gaussians(), train, test, fitted.options(), show=keep)
        np.savez_compressed(renders_of(folder, fit), **{k: np.stack([v[k] for v in views]) for k in views[0]})
        metrics = fitted.metrics
        return {k: metrics["test"][k] for k in ("psnr", "ssim")} | {
            "gaussians": metrics["gaussians"], "steps": metrics["steps"], "classes": found["classes"],
        }  # fmt: skip
    finally:
        gc.collect()  # a fit and its recorded steps refer to each other: without this their device memory piles up


def worst_parts(before: dict, after: dict, count: int) -> list[tuple[int, int, int, int, int]]:
    """Return the unseen parts of held-out views with the largest squared error of both fits.

    Args:
        before: Arrays of a fit as `measure` writes them: 8-bit ``photo`` and ``render`` [V, H, W, 3], and ``unseen`` [V, H, W].
        after: The same of another fit of the same views; a pixel counts where it is unseen in both.
        count: Number of parts, each from a different view.

    Returns:
        View, x, y, width and height [px] of each, largest error first.
    """
    unseen = before["unseen"] & after["unseen"]
    error = sum(np.square(v["render"].astype(np.float64) - v["photo"]).mean(-1) for v in (before, after)) * unseen
    height, width = (side // PARTS for side in unseen.shape[1:])
    found = []
    for i, own in enumerate(error):
        ((x, y),) = crops(own, width, height, 1)
        found.append((own[y : y + height, x : x + width].sum(), i, x, y, width, height))
    return [place for _, *place in sorted(found, key=lambda f: (-f[0], f[1]))[:count]]


def unseen_in_both(before: Path, after: Path) -> dict:
    """Return scores of two fits over the pixels that are unseen in both.

    Args:
        before: File that `measure` wrote.
        after: The same of another fit.

    Returns:
        ``share_of_pixels``, and the PSNR [dB] of each fit there, ``before`` and ``after``; None without such pixels.
    """
    views = [dict(np.load(file)) for file in (before, after)]
    unseen = views[0]["unseen"] & views[1]["unseen"]
    errors = [np.square((v["render"].astype(np.float64) - v["photo"]) / 255).mean(-1)[unseen] for v in views]
    scores = [psnr_of(float(e.mean())) if len(e) else None for e in errors]
    return {"share_of_pixels": float(unseen.mean()), "before": scores[0], "after": scores[1]}


def picture(rows: dict[str, tuple[Path, Path]], count: int = 2) -> bytes:
    """Return a JPEG of the worst unseen parts: before, after, photograph, and the photograph with unseen pixels striped.

    Args:
        rows: Files that `measure` wrote before and after, by the name of the row.
        count: Parts of each row.
    """
    from PIL import Image

    strips = []
    for row, files in rows.items():
        before, after = (dict(np.load(file)) for file in files)
        for i, x, y, w, h in worst_parts(before, after, count):
            cut = (i, slice(y, y + h), slice(x, x + w))
            unseen = before["unseen"][cut] & after["unseen"][cut]
            photo, *renders = (v[cut].astype(np.float32) / 255 for v in (before["photo"], before["render"], after["render"]))
            cells = [Cell(r, f"unseen pixels {_psnr(r, photo, unseen)}") for r in renders]
            striped = coverage_image(photo, unseen, np.zeros_like(unseen))
            cells += [Cell(photo, ""), Cell(striped, f"{100 * unseen.mean():.0f} % of the crop")]
            strips.append(Strip(f"{row}, held-out view {before['name'][i]}", tuple(cells), ()))
    out = io.BytesIO()
    with Image.open(io.BytesIO(sheet(HEADINGS, strips))) as made:
        made.save(out, "JPEG", quality=QUALITY, optimize=True)
    return out.getvalue()


def _psnr(image: np.ndarray, photo: np.ndarray, pixels: np.ndarray) -> str:
    """Return the PSNR over some pixels as text."""
    if not pixels.any():
        return "none"
    return f"{psnr_of(float(np.square(image - photo)[pixels].mean())):.1f} dB"
