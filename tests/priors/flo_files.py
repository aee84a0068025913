"""Flow files as other programs write them."""

from pathlib import Path

import numpy as np


def write_flo(path: Path, flow: np.ndarray) -> None:
    """Write flow [H, W, 2] in the format of Baker et al. 2011 (vision.middlebury.edu/flow); NaN becomes 1e10, unknown."""
    height, width = flow.shape[:2]
    values = np.where(np.isfinite(flow).all(2, keepdims=True), flow, 1e10)
    path.write_bytes(b"PIEH" + np.array([width, height], "<i4").tobytes() + values.astype("<f4").tobytes())
