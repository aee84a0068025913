"""Distances to neighbours and cameras, and sizes of a pixel, in float64."""

import numpy as np
import torch

# Nearest neighbours by all pairwise distances.


def mean_square_distances_reference(points: torch.Tensor, k: int) -> torch.Tensor:
    """Mean squared distance [N] of points [N, 3] to their min(k, N - 1) nearest others."""
    squared = ((points[:, None] - points[None]) ** 2).sum(-1)
    squared.fill_diagonal_(float("inf"))
    k = min(k, len(points) - 1)
    return squared.sort(dim=1).values[:, :k].mean(1) if k > 0 else torch.zeros(len(points), dtype=points.dtype)


# Sizes at which Gaussians reach no camera, in numpy and float64.


def log_reach(means: np.ndarray, centers: np.ndarray, fraction: float, smallest: float) -> np.ndarray:
    """Logarithm of a fraction of the distance of each mean [N, 3] to the nearest camera [C, 3], at least the smallest's."""
    distances = np.linalg.norm(means.astype(float)[:, None] - centers.astype(float)[None], axis=2)
    return np.log(np.maximum(fraction * distances.min(1), smallest))


# Sizes of a pixel at Gaussians, in numpy and float64.


def log_pixel(means: np.ndarray, cameras: np.ndarray, fraction: float, smallest: float) -> np.ndarray:
    """Log of a fraction of the smallest pixel at each mean [N, 3] of the cameras [C, 9] that see it, or of ``smallest``."""
    rows = cameras.astype(float)
    away = means.astype(float)[:, None] - rows[None, :, :3]
    distances = np.linalg.norm(away, axis=2)
    depths = np.einsum("ncx,cx->nc", away, rows[:, 3:6])
    angles = np.arccos(np.clip(depths / np.maximum(distances, 1e-300), -1, 1))
    sizes = np.where(rows[:, 8] == 1, distances, depths) / rows[:, 6]
    seen = np.where(angles <= np.arccos(rows[:, 7]), sizes, np.inf).min(1)
    return np.log(np.maximum(np.where(np.isfinite(seen), fraction * seen, 0.0), smallest))
