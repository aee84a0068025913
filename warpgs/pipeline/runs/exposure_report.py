"""Exposures of a run's training views, and what is told of them and of its held-out views."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from warpgs.pipeline.metrics.evaluate import render_view
from warpgs.pipeline.metrics.matched_psnr import RULE, matched_psnr
from warpgs.pipeline.train.exposure import CHANNELS, exposure_of
from warpgs.render.rasterize import RasterizeOptions
from warpgs.scene import Gaussians, View

GRAY = 0.5
"""Gray whose brightness under an exposure is told."""


def exposure_figures(
    names: Sequence[str], rows: torch.Tensor, test: Sequence[View], gaussians: Gaussians, options: RasterizeOptions
) -> dict[str, Any]:
    """Return what exposures were learned, as metrics.json holds them.

    Args:
        names: Names of the training views, in the order of the fit.
        rows: Their parameters, shape [V, 12].
        test: Held-out views.
        gaussians: The fitted model.
        options: Options of the rasterizer.

    Returns:
        ``views``, for each training view [A | b] as 3 rows of 4 and its ``gain``, the mean over channels of what a middle gray
        becomes, over that gray; ``matched_psnr``, the mean over held-out views [dB], None without any; and ``summary``.
    """
    numbers = exposure_of(rows.double(), rows.double()).detach().cpu().numpy().reshape(-1, CHANNELS, CHANNELS + 1)
    maps = numbers + np.eye(CHANNELS, CHANNELS + 1)
    gains = (maps[..., :CHANNELS].sum(-1) + maps[..., CHANNELS] / GRAY).mean(-1)
    views = [{"name": n, "affine": m.tolist(), "gain": float(g)} for n, m, g in zip(names, maps, gains, strict=True)]
    summary = (
        f"exposures learned: the training views show a middle gray {gains.min():.2f} to {gains.max():.2f} times as bright as "
        "the model, whose colours are those of their mean exposure; every score is of renders without an exposure"
    )
    scores = [s for v in test if np.isfinite(s := matched_psnr(v, render_view(gaussians, v, options)[0]))]
    mean = float(np.mean(scores)) if scores else None
    if mean is not None:
        summary += f"; held-out PSNR {mean:.2f} dB {RULE}"
    return {"views": views, "matched_psnr": mean, "summary": summary}
