"""Choice of the grid: its extent, its voxel size, and its memory."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch

from warpgs.errors import DataError, ResourceError, UsageError
from warpgs.runtime.byte_units import format_bytes
from warpgs.runtime.device_memory import available_bytes
from warpgs.runtime.interop import MAX_SIZE

RESOLUTION = 256
"""Voxels along the longest side of the box around the surfaces, if neither ``voxel`` nor ``resolution`` is given."""
MIN_RESOLUTION, MAX_RESOLUTION = 8, 4096
TRUNCATION = 4.0
"""Largest distance from a surface that the grid stores, in voxels."""
FENCE = 3.0
"""Distance outside the quartiles, in interquartile ranges, beyond which a coordinate is an outlier (Tukey, 1977: Exploratory
Data Analysis)."""
QUANTILES = (0.005, 0.995)
"""Quantiles of the surface points' coordinates; they bound the grid along each axis, unless `FENCE` bounds it more tightly."""
GRID_BYTES = 8
"""Bytes of a grid point on the device: distance and weight."""
HOST_BYTES = 14
"""Bytes of a grid point in main memory while triangles are made: two copies of the distances, the weights, and two masks."""


@dataclass(frozen=True)
class GridPlan:
    """A regular grid of points, parallel to the axes of the world."""

    origin: tuple[float, float, float]
    """Position of the first point [u]."""
    voxel: float
    """Distance from one point to the next [u]."""
    shape: tuple[int, int, int]
    """Number of points along each axis."""
    inside: float
    """Fraction of the surface points inside the grid."""

    @property
    def points(self) -> int:
        """Number of points."""
        return math.prod(self.shape)

    @property
    def truncation(self) -> float:
        """Largest distance from a surface that is stored [u]."""
        return TRUNCATION * self.voxel


def find_box(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the lower and upper corner, shape [3] each, of the box around points, except outliers along each axis.

    Points far behind all others, such as a background at infinity, are cut off.

    Args:
        points: Positions [u], shape [N, 3].
    """
    first, third = np.quantile(points, [0.25, 0.75], axis=0)
    low, high = np.quantile(points, QUANTILES, axis=0)
    return np.maximum(low, first - FENCE * (third - first)), np.minimum(high, third + FENCE * (third - first))


def plan_grid(
    points: np.ndarray, footprints: np.ndarray, voxel: float | None = None, resolution: int | None = None
) -> GridPlan:
    """Choose the grid that holds the surfaces which cameras see.

    Args:
        points: Points of the surfaces [u], shape [N, 3].
        footprints: Width of a pixel at each point [u], shape [N].
        voxel: Distance between neighbouring grid points [u]; None to derive it from ``resolution``.
        resolution: Voxels along the longest side; None for `RESOLUTION`, or fewer where a voxel would be smaller than half of
            the median footprint.

    Raises:
        DataError: No camera sees a surface.
        UsageError: ``voxel`` is not positive, or too small for the extent of the points.
    """
    if not len(points):
        raise DataError(
            "no training view shows a surface: alpha is below 0.5 or depth uncertain everywhere; fit again with more steps"
        )
    low, high = find_box(points)
    longest = float((high - low).max())
    if voxel is None:
        voxel = longest / (RESOLUTION if resolution is None else resolution)
        if resolution is None:
            voxel = max(voxel, float(np.median(footprints)) / 2)
    if not (voxel > 0 and longest / voxel <= 2**20):
        raise UsageError("--voxel must be at least a millionth of the longest side of the scene")
    margin = 2 * TRUNCATION * voxel
    shape = tuple(int(n) for n in np.ceil((high - low + 2 * margin) / voxel) + 1)
    inside = ((points >= low - margin) & (points <= high + margin)).all(1).mean()
    x, y, z = low - margin
    return GridPlan((float(x), float(y), float(z)), voxel, (shape[0], shape[1], shape[2]), float(inside))


def check_memory(plan: GridPlan, device: torch.device) -> str:
    """Return how much memory a grid takes, as text, before it is allocated.

    Raises:
        ResourceError: The grid needs more than 80 % of the free memory, or has more points than kernels can index.
    """
    cpu = torch.device("cpu")
    needs = {device: plan.points * GRID_BYTES}
    needs[cpu] = needs.get(cpu, 0) + plan.points * HOST_BYTES
    sizes = " x ".join(map(str, plan.shape))
    remedy = "give a larger --voxel or a smaller --resolution"
    if plan.points > MAX_SIZE:
        raise ResourceError(f"a grid of {sizes} points is beyond the {MAX_SIZE:,} that kernels can index; {remedy}")
    for where, needed in needs.items():
        free = available_bytes(where)
        if needed > 0.8 * free:
            raise ResourceError(
                f"a grid of {sizes} points takes {format_bytes(needed)} of memory on {where}, more than 80 % of the free "
                f"{format_bytes(free)}; {remedy}"
            )
    return format_bytes(sum(needs.values()))
