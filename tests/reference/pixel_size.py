"""Sizes of a pixel at Gaussians, in numpy and float64."""

import numpy as np


def log_pixel(means: np.ndarray, cameras: np.ndarray, fraction: float, smallest: float) -> np.ndarray:
    """Logarithm of a fraction of the smallest pixel at each mean [N, 3] of the cameras [C, 9] that see it.

    Angles from the axis are compared with that of the cone; ``smallest`` stands for the size where none sees it.
    """
    rows = cameras.astype(float)
    away = means.astype(float)[:, None] - rows[None, :, :3]
    distances = np.linalg.norm(away, axis=2)
    depths = np.einsum("ncx,cx->nc", away, rows[:, 3:6])
    angles = np.arccos(np.clip(depths / np.maximum(distances, 1e-300), -1, 1))
    sizes = np.where(rows[:, 8] == 1, distances, depths) / rows[:, 6]
    seen = np.where(angles <= np.arccos(rows[:, 7]), sizes, np.inf).min(1)
    return np.log(np.maximum(np.where(np.isfinite(seen), fraction * seen, 0.0), smallest))
