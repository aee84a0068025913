"""Gaussians as numpy arrays, on their way between tensors and the bytes of a file format."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from warpgs.errors import DataError
from warpgs.scene import Gaussians

ROWS = 16384
"""Number of Gaussians decoded at a time, so that float64 copies of a whole model never exist."""
Arrays = dict[str, np.ndarray]
"""The five tensors of `Gaussians` by field name, as numpy arrays of any float type, means and log scales in file units."""

SH_SIZES = (1, 4, 9, 16)
"""Numbers of spherical-harmonics coefficients of degrees 0 to 3."""
SQRT2 = 1.4142135623730951
_AXES = ("", "y", "z", "x", "xy", "yz", "", "xz", "", "y", "xyz", "y", "z", "x", "z", "x")
"""Axes that flip the sign of each harmonic, in the order of docs/sh.md."""


def malformed(path: Path, what: str) -> DataError:
    """Return a DataError about a file that does not match its suffix, with the fix."""
    return DataError(
        f"{path}: not a usable {path.suffix or 'model'} file: {what}. Export the model again, or use another format."
    )


def by_rows(n: int, shape: tuple[int, ...], rows: Callable[[slice], np.ndarray]) -> np.ndarray:
    """Return an array, float32 [n, *shape], made of pieces of at most `ROWS` rows that are requested in order.

    Values beyond float32 become infinities, which `gaussians_of` reports.
    """
    out = np.empty((n, *shape), np.float32)
    for part in parts(n):
        out[part] = rows(part)
    return out


def parts(n: int) -> Iterator[slice]:
    """Yield slices of at most `ROWS` rows that make up ``n``."""
    return (slice(start, min(start + ROWS, n)) for start in range(0, n, ROWS))


def arrays_of(gaussians: Gaussians) -> Arrays:
    """Return the tensors of Gaussians as arrays on the CPU."""
    return {name: t.detach().cpu().numpy() for name, t in gaussians.tensors().items()}


def check_finite(path: Path, arrays: Arrays) -> None:
    """Check the values before they are written.

    Raises:
        DataError: A tensor holds a NaN or an infinity; the message names the first such tensor.
    """
    for name, array in arrays.items():
        bad = array.size - int(np.isfinite(array).sum())
        if bad:
            raise DataError(
                f"{path}: not written, {bad} of {array.size} values of {name} are not finite, and no viewer can show them. "
                "Export an earlier checkpoint, or fit again with a lower learning rate."
            )


def gaussians_of(path: Path, arrays: Arrays) -> Gaussians:
    """Return Gaussians of decoded arrays, as float32 tensors.

    Raises:
        DataError: A value is not finite in float32, or a rotation has zero length; the message names the first.
    """
    import torch

    with np.errstate(over="ignore", invalid="ignore"):  # values beyond float32 become infinities, which the error below names
        single = {name: np.ascontiguousarray(array, dtype=np.float32) for name, array in arrays.items()}
    for name, array in single.items():
        for part in parts(len(array)):
            bad = ~np.isfinite(array[part])
            if bad.any():
                row = part.start + int(np.argwhere(bad)[0][0])
                raise malformed(path, f"{name} of Gaussian {row} is not finite in float32")
    zero = ~single["quats"].any(axis=1)
    if zero.any():
        raise malformed(path, f"the rotation of Gaussian {int(np.argmax(zero))} has zero length")
    return Gaussians(**{name: torch.from_numpy(array) for name, array in single.items()})


def sigmoid(logits: np.ndarray) -> np.ndarray:
    """Return 1 / (1 + exp(-x)) in float64 without overflow, in the shape [N] of ``logits``."""
    small = np.exp(-np.abs(logits.astype(np.float64)))
    result: np.ndarray = np.where(logits >= 0, 1, small) / (1 + small)
    return result


def logits(opacities: np.ndarray, quantum: float) -> np.ndarray:
    """Return finite log(p / (1 - p)) [N] in float64; 0 and 1 are moved inwards by a quarter of a quantum."""
    p = np.clip(opacities.astype(np.float64), 0.25 * quantum, 1 - 0.25 * quantum)
    return np.log(p) - np.log1p(-p)


def unit_quats(quats: np.ndarray) -> np.ndarray:
    """Return rotations [N, 4] of length 1 in float64; lengths from 1e-15 to 1e15 are fine, zero becomes the identity."""
    q = quats.astype(np.float64)
    length = np.sqrt((q * q).sum(axis=1, keepdims=True))
    return np.where(length > 0, q / np.where(length > 0, length, 1), [1.0, 0.0, 0.0, 0.0])


def smallest_three(quats: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Split unit quaternions into the index of their largest component and the other three.

    Args:
        quats: Rotations [N, 4], components in any order.

    Returns:
        Index of the largest component, int64 [N], and the other components in their order [N, 3]. Each is at most 1/sqrt(2) in
        magnitude. The sign of the quaternion is chosen so that the largest component is positive.
    """
    q = unit_quats(quats)
    largest = np.abs(q).argmax(axis=1)
    rows = np.arange(len(q))
    q = q * np.where(q[rows, largest] < 0, -1.0, 1.0)[:, None]
    keep = np.arange(4)[None] != largest[:, None]
    return largest, q[keep].reshape(len(q), 3)


def from_smallest_three(largest: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Return the quaternions [N, 4] that `smallest_three` split."""
    q = np.empty((len(others), 4))
    keep = np.arange(4)[None] != largest[:, None]
    q[keep] = others.reshape(-1)
    q[~keep] = np.sqrt(np.clip(1 - (others * others).sum(axis=1), 0, None))
    return q


def half_turn(arrays: Arrays, axis: str) -> Arrays:
    """Turn Gaussians by 180 degrees about a coordinate axis: exact, and its own inverse.

    Args:
        arrays: The Gaussians.
        axis: x (converts between SPZ's axes, RUB, and PLY's, RDF) or z (between PLY's axes and the y-up axes of glTF).
    """
    copies = arrays | {name: np.array(arrays[name]) for name in ("means", "quats", "sh")}
    half_turn_in_place(copies, axis)
    return copies


def half_turn_in_place(arrays: Arrays, axis: str) -> None:
    """Turn arrays of a float type as `half_turn` does, without a copy."""
    turned = {a: 1.0 if a == axis else -1.0 for a in "xyz"}
    signs = np.array([turned[a] for a in "xyz"], np.float32)
    harmonics = np.array([np.prod([turned[a] for a in axes]) for axes in _AXES], np.float32)[: arrays["sh"].shape[1]]
    arrays["means"] *= signs
    arrays["quats"] *= np.concatenate([[1], signs]).astype(np.float32)
    arrays["sh"] *= harmonics[:, None]


def rounded(values: np.ndarray, most: int) -> np.ndarray:
    """Return values [N, ...] rounded to integers and clamped to 0 .. ``most``, int64."""
    return np.clip(np.floor(values + 0.5), 0, most).astype(np.int64)
