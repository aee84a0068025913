"""Opacity decay in numpy and float64, by the opacities themselves."""

import numpy as np


def decayed(logits: np.ndarray, factor: float) -> np.ndarray:
    """Logits of the opacities of ``logits`` times a factor."""
    opacity = factor / (1 + np.exp(-logits.astype(float)))
    return np.log(opacity) - np.log1p(-opacity)
