"""Filters of a finished model: crop to a box, remove floaters and needles, drop harmonics, rotate."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from warpgs.errors import DataError, UsageError
from warpgs.geometry import matmul, quaternions, rotation_matrices
from warpgs.input_files import read_input, unread_reason
from warpgs.kernels.sh import MAX_DEGREE, basis
from warpgs.pipeline.model.coverage import SEEN
from warpgs.pipeline.model.scale_limits import NEEDLE, ROUNDING, long_axes
from warpgs.scene import Gaussians

INNER = 0.02
"""Fraction of the means that is left out at each end of each axis when the size of the scene is measured."""
NEEDLE_LENGTH = 0.2
"""A Gaussian beyond the ratio `NEEDLE` is removed if it is longer than this fraction of the scene's size: shorter needles are
hairs and edges of a good model. With a tenth instead, removal costs up to 0.08 dB on held-out views
(docs/decisions/014-formats.md)."""
MAX_BOX_BYTES = 65536
"""Largest size of a file that describes a box [bytes]."""
_NODES = ((0.0, 0.5688888888888889), (0.5384693101056831, 0.47862867049936647), (0.906179845938664, 0.23692688505618908))
"""Nodes and weights of the Gauss-Legendre rule with five points, the last two also mirrored: exact to degree 9."""
_AZIMUTHS = 10
"""Number of azimuths of the quadrature rule, exact to order 9; products of harmonics of degree 4 have degree 8."""


@dataclass(frozen=True)
class Box:
    """A box with any orientation."""

    center: tuple[float, float, float]
    """Middle [file units]."""
    size: tuple[float, float, float]
    """Full lengths of the sides [file units]."""
    rotation: tuple[tuple[float, ...], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    """Rotation matrix, shape [3, 3]; its columns are the directions of the sides in the world."""


def _numbers(value: Any, shape: tuple[int, ...], what: str) -> np.ndarray:
    """Return finite numbers of a shape; UsageError if ``value`` is anything else."""
    try:
        array = np.array(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        raise UsageError(f"--crop: {what} takes {' x '.join(map(str, shape))} finite numbers, not {str(value)[:60]}")
    return array


def box_of(text: str) -> Box:
    """Return the box of a user's text.

    Args:
        text: JSON with center, size and optionally rotation; the name of a .json file with this JSON; or six numbers separated
            by commas: the least x, y, z and the largest x, y, z.

    Raises:
        DataError: The file cannot be read, or does not describe a box.
        UsageError: The text is invalid, or a side is not longer than 0.
    """
    if text.lower().endswith(".json"):
        return _box_of_file(Path(text))
    try:
        value = json.loads(text if text.lstrip().startswith("{") else f"[{text}]")
    except (ValueError, RecursionError) as e:
        forms = "six numbers separated by commas, JSON with center and size, or a .json file"
        raise UsageError(f"--crop {text[:60]}: give {forms}") from e
    if isinstance(value, list):
        low, high = _numbers(value, (6,), "a box").reshape(2, 3)
        center, size, rotation = (low + high) / 2, high - low, np.eye(3)
    else:
        center, size = (_numbers(value.get(key), (3,), key) for key in ("center", "size"))
        rotation = _numbers(value.get("rotation", np.eye(3).tolist()), (3, 3), "rotation")
        if np.abs(matmul(rotation, rotation.T) - np.eye(3)).max() > 1e-3:
            raise UsageError(
                "--crop: rotation must be a rotation matrix: its columns are not perpendicular, or not of length 1"
            )
    if not (size > 0).all():
        raise UsageError(f"--crop: the box has sides of {', '.join(f'{s:g}' for s in size)}; each must be longer than 0")
    a, b, c = (tuple(map(float, v)) for v in (center, size, rotation[0]))
    return Box(a, b, (c, tuple(map(float, rotation[1])), tuple(map(float, rotation[2]))))  # type: ignore[arg-type]


def _box_of_file(path: Path) -> Box:
    """Return the box of a JSON file, as the viewer saves it; DataError if the file has no box."""
    try:
        text = read_input(path, MAX_BOX_BYTES).decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as e:
        why = unread_reason(e) if isinstance(e, OSError) else e
        raise DataError(f"{path}: cannot be read as a box ({why}); give a JSON file with center and size") from e
    try:
        if not text.lstrip().startswith("{"):
            raise UsageError("expected a JSON object with center and size")
        return box_of(text)
    except UsageError as e:
        raise DataError(f"{path}: not a box ({e}); save the box again in the viewer") from e


def select(gaussians: Gaussians, keep: torch.Tensor) -> Gaussians:
    """Return the Gaussians selected by ``keep``, bool [N] or rows [K]."""
    return Gaussians(**{name: t[keep] for name, t in gaussians.tensors().items()})


def inside(gaussians: Gaussians, box: Box) -> torch.Tensor:
    """Return whether each mean is in a box, bool [N]; box and Gaussians are in the same units."""
    offsets = gaussians.means.double() - torch.tensor(box.center, dtype=torch.float64, device=gaussians.means.device)
    directions = np.array(box.rotation).T
    out = torch.ones(len(gaussians), dtype=torch.bool, device=offsets.device)
    for direction, side in zip(directions, box.size):
        along = sum(float(d) * offsets[:, i] for i, d in enumerate(direction))
        out &= along.abs() <= side / 2
    return out


def disturbing(gaussians: Gaussians, maxima: torch.Tensor | None = None) -> dict[str, torch.Tensor]:
    """Return the floaters and needles, each under the first reason that applies, bool [N] by reason.

    Args:
        gaussians: N Gaussians.
        maxima: Largest blending weight of each over all training views, shape [N]; None without views.
    """
    out = {}
    free = torch.ones(len(gaussians), dtype=torch.bool, device=gaussians.means.device)
    if not len(gaussians):
        return out
    means = gaussians.means.double().cpu().numpy()
    low, high = np.quantile(means, [INNER, 1 - INNER], axis=0)
    size = max(math.sqrt(float(((high - low) ** 2).sum())), 1e-30)
    longest, middle = long_axes(gaussians.log_scales.double())
    needle = longest - middle > math.log(NEEDLE) + ROUNDING  # a fit holds many at the ratio itself
    found = {
        "larger than the scene": longest > math.log(size),
        f"needles over {NEEDLE:g} times as long as wide": needle & (longest > math.log(NEEDLE_LENGTH * size)),
    }
    if maxima is not None:
        found = {"seen by no training view": maxima < SEEN} | found
    for reason, where in found.items():
        out[reason] = where & free
        free &= ~where
    return out


def limit_degree(gaussians: Gaussians, degree: int) -> Gaussians:
    """Return the same Gaussians without the harmonics above a degree.

    Raises:
        UsageError: The degree is not 0 to 4.
    """
    if not 0 <= degree <= MAX_DEGREE:
        raise UsageError(f"--sh-degree {degree}: harmonics have degrees 0 to {MAX_DEGREE}")
    return replace(gaussians, sh=gaussians.sh[:, : (degree + 1) ** 2].contiguous())


def harmonics_rotation(rotation: np.ndarray) -> torch.Tensor:
    """Return the matrix that rotates coefficients with the scene, float64 [25, 25] (Wigner's D for degrees 0 to 4, real).

    Entry (j, k) is the integral over the sphere of Y_j(d) Y_k(R^T d), exact by a product rule of 50 points.

    Args:
        rotation: The rotation, shape [3, 3].
    """
    nodes = [*_NODES, *((-z, w) for z, w in _NODES[1:])]
    points, weights = [], []
    for z, weight in nodes:
        for i in range(_AZIMUTHS):
            angle, radius = 2 * math.pi * i / _AZIMUTHS, math.sqrt(1 - z * z)
            points.append([radius * math.cos(angle), radius * math.sin(angle), z])
            weights.append(weight * 2 * math.pi / _AZIMUTHS)
    d = np.array(points)
    here, there = (basis(torch.from_numpy(p)).numpy() for p in (d, matmul(d, np.asarray(rotation, np.float64))))
    return torch.from_numpy(np.einsum("i,ij,ik->jk", np.array(weights), here, there))


def rotate(gaussians: Gaussians, rotation: np.ndarray) -> Gaussians:
    """Return Gaussians rotated about the origin: means, shapes and the directions that colours depend on.

    Args:
        gaussians: N Gaussians.
        rotation: Rotation matrix, new from old coordinates, shape [3, 3].
    """
    like = {"dtype": torch.float64, "device": gaussians.means.device}
    turn = torch.tensor(np.asarray(rotation), **like)
    k = gaussians.sh.shape[1]
    harmonics = harmonics_rotation(rotation).to(like["device"])[:k, :k]
    quats = torch.nn.functional.normalize(gaussians.quats.double(), dim=1)
    turned = torch.einsum("ij,njk->nik", turn, torch.as_tensor(rotation_matrices(quats)))
    return Gaussians(
        means=torch.einsum("ij,nj->ni", turn, gaussians.means.double()).to(gaussians.means.dtype),
        quats=quaternions(turned).to(gaussians.quats.dtype),
        log_scales=gaussians.log_scales,
        logit_opacities=gaussians.logit_opacities,
        sh=torch.einsum("jk,nkc->njc", harmonics, gaussians.sh.double()).to(gaussians.sh.dtype),
    )


def rotation_about(axis: np.ndarray, angle: float) -> np.ndarray:
    """Return the rotation [3, 3] by an angle [rad] about an axis [3] of any length (Rodrigues).

    Raises:
        UsageError: The axis has length 0, or a number is not finite.
    """
    length = math.sqrt(float((np.asarray(axis) ** 2).sum()))
    if not (math.isfinite(length) and length > 0 and math.isfinite(angle)):
        raise UsageError("--rotate: the axis has length 0, or a number is not finite")
    x, y, z = np.asarray(axis, np.float64) / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * matmul(cross, cross)


def levelling(up: np.ndarray) -> np.ndarray:
    """Return the rotation [3, 3] that turns an upward direction [3] to -y, which is up in PLY files, by the shortest way."""
    u = np.asarray(up, np.float64) / math.sqrt(float((np.asarray(up) ** 2).sum()))
    axis = np.cross(u, [0.0, -1.0, 0.0])
    angle = math.atan2(math.sqrt(float((axis**2).sum())), -float(u[1]))
    return rotation_about(axis if angle % math.pi > 1e-12 else np.array([1.0, 0.0, 0.0]), angle)
