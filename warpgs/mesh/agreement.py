"""Agreement of views on depth: a mesh omits a point if other views see surfaces there, but none at the point's depth.

A fit of few views constrains depth only where two views look. If only one view sees a surface, such as beside an occluding
edge, the surface's depth is unconstrained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from warpgs.constants import NEAR
from warpgs.geometry import relative_pose
from warpgs.mesh.surface_views import SurfaceView
from warpgs.priors.view_choice import matching_views, shared_sight
from warpgs.scene import Camera

TOLERANCE = 0.02
"""Largest difference of two depths of one surface, as a fraction of the depth; scores of coverage use the same limit (decision
019)."""
NEIGHBOURS = 16
"""Largest number of views that each view is compared with: the nearest that see the same surface from another angle."""
MAX_PIXELS = 2**26
"""Largest number of depths in all maps together, 256 MiB; if images have more pixels, maps store every ``step``-th pixel."""
BOUNDS = (0.02, 0.98)
"""Quantiles of a view's depths that are used as the depths of the nearest and farthest surface."""


@dataclass(frozen=True)
class DepthMap:
    """Depth of one view, kept to compare other views with."""

    camera: Camera
    """Pinhole camera of the whole image, arrays of numpy."""
    depth: torch.Tensor
    """z-depth [u] of every ``step``-th pixel of every ``step``-th row, 0 without a surface, shape [h, w]."""
    step: int
    """Pixels from one stored depth to the next."""
    bounds: tuple[float, float]
    """Smallest and largest depth [u] of the surface, without outliers (`BOUNDS`)."""


def depth_map(view: SurfaceView, views: int) -> DepthMap:
    """Return the depth of a view for comparisons.

    Args:
        view: The view.
        views: Number of views with a depth map.
    """
    step = max(1, int(np.ceil((view.depth.numel() * views / MAX_PIXELS) ** 0.5)))
    depth = view.depth[step // 2 :: step, step // 2 :: step]
    depth = torch.where(torch.isfinite(depth), depth, 0).contiguous()
    known = depth[depth > 0].cpu().numpy()
    near, far = np.quantile(known, BOUNDS) if len(known) else (1.0, 1.0)
    return DepthMap(view.camera, depth, step, (float(near), max(float(far), float(near) * 1.01)))


def neighbours(maps: Sequence[DepthMap]) -> list[list[int]]:
    """Return the views that each view is compared with, by index, nearest first."""
    cameras = [m.camera for m in maps]
    sight = shared_sight(cameras, [m.bounds for m in maps])
    return [matching_views(sight, cameras, i, NEIGHBOURS, range(len(maps))) for i in range(len(maps))]


def agreed(view: SurfaceView, others: Sequence[DepthMap]) -> SurfaceView:
    """Return a view without the depths that no other view confirms.

    A depth is kept if at least one other view has a surface within `TOLERANCE` of the depth's point. A depth is also kept if
    its point projects onto no surface in any other view, such as outside of all other images. So a single view keeps all its
    depths.

    Args:
        view: The view.
        others: Depth maps of the views to compare with.
    """
    shown = torch.isfinite(view.depth) & (view.depth > 0)
    confirmed, questioned = torch.zeros_like(shown), torch.zeros_like(shown)
    for other in others:
        difference = _difference(torch.where(shown, view.depth, 0), view.camera, other)
        confirmed |= difference <= TOLERANCE
        questioned |= torch.isfinite(difference)
    kept = confirmed | ~questioned | ~shown
    return replace(view, depth=torch.where(kept, view.depth, 0), weights=torch.where(kept, view.weights, 0))


def _difference(depth: torch.Tensor, camera: Camera, other: DepthMap) -> torch.Tensor:
    """Return how far one view's points are from another view's surface in depth, as a fraction of depth, shape [H, W].

    A point is compared with the nearest of the four depths around its projection, since depth varies within a pixel on a
    slanted surface. The result is infinite where the pixel has no depth, outside of the other image, and where all four depths
    are missing. No product of matrices is used: its bits would depend on the processor.
    """
    rotation, translation = relative_pose(camera, other.camera)
    height, width = depth.shape
    rows, columns = (torch.arange(n, dtype=depth.dtype, device=depth.device) + 0.5 for n in (height, width))
    x = (columns - float(camera.K[0, 2])) / float(camera.K[0, 0])
    y = (rows - float(camera.K[1, 2])) / float(camera.K[1, 1])
    px, py, z = (
        depth * (x[None] * float(r[0]) + (y[:, None] * float(r[1]) + float(r[2]))) + float(t)
        for r, t in zip(rotation, translation)
    )
    ahead = (depth > 0) & (z > NEAR)
    K, safe = other.camera.K, torch.where(ahead, z, torch.inf)
    u, v = (p / safe * float(K[i, i]) + float(K[i, 2]) for i, p in enumerate((px, py)))
    inside = ahead & (u >= 0) & (v >= 0) & (u < other.camera.width) & (v < other.camera.height)
    left, top = (torch.floor((a - (other.step // 2 + 0.5)) / other.step) for a in (u, v))
    h, w = other.depth.shape
    least = torch.full_like(depth, torch.inf)
    for down in (0, 1):
        row = (top + down).clamp(0, h - 1).long()
        for right in (0, 1):
            found = other.depth[row, (left + right).clamp(0, w - 1).long()]
            least = torch.minimum(least, torch.where(found > 0, (found - z).abs(), torch.inf))
    return torch.where(inside, least / safe, torch.inf)
