"""The .splat format of antimatter15's viewer: 32 bytes a Gaussian, without spherical harmonics above degree 0.

Position and axis lengths as float32, colour and opacity as bytes, rotation wxyz as bytes (128 is 0). Axes are those of PLY.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from warpgs.colors import base_coefficients, base_colors
from warpgs.export.arrays import Arrays, by_rows, logits, malformed, parts, rounded, sigmoid, unit_quats
from warpgs.export.base import Format, register

_ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])
_TINY = 1e-37
"""Least axis length that is written and read: the logarithm of 0 is not finite."""


def encode(arrays: Arrays) -> list[bytes]:
    """Return the bytes of a file; harmonics above degree 0 are lost, and colours outside of [0, 1] clamped."""
    rows = np.empty(len(arrays["means"]), _ROW)
    rows["mean"] = arrays["means"]
    rows["scale"] = np.clip(np.exp(arrays["log_scales"].astype(np.float64)), _TINY, 3e38)
    rows["rgba"][:, :3] = rounded(255 * base_colors(arrays["sh"][:, :1].astype(np.float64)), 255)
    rows["rgba"][:, 3] = rounded(255 * sigmoid(arrays["logit_opacities"]), 255)
    rows["quat"] = rounded(128 * unit_quats(arrays["quats"]) + 128, 255)
    return [rows.tobytes()]


def decode(path: Path, data: bytes) -> Arrays:
    """Return the Gaussians of a file's bytes.

    Raises:
        DataError: The file is empty, its size is not a multiple of 32 bytes, or an axis length is negative.
    """
    if not data:
        raise malformed(path, "it is empty")
    if len(data) % _ROW.itemsize:
        raise malformed(path, f"its {len(data)} bytes are not a multiple of {_ROW.itemsize}")
    rows = np.frombuffer(data, _ROW)
    n = len(rows)
    for part in parts(n):
        if (rows["scale"][part] < 0).any():
            row = part.start + int(np.argwhere(rows["scale"][part] < 0)[0][0])
            raise malformed(path, f"an axis of Gaussian {row} has a negative length")
    return {
        "means": by_rows(n, (3,), lambda p: rows["mean"][p]),
        "quats": by_rows(n, (4,), lambda p: (rows["quat"][p].astype(np.float64) - 128) / 128),
        "log_scales": by_rows(n, (3,), lambda p: np.log(np.maximum(rows["scale"][p].astype(np.float64), _TINY))),
        "logit_opacities": by_rows(n, (), lambda p: logits(rows["rgba"][p, 3] / 255, 1 / 255)),
        "sh": by_rows(n, (1, 3), lambda p: base_coefficients(rows["rgba"][p, None, :3].astype(np.float64) / 255)),
    }


@register("splat")
class Splat(Format):
    """The .splat format."""

    suffix = ".splat"
    description = "antimatter15, 8 bits, no view-dependent colours; small viewers"
    max_degree = 0
    encode = staticmethod(encode)
    decode = staticmethod(decode)
