"""Sizes at which Gaussians reach no camera, in numpy and float64."""

import numpy as np


def log_reach(means: np.ndarray, centers: np.ndarray, fraction: float, smallest: float) -> np.ndarray:
    """Logarithm of a fraction of the distance of each mean [N, 3] to the nearest camera [C, 3], at least the smallest's."""
    distances = np.linalg.norm(means.astype(float)[:, None] - centers.astype(float)[None], axis=2)
    return np.log(np.maximum(fraction * distances.min(1), smallest))
