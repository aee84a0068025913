"""Photographs of a flat card, computed ray by ray: what a model of it needs is known beforehand."""

from collections.abc import Callable

import numpy as np

from tests.scenes import ring
from warpgs.scene import PointCloud, View

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


def points(count: int = 400, half: tuple[float, float] = HALF) -> PointCloud:
    """Gray points on the card."""
    generator = np.random.default_rng(1)
    at = generator.uniform(-1, 1, (count, 3)) * [*half, 0]
    return PointCloud(at, np.full((count, 3), 0.5, np.float32))


def plain(x: np.ndarray, y: np.ndarray, place: float) -> np.ndarray:
    """One colour."""
    return np.broadcast_to([0.8, 0.3, 0.2], (*x.shape, 3))


def smooth(x: np.ndarray, y: np.ndarray, place: float) -> np.ndarray:
    """A slow gradient of colour."""
    return np.stack([0.5 + 0.3 * np.sin(2 * x), 0.5 + 0.3 * np.cos(3 * y), 0.4 + 0.2 * x * y], -1)


def waves(x: np.ndarray, y: np.ndarray, place: float) -> np.ndarray:
    """Slow waves in several directions."""
    red = 0.5 + 0.2 * np.sin(1.3 * x + 0.7 * y) + 0.15 * np.cos(2.1 * y - 1.1 * x)
    return np.stack([red, 0.45 + 0.25 * np.cos(1.7 * x - 0.4 * y), 0.5 + 0.2 * np.sin(2.3 * y) * np.cos(0.9 * x)], -1)


def rings(x: np.ndarray, y: np.ndarray, place: float) -> np.ndarray:
    """Slow rings around the middle."""
    r = np.sqrt(x * x + y * y + 0.05)
    return np.stack([0.5 + 0.3 * np.cos(2.2 * r), 0.5 + 0.25 * np.sin(1.8 * r + 0.5), 0.35 + 0.2 * np.cos(1.2 * r - 0.3)], -1)


def half_mirror(x: np.ndarray, y: np.ndarray, place: float) -> np.ndarray:
    """Left a matt pattern, right a pattern whose brightness goes with the direction it is seen from."""
    pattern = 0.5 + 0.25 * np.sin(25 * x) * np.cos(25 * y)
    right = np.clip(pattern + 0.35 * place, 0, 1)
    return np.stack([np.where(x > 0, right, pattern)] * 3, -1)
