"""Opacity dropout in numpy: the factors there are, and how often each occurs."""

import numpy as np


def expected_factors(p: float) -> tuple[np.ndarray, np.ndarray]:
    """The values a factor takes, and their probabilities; their mean is 1."""
    return np.array([0.0, 1 / (1 - p)]), np.array([p, 1 - p])
