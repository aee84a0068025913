"""Whether two tables hold the same Gaussians, and two lists the same points, up to what changes no image."""

import numpy as np

from warpgs.export.base import Arrays, half_turn, sigmoid, unit_quats

NAMES = ("means", "quats", "log_scales", "opacities", "sh0", "sh")


def matched(ours: Arrays, theirs: Arrays) -> tuple[str, np.ndarray]:
    """Return the axis of the half turn from their axes to ours, and the row of theirs [N] that is each of our Gaussians."""
    from scipy.spatial import cKDTree

    n, some = len(ours["means"]), slice(None, None, 1 + len(ours["means"]) // 500)
    turned = {axis: half_turn(theirs, axis) if axis else theirs for axis in ("", "x", "y", "z")}
    axis = min(turned, key=lambda a: float(cKDTree(turned[a]["means"]).query(ours["means"][some])[0].mean()))
    if np.abs(turned[axis]["means"] - ours["means"]).max() < 1e-3:
        return axis, np.arange(n)
    columns = [np.concatenate([a["means"], a["log_scales"], a["sh"][:, 0]], 1) for a in (ours, turned[axis])]
    return axis, cKDTree(columns[1] / (size := 1e-3 + columns[0].std(0))).query(columns[0] / size)[1]


def turns_apart(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Return differences [N] of rotations, up to sign and half turns about an ellipsoid's own axes, which change nothing."""
    w, x, y, z = unit_quats(q).T
    same = [np.stack(v, 1) for v in ((w, x, y, z), (-x, w, z, -y), (-y, -z, w, x), (-z, y, -x, w))]
    return np.min([np.abs(unit_quats(p) - sign * v).max(1) for v in same for sign in (1, -1)], axis=0)


def compared(ours: Arrays, theirs: Arrays, steps: dict[str, float], turned: str = "") -> dict:
    """Return axes, order, the largest differences of two tables of the same Gaussians, and what follows."""
    if len(ours["means"]) != len(theirs["means"]):
        return {"verdict": f"{len(theirs['means'])} instead of {len(ours['means'])} Gaussians"}
    axis, rows = matched(ours, theirs)
    b = {name: array[rows] for name, array in (half_turn(theirs, axis) if axis else theirs).items()}
    k = min(ours["sh"].shape[1], b["sh"].shape[1])
    found = {
        "means": ours["means"] - b["means"],
        "quats": turns_apart(ours["quats"], b["quats"]),
        "log_scales": ours["log_scales"] - b["log_scales"],
        "opacities": sigmoid(ours["logit_opacities"]) - sigmoid(b["logit_opacities"]),
        "sh0": ours["sh"][:, 0] - b["sh"][:, 0],
    } | ({"sh": ours["sh"][:, 1:k] - b["sh"][:, 1:k]} if k > 1 else {})
    largest = {name: float(np.abs(values).max()) for name, values in found.items()}
    coarse = [name for name, most in largest.items() if not most <= steps[name]]
    verdict = "other values: " + ", ".join(coarse) if coarse else "same" if axis == turned else f"turned about {axis or turned}"
    order = "same" if (rows == np.arange(len(rows))).all() else "other"
    return {"order": order, "coefficients": k, "largest": largest, "steps": steps, "verdict": verdict}


def rigid(a: np.ndarray, b: np.ndarray) -> float:
    """Return the largest distance of points [N, 3] from others after the best rotation; a mirror image is far."""
    p, q = a - a.mean(0), b - b.mean(0)
    u, _, v = np.linalg.svd(p.T @ q)
    return float(np.abs(p @ u @ np.diag([1, 1, np.linalg.det(u @ v)]) @ v - q).max())
