"""Statistics of the columns of Gaussians in files, and differences of two such statistics."""

from __future__ import annotations

import numpy as np

from warpgs.export.base import arrays_of, unit_quats
from warpgs.geometry import rotation_matrices
from warpgs.scene import C0, Gaussians

STATISTICS = ("min", "max", "mean", "stdDev")


def statistics(gaussians: Gaussians, axes: bool = False) -> dict[str, list[float]]:
    """Return least, largest, mean and standard deviation of each column, with the names of splat-transform.

    splat-transform computes them from the columns of PLY, and reports scales, opacities and colours after activation.

    Args:
        gaussians: N Gaussians.
        axes: True to report rotations by the magnitudes of the entries of their matrices: several
            quaternions stand for the same Gaussian.
    """
    a = {name: array.astype(np.float64) for name, array in arrays_of(gaussians).items()}
    quats = np.abs(rotation_matrices(unit_quats(a["quats"]))).reshape(-1, 9) if axes else a["quats"]
    rest = a["sh"][:, 1:].transpose(0, 2, 1).reshape(len(gaussians), -1)
    groups = (
        ("xyz", a["means"], lambda v: v), ("rot_", quats, lambda v: v), ("scale_", a["log_scales"], np.exp),
        ("opacity", a["logit_opacities"][:, None], lambda v: 1 / (1 + np.exp(-v))),
        ("f_dc_", a["sh"][:, 0], lambda v: 0.5 + C0 * v), ("f_rest_", rest, lambda v: v),
    )  # fmt: skip
    out = {}
    for name, table, stated in groups:
        for i, column in enumerate(table.T):
            key = name if name == "opacity" else "xyz"[i] if name == "xyz" else f"{name}{i}"
            out[key] = [float(stated(f(column))) for f in (np.min, np.max, np.mean, np.std)]
    return out


def difference(ours: dict[str, list[float]], theirs: dict[str, list[float]]) -> dict:
    """Return the largest difference of two statistics as a fraction of the column's range, and its place."""
    worst = {"largest_of_range": 0.0, "column": "", "columns": len(ours), "same_columns": set(ours) <= set(theirs)}
    for name in (n for n in ours if n in theirs):
        low, high = ours[name][:2]
        for which, a, b in zip(STATISTICS, ours[name], theirs[name]):
            found = abs(a - b) / (high - low if high > low else max(abs(low), 1e-30))
            if found > worst["largest_of_range"]:
                worst |= {"largest_of_range": found, "column": f"{name} {which}"}
    return worst
