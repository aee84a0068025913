"""Comparison of rendered with given depth and normals of training views, for metrics.json and the report."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from warpgs.geometry import depth_normals
from warpgs.pipeline.metrics.evaluate import render_view
from warpgs.pipeline.train.loss_terms.given import MIN_ALPHA
from warpgs.pipeline.train.views import TrainingView
from warpgs.render.rasterize import RasterizeOptions
from warpgs.scene import Gaussians, View

DEPTH, NORMALS = "given_depth", "given_normals"
"""Names of the maps of the loss terms."""


def given_figures(
    train: Sequence[View], views: Sequence[TrainingView], gaussians: Gaussians, options: RasterizeOptions
) -> dict[str, Any]:
    """Return the comparison of the model with each kind of given map: a row for each view with such a map, and a summary.

    Args:
        train: The views to fit.
        views: The same views, with the maps of the loss terms.
        gaussians: The fitted model.
        options: Options for rendering the model.

    Returns:
        For ``depth`` and ``normals``, each only if a loss term compared it: ``views`` with name, fraction of the pixels with a
        given value, and median difference (relative for depth, in degrees for normals; NaN without rendered pixels); and
        ``summary``.
    """
    rows: dict[str, list[dict[str, Any]]] = {"depth": [], "normals": []}
    for view, mapped in zip(train, views, strict=True):
        maps = {n: t.cpu().numpy() for n, t in mapped.maps.items() if n in (DEPTH, NORMALS) and bool(t.any())}
        if not maps:
            continue
        _, depth, alpha = render_view(gaussians, view, options)
        shown = alpha > MIN_ALPHA
        if DEPTH in maps:
            scaled, weight, unit = np.moveaxis(maps[DEPTH], -1, 0)
            at = weight > 0
            both = at & shown
            off = np.abs(depth[both] * scaled[both] / unit[both] - 1)
            rows["depth"].append(_row(view.name, at, off))
        if NORMALS in maps:
            given = maps[NORMALS]
            K = torch.from_numpy(view.camera.K).float()
            camera = replace(view.camera, viewmat=torch.eye(4, dtype=torch.float32, device="cpu"), K=K)
            found = depth_normals(camera, torch.as_tensor(np.where(shown, depth, 0), dtype=torch.float32)).numpy()
            at = given.any(-1)
            both = at & found.any(-1)
            cosine = (given[both] * found[both]).sum(-1).clip(-1, 1)
            rows["normals"].append(_row(view.name, at, np.degrees(np.arccos(cosine))))
    words = {
        "depth": "given depth: median difference of rendered depth {:.2%} (worst view {:.2%})",
        "normals": "given normals: median difference of the normals of rendered depth {:.1f} degrees (worst view {:.1f})",
    }
    found = {}
    for name, own in rows.items():
        if not own:
            continue
        off = [r["difference"] for r in own if np.isfinite(r["difference"])] or [float("nan")]
        share = float(np.mean([r["coverage"] for r in own]))
        summary = f"{words[name].format(float(np.median(off)), max(off))}, over {share:.1%} of the pixels of {len(own)} views"
        found[name] = {"views": own, "summary": summary}
    return found


def _row(name: str, at: np.ndarray, off: np.ndarray) -> dict[str, Any]:
    difference = float(np.median(off)) if len(off) else float("nan")
    return {"name": name, "coverage": float(at.mean()), "difference": difference}
