"""Figure of a study: renders of held-out views by each variant beside the images, with enlarged crops where they differ."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from warpgs.pipeline.metrics.evaluate import over_white, render_view
from warpgs.pipeline.runs.folder import open_run
from warpgs.report.crops import crops, disagreement
from warpgs.report.sheet import Cell, Strip
from warpgs.scene import View

CROPS = 2
"""Enlarged parts of each view."""
FRACTION = 0.22
"""Width and height of a crop, as fractions of the width and height of the image."""


def _rendered(folder: Path, views: list[View], device: torch.device) -> list[np.ndarray]:
    """Render views with the model of a run; colours [H, W, 3] in [0, 1]."""
    run = open_run(folder, device)
    return [np.clip(render_view(run.gaussians(), v, run.options())[0], 0, 1) for v in views]


def strips(
    scene: str,
    views: list[View],
    folders: dict[str, Path],
    scores: dict[str, dict[str, float]],
    count: int,
    device: torch.device,
) -> list[Strip]:
    """Return rows of the figure for one scene: the held-out views on which the variants differ most.

    Args:
        scene: Name of the scene, for titles.
        views: Its held-out views.
        folders: Run folder of each variant, in the order of the columns.
        scores: PSNR [dB] by variant and view name; no PSNR is printed for missing views.
        count: Largest number of rows.
        device: Device to render on.

    Returns:
        Rows with a cell per variant; the last cell is the image of the view.
    """
    images = {name: _rendered(folder, views, device) for name, folder in folders.items()}
    maps = []
    for i, view in enumerate(views):
        values = disagreement([p[i] for p in images.values()], view.image)
        maps.append(values if view.score_mask is None else values * view.score_mask)
    chosen = sorted(sorted(range(len(views)), key=lambda i: -float(maps[i].mean()))[:count])
    rows = []
    for i in chosen:
        view = views[i]
        H, W = view.image.shape[:2]
        w, h = max(8, round(FRACTION * W)), max(8, round(FRACTION * H))
        corners = crops(maps[i], w, h, CROPS)
        cells = []
        for name, rendered in images.items():
            value = scores.get(name, {}).get(view.name)
            cells.append(Cell(rendered[i], f"{value:.2f} dB" if value is not None else ""))
        reference = view.image if view.score_mask is None else over_white(view.image, view.score_mask) * 0.5 + view.image * 0.5
        words = "held-out image" if view.score_mask is None else "image, bleached where not scored"
        rows.append(Strip(f"{scene}, {view.name}", (*cells, Cell(reference, words)), tuple((x, y, w, h) for x, y in corners)))
    return rows
