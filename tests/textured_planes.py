"""Photographs of a flat card, computed ray by ray: what a model of it needs is known beforehand."""

from collections.abc import Callable

import numpy as np

from tests.scenes import ring
from warpgs.scene import View

SUPER = 3
"""Rays along each side of a pixel."""
HALF = 0.7, 0.5
"""Half width and height of the card [u]; it stands in the plane z = 0."""


def photos(
    colour: Callable[[np.ndarray, np.ndarray, float], np.ndarray], count: int = 4, width: int = 96, height: int = 72,
    half: tuple[float, float] = HALF, cameras=None,
) -> list[View]:  # fmt: skip
    """Views of a card on black.

    Args:
        colour: Colours [..., 3] from x and y on the card [u] and the camera's place on the arc, -1 to 1.
        count: Number of views.
        width: Of the pictures [px].
        height: Of the pictures [px].
        half: Half width and height of the card [u].
        cameras: Instead of those of `ring`.
    """
    cameras = ring(count, width, height) if cameras is None else cameras
    views = []
    for i, c in enumerate(cameras):
        rows, columns = np.meshgrid(
            (np.arange(SUPER * height) + 0.5) / SUPER, (np.arange(SUPER * width) + 0.5) / SUPER, indexing="ij"
        )
        rays = np.stack([columns, rows, np.ones_like(rows)], -1) @ np.linalg.inv(c.K).T @ c.viewmat[:3, :3]
        center = c.center
        along = -center[2] / rays[..., 2]
        x, y = (center[k] + along * rays[..., k] for k in (0, 1))
        place = center[0] / 2.2 / np.sin(np.radians(35))
        inside = (np.abs(x) <= half[0]) & (np.abs(y) <= half[1]) & (along > 0)
        fine = np.where(inside[..., None], colour(x, y, place), 0)
        image = fine.reshape(height, SUPER, width, SUPER, 3).mean((1, 3))
        views.append(View(f"{i:02d}.png", c, (np.round(255 * image) / 255).astype(np.float32)))
    return views
