"""Images with true alpha over other backgrounds, and scores of Gaussians without a background over each."""

from __future__ import annotations

import numpy as np
import torch

import warpgs
from warpgs.pipeline.metrics.scores import psnr, to_8_bit
from warpgs.scene import Gaussians, View

SQUARE = 12
"""Side of a square of the pattern [px]."""
PATTERN = ((0.9, 0.75, 0.2), (0.15, 0.3, 0.6))
"""Colours of the pattern's squares."""


def backgrounds(height: int, width: int) -> dict[str, np.ndarray]:
    """Return background images by name, colours in [0, 1], float32, shape [H, W, 3] each."""
    odd = (np.indices((height, width)) // SQUARE).sum(0) % 2 == 1
    pattern = np.where(odd[..., None], *(np.array(c, np.float32) for c in PATTERN))
    plain = {name: np.full((height, width, 3), value, np.float32) for name, value in (("black", 0), ("white", 1))}
    return plain | {"pattern": pattern.astype(np.float32)}


def over(view: View, behind: np.ndarray, ours: tuple[float, float, float]) -> np.ndarray:
    """Return a view's image [H, W, 3] over a background [H, W, 3] or [3] other than its own."""
    shown: np.ndarray = view.image + (1 - view.alpha[..., None]) * (behind - np.float32(ours))
    return np.clip(shown, 0, 1)


@torch.no_grad()
def ply_scores(gaussians: Gaussians, views: list[View], own: tuple[float, float, float]) -> dict[str, float]:
    """Return the mean PSNR [dB] over each background of Gaussians rendered as a viewer does, without their own background."""
    found: dict[str, list[float]] = {}
    for view in views:
        r = warpgs.rasterize(gaussians, view.camera)  # over black
        image, alpha = r.rgb.cpu().numpy(), r.alpha.cpu().numpy()[..., None]
        for name, behind in backgrounds(*alpha.shape[:2]).items():
            pair = (to_8_bit(image + (1 - alpha) * behind), to_8_bit(over(view, behind, own)))
            found.setdefault(f"ply_{name}", []).append(psnr(*pair))
    return {name: float(np.mean(values)) for name, values in found.items()}
